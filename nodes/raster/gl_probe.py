"""What the OpenGL device can do: transfers to and from it, and its multiply-adds."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from .gl_context import check_errors, open_context, shader_source

SIZES_BYTES = (4, 1 << 12, 1 << 16, 1 << 20, 1 << 24)
_REPEATS = 15
_GROUPS, _GROUP_SIZE, _CHAINS, _ROUNDS = 512, 64, 4, 512


def transfer_times(device_index: int = 0) -> dict[str, list[float]]:
    """Median seconds to send (``down``) and to read back (``up``) each of ``SIZES_BYTES``, driver's overhead included.

    Raises DeviceError as ``open_context`` does.
    """
    with open_context(device_index) as context:
        times: dict[str, list[float]] = {"down": [], "up": []}
        for n_bytes in SIZES_BYTES:
            buffer, data = context.buffer(reserve=n_bytes), np.zeros(n_bytes, np.uint8)

            def down(buffer=buffer, data=data) -> None:
                buffer.write(data)
                context.finish()

            def up(buffer=buffer, data=data) -> None:
                buffer.read_into(data)

            times["down"].append(_median_s(down))
            times["up"].append(_median_s(up))
            buffer.release()
        check_errors(context, "measuring transfers")
        return times


def flop_per_s(device_index: int = 0) -> float:
    """Multiply-adds of a compute shader on float32, two operations each; its launch included.

    Raises DeviceError as ``open_context`` does.
    """
    with open_context(device_index) as context:
        program = context.compute_shader(shader_source("flops.comp"))
        out = context.buffer(reserve=4 * _GROUPS * _GROUP_SIZE)
        out.bind_to_storage_buffer(0)
        program["rounds"] = _ROUNDS

        def run() -> None:
            program.run(_GROUPS)
            context.finish()

        run()
        seconds = _median_s(run)
        check_errors(context, "measuring multiply-adds")
    return 2 * 4 * _CHAINS * _ROUNDS * _GROUPS * _GROUP_SIZE / seconds


def _median_s(work: Callable[[], None]) -> float:
    times = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return float(np.median(times))

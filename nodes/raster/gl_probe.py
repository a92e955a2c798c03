"""What the OpenGL device can do: transfers to and from it, reading its memory, and its multiply-adds."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from .gl_context import check_errors, open_context, shader_source, storage_limit

SIZES_BYTES = (4, 1 << 12, 1 << 16, 1 << 20, 1 << 24)
_REPEATS = 15
_READ_BYTES, _READ_GROUPS = 1 << 30, 4096
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


def read_bytes_per_s(device_index: int = 0) -> float:
    """Bytes that a compute shader reads from device memory, from a buffer of 1 GiB or the storage-block limit.

    Raises DeviceError as ``open_context`` does, or if there is not enough memory.
    """
    with open_context(device_index) as context:
        n_bytes = min(_READ_BYTES, storage_limit(context)) // 16 * 16
        buffer, out = context.buffer(reserve=n_bytes), context.buffer(reserve=4)
        check_errors(context, f"allocating {n_bytes} bytes to read")
        buffer.bind_to_storage_buffer(0)
        out.bind_to_storage_buffer(1)
        program = context.compute_shader(shader_source("read.comp"))
        program["n_vectors"] = n_bytes // 16

        def run() -> None:
            program.run(_READ_GROUPS)
            context.finish()

        buffer.clear()  # memory that nothing has written may not be there
        run()
        seconds = _median_s(run)
        check_errors(context, "measuring reads")
    return n_bytes / seconds


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

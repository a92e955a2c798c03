"""``splatpipe bench messages``: what coding takes off each kind of message, how long it takes, where that pays.

Frames are spread over the camera path of a run. Each message is coded and decoded alone on its thread, held against
what was coded, and timed. Break-even is the bandwidth at which the bytes saved take as long as coding and decoding:
on slower links coding is faster.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ...shared.config import RunConfig, parse_config, read_config, refuse_layers
from ...shared.framebuffer_runs import encode_runs
from ...shared.message_codecs import form_of, has_zstd, pack, unpack
from ...shared.messages import FRAMEBUFFER_EMPTY, Framebuffer, Message, RenderPoints, encode, parse_header
from ...shared.scene_share import share_borders
from ..job import Job
from ..record import machine_record

T = TypeVar("T")

LINKS = {"100 Mbit/s": 12.5e6, "1 Gbit/s": 125e6}
"""Bandwidths, bytes a second, for which the time saved is told."""


def bench_messages(
    inputs: Sequence[Path], overrides: Sequence[str] = (), *, frames: int = 5, ranks: int = 4, repeats: int = 5
) -> dict[str, Any]:
    """Messages of ``frames`` frames of each configuration, or scene with all settings at their defaults.

    ranks : a framebuffer is also of the points that one of so many ranks holds.  repeats : of each, the first
    apart; medians count.

    Returns a JSON-able dict: ``rows``, one for each input and kind, and the machine. Raises ConfigError, InputError,
    StoreError for what is no run.
    """
    rows = []
    for path in inputs:
        rows += _rows(path.stem, Job(_config(path, list(overrides))), frames, ranks, repeats)
    return {
        "benchmark": "messages",
        "frames": frames,
        "zstd": has_zstd(),
        "links_bytes_per_s": LINKS,
        "rows": rows,
        "machine": machine_record(),
    }


def _config(path: Path, overrides: list[str]) -> RunConfig:
    """Drawn here, in this process."""
    data = {"scene": {"path": str(path)}} if path.is_dir() else read_config(path)
    config = parse_config(data, str(path), [*overrides, "pipeline.topology=single", "pipeline.ranks=0"])
    refuse_layers(config, "bench messages is of points")
    return config


def _rows(name: str, job: Job, frames: int, ranks: int, repeats: int) -> list[dict[str, Any]]:
    measured: dict[str, list[dict[str, Any]]] = {}
    for what, units, message in _messages(job, frames, ranks):
        measured.setdefault(what, []).append(_measure(message, repeats) | {"units": units})
    rows = []
    for what, of_frames in measured.items():
        raw, coded, encode_s, decode_s, units = (
            float(np.mean([of[key] for of in of_frames]))
            for key in ("raw_bytes", "coded_bytes", "encode_s", "decode_s", "units")
        )
        spent_s = encode_s + decode_s
        rows.append(
            {
                "scene": name,
                "message": what,
                "forms": sorted({of["form"] for of in of_frames}),
                "units": units,
                "raw_bytes": raw,
                "coded_bytes": coded,
                "encode_s": encode_s,
                "decode_s": decode_s,
                "encode_bytes_per_s": raw / encode_s if encode_s else None,
                "decode_bytes_per_s": raw / decode_s if decode_s else None,
                "break_even_bytes_per_s": (raw - coded) / spent_s if spent_s else 0.0,
                "saved_s": {link: (raw - coded) / rate - spent_s for link, rate in LINKS.items()},
                "failed": any(of["failed"] for of in of_frames),
            }
        )
    return rows


def _messages(job: Job, frames: int, ranks: int) -> Iterator[tuple[str, int, Message]]:
    """(what it is, cells, entries or pixels that are no background, the message) of each frame's messages."""
    octree = job.load_octree()
    culling, sampling = job.culling_node(octree), job.sampling_node(octree)
    first, stop = share_borders(octree, ranks)[ranks // 2 :][:2].tolist()
    with job.make_rasterizer(job.load_drawn(verify=False)) as rasterizer:
        for frame in np.unique(np.linspace(0, job.n_frames - 1, frames).astype(int)).tolist():
            camera = job.camera(frame)
            bits = culling.process(camera)
            yield "visibility", bits.n_cells, bits
            chosen = sampling.process(camera, bits)
            entries = chosen.entries.copy()  # the node's own are not to be kept
            yield "render-points", len(entries), RenderPoints(frame, entries)
            offset, stride = entries["offset"], entries["stride"]
            of_share = entries[(stride > 0) & (offset >= first) & (offset < stop)]
            for what, drawn in (("framebuffer", entries), (f"1 of {ranks} shares", of_share)):
                words = rasterizer.draw(camera, drawn).reshape(-1)
                yield what, int((words != FRAMEBUFFER_EMPTY).sum()), Framebuffer(frame, encode_runs(words))


def _measure(message: Message, repeats: int) -> dict[str, Any]:
    """Bytes, seconds of coding and decoding (medians), the form, and whether what came back is something else."""
    head, payload = encode(message)
    kind = parse_header(head)[0]
    pack(kind, payload)  # compiles, or loads what was compiled
    encode_s, coded = _median(lambda: pack(kind, payload), repeats)
    row = {"raw_bytes": len(payload), "coded_bytes": len(payload), "encode_s": encode_s, "decode_s": 0.0}
    if coded is None:
        return row | {"form": "raw", "failed": False}
    unpack(kind, coded.data, len(payload))
    decode_s, again = _median(lambda: unpack(kind, coded.data, len(payload)), repeats)
    failed = again.tobytes() != bytes(payload)
    return row | {
        "coded_bytes": len(coded),
        "decode_s": decode_s,
        "form": form_of(coded.data),
        "failed": failed,
    }


def _median(work: Callable[[], T], repeats: int) -> tuple[float, T]:
    """Median seconds of ``repeats`` calls and one more, and what the last one gave."""
    seconds = []
    for _ in range(repeats):
        started = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - started)
    started = time.perf_counter()
    found = work()
    return float(np.median([*seconds, time.perf_counter() - started])), found


def print_messages(results: dict[str, Any], console: Any) -> None:
    """A table of the rows."""
    from rich.table import Table

    table = Table(title=f"Coded messages, mean of {results['frames']} frames; what coding saves of a message's time")
    headings = ("scene", "message", "raw B", "coded B", "B/unit", "encode ms", "MB/s", "decode ms", "MB/s")
    for heading in (*headings, "pays below MB/s", *results["links_bytes_per_s"]):
        left = heading in headings[:2]
        table.add_column(heading, justify="left" if left else "right", no_wrap=left)
    for row in results["rows"]:
        rates = [row["encode_bytes_per_s"], row["decode_bytes_per_s"]]
        encode, decode = (f"{1e-6 * rate:,.0f}" if rate else "–" for rate in rates)
        table.add_row(
            row["scene"],
            row["message"] + (" FAILED" if row["failed"] else ""),
            f"{row['raw_bytes']:,.0f}",
            f"{row['coded_bytes']:,.0f}",
            f"{row['coded_bytes'] / max(row['units'], 1):.2f}",
            f"{1e3 * row['encode_s']:.3f}",
            encode,
            f"{1e3 * row['decode_s']:.3f}",
            decode,
            f"{1e-6 * row['break_even_bytes_per_s']:,.0f}",
            *(f"{1e3 * seconds:.2f} ms" if seconds > 0 else "–" for seconds in row["saved_s"].values()),
        )
    console.print(table)
    console.print("unit: a cell, an entry, a pixel that is no background")
    if not results["zstd"]:
        console.print("zstandard is missing: framebuffers have no coded form; install splatpipe[mpi]")
    machine = results["machine"]
    console.print(f"{machine['cpu']}, {machine['cores']} cores, commit {machine['commit'] or 'unknown'}")

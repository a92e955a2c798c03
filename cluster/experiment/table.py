"""Runs → a tidy table: a row a run, a column a setting or a measure; medians with spread; scaling."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable
from typing import Any

import numpy as np

from .config import PaperFigure, ScalingSection
from .grid import Experiment, Point
from .journal import Journal

Row = dict[str, Any]
Record = dict[str, Any]


def _stage_ms(stage: str) -> Callable[[Record], float]:
    return lambda record: 1e3 * record["stages"][stage]["work_s"] / record["frames"]


def _count(name: str) -> Callable[[Record], float]:
    return lambda record: float(np.median(record["per_frame"][name]))


def _bytes(kind: str) -> Callable[[Record], float]:
    return lambda record: record["messages"].get(kind, {"bytes": 0})["bytes"] / record["frames"]


MEASURES: dict[str, Callable[[Record], Any]] = {
    "frames_per_s": lambda record: record["frames_per_s"],
    "latency_ms": lambda record: record["latency_ms"]["median"],
    "culling_ms": _stage_ms("culling"),
    "sampling_ms": _stage_ms("sampling"),
    "render_ms": _stage_ms("render"),
    "cells_visible": _count("cells_visible"),
    "entries": _count("entries"),
    "points": _count("points"),
    "visibility_bytes": _bytes("VISIBILITY"),
    "render_points_bytes": _bytes("RENDER_POINTS"),
    "sent_bytes": lambda record: sum(of["bytes"] for of in record["messages"].values()) / record["frames"],
    "peak_rss_bytes": lambda record: max(rank["peak_rss_bytes"] for rank in record["ranks"]),
    "ranks": lambda record: len(record["ranks"]),
    "scene_points": lambda record: record["scene"]["points"],
    "scene_cells": lambda record: record["scene"]["cells"],
}
"""Column → its value of a run's record. Stage times are means over the frames, counts medians, bytes a frame."""


def tidy_rows(experiment: Experiment, journal: Journal) -> list[Row]:
    """One row a finished run: point number, repeat, varied settings, measures, the commit it ran with."""
    keys = experiment.keys
    return [
        {"point": run.point + 1, "repeat": run.repeat + 1}
        | {key: _setting(experiment, run.point, key) for key in keys}
        | {name: measure(run.record) for name, measure in MEASURES.items()}
        | {"commit": run.record["machine"]["commit"]}
        for run in sorted(journal.runs, key=lambda run: (run.point, run.repeat))
        if run.record is not None
    ]


def summaries(experiment: Experiment, rows: list[Row]) -> list[Row]:
    """One row a point that has a finished run: settings, median of every measure, least and largest of the main one."""
    measure = experiment.config.experiment.measure
    out = []
    for number in range(1, len(experiment.points) + 1):
        own = [row for row in rows if row["point"] == number]
        if not own:
            continue
        values = [row[measure] for row in own]
        out.append(
            {"point": number, "repeats": len(own)}
            | {key: own[0][key] for key in experiment.keys}
            | {name: float(np.median([row[name] for row in own])) for name in MEASURES}
            | {"least": min(values), "largest": max(values)}
        )
    if experiment.config.scaling:
        add_scaling(out, experiment.keys, experiment.config.scaling, measure)
    return out


def add_scaling(rows: list[Row], keys: list[str], scaling: ScalingSection, measure: str) -> None:
    """Add ``speed_up`` and ``efficiency`` to rows that differ in the scaled key (and those along with it) only.

    The baseline is the row with the smallest value of the key, r₀. Strong: speed-up s = rate / rate₀ and efficiency
    s · r₀ / r. Weak: the work grows with r, so efficiency = rate / rate₀ and (scaled) speed-up = efficiency · r / r₀.
    Efficiency, and a weak speed-up, need numbers: None where the key holds names, whose first row is the baseline.
    Source: Amdahl 1967; Gustafson 1988.
    """
    fixed = [key for key in keys if key != scaling.over and key not in scaling.along]
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(repr([row[key] for key in fixed]), []).append(row)
    for group in groups.values():
        numbers = all(_is_number(row[scaling.over]) for row in group)
        base = min(group, key=lambda row: row[scaling.over]) if numbers else group[0]
        for row in group:
            ratio = row[measure] / base[measure] if base[measure] else None
            grown = row[scaling.over] / base[scaling.over] if numbers and base[scaling.over] else None
            if scaling.kind == "strong":
                row["speed_up"] = ratio
                row["efficiency"] = ratio / grown if ratio is not None and grown else None
            else:
                row["speed_up"] = ratio * grown if ratio is not None and grown else None
                row["efficiency"] = ratio


def beside_paper(experiment: Experiment, rows: list[Row]) -> list[tuple[PaperFigure, float | None]]:
    """Each figure of the paper with our median over the runs that match it; None where there is none."""
    out = []
    for figure in experiment.config.paper:
        values = [
            row[figure.measure]
            for row in rows
            if all(_setting(experiment, row["point"] - 1, key) == value for key, value in figure.where.items())
        ]
        out.append((figure, float(np.median(values)) if values else None))
    return out


def as_csv(rows: list[Row]) -> str:
    """The rows as CSV text, settings that are lists or tables as JSON-like text."""
    text = io.StringIO(newline="")
    if rows:
        writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    return text.getvalue()


def _setting(experiment: Experiment, point: int, key: str) -> Any:
    """A setting of a point: varied, common, or what the run's configuration holds."""
    settings: Point = experiment.config.set | experiment.points[point]
    if key in settings:
        return settings[key]
    section, _, name = key.partition(".")
    return getattr(getattr(experiment.runs[point], section), name)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)

"""``splatpipe plan``: what a configuration needs and what is left out, as a table, JSON or a report."""

from __future__ import annotations

import shlex
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ...shared.config import load_config
from ..job import Job
from ..record import machine_record
from ..report import Report, as_text
from .ablation import Ablation, ablate
from .needs import parts, with_measured
from .topology import decide
from .whole_runs import ablate_runs, import_times
from .workload import Workload


def plan_command(config_path: Path, overrides: list[str], *, measure: bool = False) -> dict[str, Any]:
    """The plan of a run, JSON-able.

    measure : put parts back and time them, in this process and in whole runs: about a minute. Else nothing is drawn.
    Raises InputError for a wrong configuration or scene.
    """
    job = Job(load_config(config_path, overrides))
    decision = decide(job)
    work = Workload.of_look(job)
    measured: list[Ablation] = []
    imports: list[dict[str, Any]] = []
    if measure:
        measured = [*ablate(job), *ablate_runs(job, config_path, overrides)]
        imports = import_times()
    saved_ms = {ablation.part: ablation.saved_ms for ablation in measured}
    return {
        "config": str(config_path),
        "overrides": overrides,
        "plan": asdict(decision),
        "workload": asdict(work),
        "parts": [asdict(part) for part in with_measured(parts(job, work, decision), saved_ms)],
        "ablation": [asdict(ablation) for ablation in measured],
        "imports": imports,
        "machine": machine_record(),
    }


def print_plan(results: dict[str, Any], console: Any) -> None:
    """The plan as tables."""
    from rich.table import Table

    console.print(f"topology {results['plan']['topology']}: {results['plan']['reason']}")
    for title, columns, rows in tables(results):
        table = Table(title=title, title_justify="left")
        for column in columns:
            table.add_column(column)
        for row in rows:
            table.add_row(*map(as_text, row))
        console.print(table)


def report_plan(results: dict[str, Any], stem: Path) -> list[Path]:
    """Write the plan as HTML and Markdown; the two paths."""
    command = ["splatpipe", "plan", results["config"]]
    command += [part for override in results["overrides"] for part in ("--set", override)]
    report = Report("What this run needs", shlex.join(command))
    report.text(f"Topology **{results['plan']['topology']}**: {results['plan']['reason']}.")
    for title, columns, rows in tables(results):
        report.heading(title)
        report.table(columns, rows)
    return report.write(stem)


def tables(results: dict[str, Any]) -> list[tuple[str, list[str], list[list[Any]]]]:
    """(title, columns, rows) of what a plan says."""
    columns = ["part", "why", "gain", "unit", "basis"]
    rows = {
        held: [[part[key] for key in ("what", *columns[1:])] for part in results["parts"] if part["left_out"] == held]
        for held in (True, False)
    }
    found = [
        ("Left out", columns, rows[True]),
        ("Kept, and what leaving it out would save", columns, rows[False]),
    ]
    if results["ablation"]:
        columns = ["part", "without, ms", "with, ms", "saved, ms", "of", "pairs", "error added"]
        found.append(("Ablation: medians, in turn", columns, [_ablation_row(row) for row in results["ablation"]]))
    if results["imports"]:
        import_rows = [[row["part"], row["module"], row["ms"]["median"]] for row in results["imports"]]
        found.append(("Imports, each in a fresh process", ["part", "module", "ms"], import_rows))
    return found


def _ablation_row(row: dict[str, Any]) -> list[Any]:
    without, with_part = (row[key]["median"] for key in ("without_ms", "with_ms"))
    of = "a run" if row["once"] else "a frame"
    error = "0: the same bits" if row["identical"] else "NOT the same bits"
    return [row["part"], without, with_part, row["saved_ms"], of, row["repeats"], error]

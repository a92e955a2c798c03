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
from .needs import parts
from .topology import decide
from .workload import Workload


def plan_command(config_path: Path, overrides: list[str]) -> dict[str, Any]:
    """The plan of a run, JSON-able. Nothing is drawn. Raises InputError for a wrong configuration or scene."""
    job = Job(load_config(config_path, overrides))
    decision = decide(job)
    work = Workload.of_look(job)
    return {
        "config": str(config_path),
        "overrides": overrides,
        "plan": asdict(decision),
        "workload": asdict(work),
        "parts": [asdict(part) for part in parts(job, work, decision)],
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
    return [
        ("Left out", columns, rows[True]),
        ("Kept, and what leaving it out would save", columns, rows[False]),
    ]

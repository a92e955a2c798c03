"""Which modules hold cases, and how the suite is run and shown."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

from ...shared.errors import InputError
from ...shared.files import write_json
from ...shared.stability.case import FAILED, OUT_OF_REACH, PASSED, Case, Outcome, collect, run
from ..progress import FrameProgress
from ..record import machine_record
from ..report import Report, as_text

MODULES = (
    "splatpipe.nodes.stability.projection",
    "splatpipe.nodes.stability.extents",
    "splatpipe.nodes.stability.depth",
    "splatpipe.nodes.stability.clouds",
    "splatpipe.nodes.stability.compact",
    "splatpipe.nodes.stability.groups",
    "splatpipe.nodes.stability.pools",
    "splatpipe.nodes.stability.viewports",
    "splatpipe.nodes.stability.splats",
    "splatpipe.nodes.stability.opengl",
    "splatpipe.nodes.stability.layers",
    "splatpipe.nodes.stability.large",
    "splatpipe.shared.stability.eigenvalues",
    "splatpipe.shared.stability.neighbourhoods",
    "splatpipe.shared.stability.cameras",
    "splatpipe.shared.stability.grids",
    "splatpipe.shared.stability.codecs",
    "splatpipe.shared.stability.linear_groups",
    "splatpipe.cluster.stability.messages",
    "splatpipe.cluster.stability.inequalities",
    "splatpipe.cluster.stability.prediction",
)
COLUMNS = ("case", "what", "value", "bound", "unit", "verdict")


def all_cases() -> list[Case]:
    """Every case, in the order of ``MODULES``."""
    return collect(import_module(name) for name in MODULES)


def stability_command(only: str, json: Path | None, report: Path | None) -> int:
    """Run the cases whose name contains ``only``; the exit status: 1 if one failed.

    Raises InputError if no case has such a name.
    """
    from rich.console import Console

    chosen = [case for case in all_cases() if only in case.name]
    if not chosen:
        raise InputError(f"--only {only}: no case of that name, expected a part of one of: {_subjects()}")
    outcomes = []
    with FrameProgress(len(chosen)) as progress:
        for done, case in enumerate(chosen):
            progress.show(case.name, done)
            outcomes.append(run(case))
    console = Console()
    _print(outcomes, console if console.is_terminal else Console(width=200))
    if json is not None:
        write_json(json, {"cases": [_record(o) for o in outcomes], "machine": machine_record()})
    if report is not None:
        for path in _report(outcomes, only).write(report):
            print(path)
    return int(any(o.verdict == FAILED for o in outcomes))


def _subjects() -> str:
    return ", ".join(dict.fromkeys(case.name.split("/")[0] for case in all_cases()))


def _rows(outcomes: list[Outcome]) -> list[list[str]]:
    """Cells of a table; what a family compares is said once."""
    rows = []
    said = ""
    for outcome in outcomes:
        case = outcome.case
        verdict = f"{outcome.verdict}: {outcome.reason}" if outcome.reason else outcome.verdict
        bound = as_text(case.bound) if outcome.verdict != OUT_OF_REACH else as_text(None)
        rows.append(
            [case.name, case.what if case.what != said else "", as_text(outcome.value), bound, case.unit, verdict]
        )
        said = case.what
    return rows


def _record(outcome: Outcome) -> dict[str, Any]:
    case = outcome.case
    return {
        "case": case.name,
        "what": case.what,
        "value": outcome.value,
        "bound": case.bound,
        "unit": case.unit,
        "verdict": outcome.verdict,
        "reason": outcome.reason,
        "seconds": outcome.seconds,
    }


def _summary(outcomes: list[Outcome]) -> str:
    counts = {verdict: sum(o.verdict == verdict for o in outcomes) for verdict in (PASSED, FAILED, OUT_OF_REACH)}
    seconds = sum(o.seconds for o in outcomes)
    return (
        f"{len(outcomes)} cases: " + ", ".join(f"{n} {verdict}" for verdict, n in counts.items()) + f"; {seconds:.0f} s"
    )


def _print(outcomes: list[Outcome], console: Any) -> None:
    from rich.table import Table

    table = Table(*COLUMNS, show_lines=False)
    for outcome, row in zip(outcomes, _rows(outcomes), strict=True):
        table.add_row(*row, style="red" if outcome.verdict == FAILED else "")
    console.print(table)
    console.print(_summary(outcomes))


def _report(outcomes: list[Outcome], only: str) -> Report:
    report = Report("Stability", "splatpipe stability" + (f" --only {only}" if only else ""))
    report.text(
        "Each case runs the program's own code on an extreme input and compares it with a reference (float64, integers "
        "or 50 digits). The value must be at most the bound. " + _summary(outcomes) + "."
    )
    for subject in dict.fromkeys(o.case.name.split("/")[0] for o in outcomes):
        report.heading(subject)
        report.table(COLUMNS, _rows([o for o in outcomes if o.case.name.startswith(f"{subject}/")]))
    return report

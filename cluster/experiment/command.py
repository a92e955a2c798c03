"""``splatpipe experiment``: run what is missing, then write table, provenance and report."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from rich.console import Console

from ...shared.errors import SplatpipeError
from ...shared.files import write_json, write_whole
from ..measured import measured_run
from ..progress import FrameProgress
from ..record import RECORD_VERSION, machine_record
from .grid import Experiment, load_experiment
from .journal import Journal
from .report import make_report
from .runner import Runner, run_missing
from .scenes import prepare_scenes
from .table import as_csv, summaries, tidy_rows


def experiment_command(
    file: Path, *, fresh: bool = False, json_path: Path | None = None, runner: Runner = measured_run
) -> None:
    """Run an experiment to its end and write its results; what was finished before is not run again.

    Raises SplatpipeError after the results are written if any point has no finished run.
    """
    experiment = load_experiment(file)
    journal = run_experiment(experiment, fresh=fresh, runner=runner)
    results = write_results(experiment, journal)
    if json_path is not None:
        write_json(json_path, results)
    console = Console(highlight=False, soft_wrap=True)
    for name in ("runs.csv", "medians.csv", "provenance.json", "report.html", "report.md"):
        console.print(f"wrote {experiment.output / name}")
    missing = sorted({run.point + 1 for run in journal.runs} - {row["point"] for row in results["rows"]})
    if missing:
        reason = journal.failures[missing[0] - 1]
        raise SplatpipeError(
            f"{file}: {len(missing)} of {len(experiment.points)} points failed: {missing[0]}: {reason}"
        )


def run_experiment(experiment: Experiment, *, fresh: bool, runner: Runner = measured_run) -> Journal:
    """Build the scenes, run what the journal lacks; the journal."""
    journal = Journal.open(experiment.output / "runs.jsonl", experiment.sha256, fresh=fresh)
    total = len(experiment.points) * experiment.config.experiment.repeats
    with FrameProgress(total) as progress:
        prepare_scenes(experiment, progress.show)
        run_missing(experiment, journal, lambda doing, done: progress.show(doing, done, total), runner)
    return journal


def write_results(experiment: Experiment, journal: Journal) -> dict[str, Any]:
    """Write ``runs.csv``, ``medians.csv``, ``provenance.json`` and the report; rows, medians and failures."""
    rows = tidy_rows(experiment, journal)
    medians = summaries(experiment, rows)
    for name, table in (("runs.csv", rows), ("medians.csv", medians)):
        text = as_csv(table)
        write_whole(experiment.output / name, lambda part, text=text: part.write_text(text, encoding="utf-8"))
    write_json(experiment.output / "provenance.json", provenance(experiment, journal))
    make_report(experiment, journal, rows, medians).write(experiment.output / "report")
    return {
        "rows": rows,
        "medians": medians,
        "failed": {str(point + 1): why for point, why in journal.failures.items()},
        "provenance": provenance(experiment, journal),
    }


def provenance(experiment: Experiment, journal: Journal) -> dict[str, Any]:
    """Where the figures come from: machine, versions, commits, what was run and when."""
    records = [run.record for run in journal.runs if run.record is not None]
    return {
        "experiment": experiment.file.name,
        "plan_sha256": experiment.sha256,
        "record_version": RECORD_VERSION,
        "base": experiment.config.experiment.base,
        "config": experiment.config.model_dump(mode="json"),
        "runs": len(records),
        "commits": sorted({str(record["machine"]["commit"]) for record in records}),
        "machines": sorted({record["machine"]["cpu"] for record in records}),
        "started": journal.started,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": machine_record(),
    }

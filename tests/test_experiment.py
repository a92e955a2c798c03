"""`splatpipe experiment`: the grid, what it refuses, what a kill leaves, and one real experiment."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from splatpipe.cluster.experiment.command import experiment_command, run_experiment, write_results
from splatpipe.cluster.experiment.config import ScalingSection
from splatpipe.cluster.experiment.grid import load_experiment, overrides
from splatpipe.cluster.experiment.journal import Journal
from splatpipe.cluster.experiment.table import add_scaling, as_csv
from splatpipe.shared.config import load_config
from splatpipe.shared.errors import ConfigError, InputError, SplatpipeError

ROOT = Path(__file__).parent.parent
SCENE = '[scenes.tiny]\nsynth = 3000\npoints_per_cell = 200\n[set]\n"scene.path" = "tiny"\n'


@pytest.fixture
def write(tmp_path):
    """Writes an experiment of so many repeats over a small scene of its own; its path."""
    (tmp_path / "run.toml").write_text("[output]\nframes = 2\n[camera]\nwidth = 64\nheight = 48\n")

    def write(text, repeats=2, scene=SCENE):
        path = tmp_path / "e.toml"
        head = f'[experiment]\nbase = "run.toml"\noutput = "out"\nrepeats = {repeats}\n'
        path.write_text(head + scene + text)
        return path

    return write


class FakeRunner:
    """Records that depend on threads and on how many runs went before; stops or fails where it is told to."""

    def __init__(self, stop_at=None, fail=None):
        self.calls = []
        self.stop_at, self.fail = stop_at, fail

    def __call__(self, config, sets):
        settings = load_config(config, sets)
        if len(self.calls) == self.stop_at:
            raise KeyboardInterrupt
        self.calls.append((settings.render.threads, settings.camera.width))
        if self.fail and self.fail(settings):
            raise SplatpipeError("no such device")
        rate = 10.0 * settings.render.threads + len(self.calls) / 100
        stage = {"work_s": 0.5}
        return {
            "frames": 2,
            "frames_per_s": rate,
            "latency_ms": {"median": 1e3 / rate},
            "stages": {"culling": stage, "sampling": stage, "render": stage},
            "messages": {},
            "per_frame": {"cells_visible": [3, 5], "entries": [7, 7], "points": [100, 300]},
            "ranks": [{"peak_rss_bytes": 5}],
            "scene": {"points": 3000, "cells": 20},
            "machine": {"commit": "abc", "cpu": "a cpu"},
        }


THREADS = '[grid]\n"render.threads" = [1, 2]\n'


def test_the_grid_is_every_combination_and_then_the_points(write):
    text = (
        '[grid]\n"render.threads" = [1, 2]\n"pipeline.topology" = ["single", "pipelined"]\n'
        '[[zip]]\n"camera.width" = [64, 128]\n"camera.height" = [48, 96]\n[[point]]\n"render.threads" = 4\n'
    )
    experiment = load_experiment(write(text))
    assert len(experiment.points) == 2 * 2 * 2 + 1
    assert experiment.points[0] == {
        "render.threads": 1,
        "pipeline.topology": "single",
        "camera.width": 64,
        "camera.height": 48,
    }
    sizes = {(run.camera.width, run.camera.height) for run in experiment.runs}
    assert sizes == {(64, 48), (128, 96)}
    assert experiment.runs[-1].render.threads == 4
    assert experiment.runs[0].scene.path == str(experiment.output / "scenes" / "tiny.scene")


def test_any_value_survives_the_command_line(write):
    point = {
        "camera.center": [0.5, -1, 2e9],
        "render.background": 'quote " and \\ é',
        "culling.backface": True,
        "camera.keyframes": [{"time": 0.0, "eye": [0, 0, 1], "target": [0, 0, 0]}],
    }
    run = load_config(write("").parent / "run.toml", overrides(point))
    assert run.camera.center == (0.5, -1.0, 2e9)
    assert run.render.background == 'quote " and \\ é'
    assert run.culling.backface is True
    assert run.camera.keyframes[0].eye == (0, 0, 1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[grid]\n"render.thread" = [1]', "unknown key render.thread, did you mean render.threads?"),
        ('[grid]\n"rendr.threads" = [1]', "unknown key rendr, did you mean render?"),
        ("[grid]\nthreads = [1]", "unknown key threads, did you mean render.threads?"),
        ('[grid]\n"render.threads" = [1, "two"]', "render.threads = 'two', expected a valid integer"),
        ('[grid]\n"render.threads" = 2', "grid.render.threads = 2, expected a valid list"),
        ('[grid]\n"render.threads" = []', "grid.render.threads = [], list expected at least 1 item"),
        ('[grid]\n"render.threads" = [1, 1]', "points 1 and 2 are the same run: render.threads = 1"),
        ('[[zip]]\n"camera.width" = [1, 2]\n"camera.height" = [1]', "zip: found lists of different lengths"),
        ('[grid]\n"camera.width" = [8]\n[[zip]]\n"camera.width" = [8, 9]', "camera.width: found in two dimensions"),
        ('[scaling]\nkind = "strong"\nover = "render.threads"', "render.threads is no key that this experiment sets"),
        ('[scaling]\nkind = "odd"\nover = "render.threads"', "scaling.kind = 'odd', expected 'strong' or 'weak'"),
        ("[grids]\n", "unknown key grids, did you mean grid?"),
        ("[[paper]]\nwhere = {}\nvalue = 1\nmeasure = 'fps'\nsource = ''", "measure = 'fps', did you mean"),
    ],
)
def test_what_is_wrong_is_said_before_the_first_run(write, text, said):
    runner = FakeRunner()
    path = write(text)
    with pytest.raises(ConfigError) as error:
        experiment_command(path, runner=runner)
    assert str(error.value).startswith(f"{path}: {said}")
    assert error.value.exit_status == 2
    assert not runner.calls


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        ('[set]\n"scene.path" = "nowhere"\n', "nowhere"),
        ("", "scene.path: missing"),
        (SCENE.replace("synth = 3000", 'inputs = ["no*.las"]'), "scenes.tiny: "),
        (SCENE.replace("synth = 3000", ""), "scenes.tiny: expected either inputs or synth"),
        (SCENE.replace("points_per_cell = 200", "points_per_cell = 0"), "points_per_cell"),
    ],
)
def test_a_missing_scene_or_input_is_said_before_the_first_run(write, scene, said):
    runner = FakeRunner()
    with pytest.raises(InputError, match=said) as error:
        experiment_command(write(THREADS, scene=scene), runner=runner)
    assert "\n" not in str(error.value)
    assert not runner.calls


def test_a_missing_base_is_one_line(write):
    path = write(THREADS)
    (path.parent / "run.toml").unlink()
    with pytest.raises(ConfigError, match=r"run\.toml: cannot be read: No such file"):
        load_experiment(path)


def test_repeats_are_interleaved_and_the_table_has_a_row_a_run(write):
    runner = FakeRunner()
    experiment = load_experiment(write(THREADS, repeats=3))
    journal = run_experiment(experiment, fresh=False, runner=runner)
    assert [threads for threads, _ in runner.calls] == [1, 2, 1, 2, 1, 2]
    results = write_results(experiment, journal)
    with (experiment.output / "runs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["point"], row["repeat"]) for row in rows] == [(p, r) for p in "12" for r in "123"]
    assert rows[0]["render.threads"] == "1"
    assert float(rows[0]["frames_per_s"]) == 10.01
    first = results["medians"][0]
    assert (first["least"], first["frames_per_s"], first["largest"]) == (10.01, 10.03, 10.05)
    assert (first["points"], first["render_ms"]) == (200, 250)
    provenance = json.loads((experiment.output / "provenance.json").read_text())
    assert provenance["plan_sha256"] == experiment.sha256
    assert provenance["commits"] == ["abc"]
    assert provenance["started"] <= provenance["finished"]
    assert "render.threads" in (experiment.output / "report.html").read_text()


def test_shuffled_order_is_the_seed_s(write):
    path = write("[grid]\n'render.threads' = [1, 2, 3, 4, 5, 6]\n", repeats=2)
    path.write_text(path.read_text().replace("repeats", "order = 'shuffled'\nseed = 3\nrepeats"))
    orders = []
    for _ in range(2):
        runner = FakeRunner()
        run_experiment(load_experiment(path), fresh=True, runner=runner)
        orders.append([threads for threads, _ in runner.calls])
    assert orders[0] == orders[1]
    assert sorted(orders[0][:6]) == [1, 2, 3, 4, 5, 6]
    assert orders[0][:6] != orders[0][6:]


@pytest.mark.parametrize("torn", [b"", b'{"point": 1, "rep'])
def test_after_a_kill_only_what_is_missing_runs(write, torn):
    experiment = load_experiment(write(THREADS, repeats=3))
    killed = FakeRunner(stop_at=3)
    with pytest.raises(KeyboardInterrupt):
        run_experiment(experiment, fresh=False, runner=killed)
    path = experiment.output / "runs.jsonl"
    with path.open("ab") as file:
        file.write(torn)
    again = FakeRunner()
    journal = run_experiment(experiment, fresh=False, runner=again)
    assert [threads for threads, _ in killed.calls + again.calls] == [1, 2, 1, 2, 1, 2]
    assert len(Journal.open(path, experiment.sha256, fresh=False).finished) == 6
    idle = FakeRunner()
    run_experiment(experiment, fresh=False, runner=idle)
    assert not idle.calls
    assert len(write_results(experiment, journal)["rows"]) == 6
    more = FakeRunner()
    run_experiment(load_experiment(write(THREADS, repeats=4)), fresh=False, runner=more)
    assert len(more.calls) == 2, "more repeats go on with what is there"


def test_results_of_another_grid_or_version_are_refused(write):
    run_experiment(load_experiment(write(THREADS)), fresh=False, runner=FakeRunner())
    other = load_experiment(write('[grid]\n"render.threads" = [1, 2, 3]\n'))
    with pytest.raises(InputError, match=r"runs\.jsonl: results of another experiment: .*--fresh starts over"):
        run_experiment(other, fresh=False, runner=FakeRunner())
    runner = FakeRunner()
    run_experiment(other, fresh=True, runner=runner)
    assert len(runner.calls) == 6
    path = other.output / "runs.jsonl"
    path.write_text(path.read_text().replace('"record_version": ', '"record_version": 99'))
    with pytest.raises(InputError, match="results of another version: found record_version 99") as error:
        run_experiment(other, fresh=False, runner=FakeRunner())
    assert error.value.exit_status == 2
    path.write_text("no results\n")
    with pytest.raises(InputError, match=r"line 1: found .* expected a JSON object"):
        run_experiment(other, fresh=False, runner=FakeRunner())


def test_a_failing_point_does_not_stop_the_others_and_is_named(write):
    path = write(THREADS)
    runner = FakeRunner(fail=lambda settings: settings.render.threads == 1)
    with pytest.raises(SplatpipeError, match=r"1 of 2 points failed: 1: no such device") as error:
        experiment_command(path, runner=runner)
    assert error.value.exit_status == 1
    assert len(runner.calls) == 4
    assert "no such device" in (path.parent / "out" / "report.md").read_text()
    mended = FakeRunner()
    experiment_command(path, runner=mended)
    assert [threads for threads, _ in mended.calls] == [1, 1], "what failed is tried again, what succeeded is not"


def test_strong_and_weak_scaling():
    rows = [{"t": t, "scene": s, "f": f} for t, s, f in [(2, "a", 30.0), (1, "a", 20.0), (1, "b", 8.0), (2, "b", 8.0)]]
    add_scaling(rows, ["t", "scene"], ScalingSection(kind="strong", over="t"), "f")
    assert [(row["speed_up"], row["efficiency"]) for row in rows] == [(1.5, 0.75), (1, 1), (1, 1), (1, 0.5)]
    rows = [{"t": 1, "scene": "a", "f": 20.0}, {"t": 4, "scene": "b", "f": 15.0}]
    add_scaling(rows, ["t", "scene"], ScalingSection(kind="weak", over="t", along=["scene"]), "f")
    assert [(row["speed_up"], row["efficiency"]) for row in rows] == [(1, 1), (3, 0.75)]
    rows = [{"kind": "single", "f": 20.0}, {"kind": "pipelined", "f": 30.0}]
    add_scaling(rows, ["kind"], ScalingSection(kind="strong", over="kind"), "f")
    assert [(row["speed_up"], row["efficiency"]) for row in rows] == [(1, None), (1.5, None)]


def test_ours_beside_the_paper_s(write):
    paper = '[[paper]]\nsource = "Table 9, row 1"\nwhere = { "render.threads" = 2 }\nvalue = [10, 30]\n'
    experiment = load_experiment(write(THREADS + paper, repeats=1))
    write_results(experiment, run_experiment(experiment, fresh=False, runner=FakeRunner()))
    assert (
        "| Table 9, row 1 | render.threads = 2 | frames_per_s | 10–30 | 20.02 | 1.001 |"
        in (experiment.output / "report.md").read_text()
    )


def test_an_empty_table_is_empty():
    assert as_csv([]) == ""


@pytest.mark.parametrize("path", sorted(ROOT.glob("configs/experiments/*.toml")) + sorted(ROOT.glob("configs/papers/*.toml")), ids=lambda path: path.stem)  # fmt: skip
def test_every_shipped_experiment_is_valid(path):
    experiment = load_experiment(path)
    assert len(experiment.points) >= 2
    assert experiment.config.experiment.title
    for figure in experiment.config.paper:
        matching = [
            point
            for point in experiment.points
            if all((experiment.config.set | point).get(key) == value for key, value in figure.where.items())
        ]
        assert matching, f"{figure.source}: no point of the experiment is {figure.where}"


def test_a_real_experiment(write):
    settings = '"render.rasterizer" = "cpu"\n"pipeline.topology" = "single"\n'
    path = write('[grid]\n"sampling.pixel_threshold" = [0, 40]\n', repeats=1, scene=SCENE + settings)
    command = [
        sys.executable,
        "-m",
        "splatpipe.cluster",
        "experiment",
        str(path),
        "--json",
        str(path.parent / "r.json"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    results = json.loads((path.parent / "r.json").read_text())
    every, fewer = results["medians"]
    assert np.isfinite(every["frames_per_s"])
    assert fewer["points"] < every["points"] <= 3000
    assert {p.name for p in (path.parent / "out").iterdir()} == {
        "runs.jsonl", "runs.csv", "medians.csv", "provenance.json", "report.html", "report.md", "report-1.png", "scenes",
    }  # fmt: skip

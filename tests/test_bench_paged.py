"""``splatpipe bench paged`` on a small scene: a row for each pool and budget; more points are fewer holes."""

from pathlib import Path

import pytest
from rich.console import Console
from splatpipe.cluster.bench.paged import bench_paged, print_paged
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.errors import ConfigError
from splatpipe.shared.synth import CityScan


@pytest.fixture(scope="module")
def config(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("bench")
    settings = BuildSettings(points_per_cell=300, attributes=("rgb",), up="z")
    build_scene([CityScan(n_points=60_000)], folder / "city", settings=settings)
    path = folder / "run.toml"
    path.write_text(
        '[scene]\npath = "city"\n[camera]\nwidth = 160\nheight = 90\n[render]\nrasterizer = "cpu"\n[output]\nframes = 3\n'
        '[pipeline]\ntopology = "single"\n'
    )
    return path


def test_points_buy_coverage_and_what_is_missing_is_told(config, capsys):
    found = bench_paged(config, [], budgets=["2MB"], million_points=[0.001, 0.01], error_frames=2)
    few, more, unlimited = found["rows"]
    assert few["points"] <= 1000 < more["points"] <= 10_000 < unlimited["points"]
    assert [row["point_budget"] for row in found["rows"]] == [1000, 10_000, 0]
    assert min(error["holes"] for error in few["errors"]) > max(error["holes"] for error in more["errors"])
    assert found["error_frames"] == [0, 2]
    for row in found["rows"]:
        assert 0 <= row["missing"]["mean"] <= row["missing"]["max"] <= 1
        assert row["frames_per_s"] > 0
    assert unlimited["loaded_bytes"] > 0
    print_paged(found, Console(width=200))
    assert "3 frames of a moving camera" in capsys.readouterr().out


def test_what_cannot_be_paged_is_refused_before_anything_is_measured(config):
    with pytest.raises(ConfigError, match=r"render.positions = 'compact': memory.residency = 'paged'"):
        bench_paged(config, ["render.positions=compact"], budgets=["2MB"], million_points=[1])

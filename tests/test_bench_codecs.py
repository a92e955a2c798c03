"""``splatpipe bench codecs`` on a few cells: sizes and errors of each codec, what is wrong is said, what lacks is listed."""

import json
import sys

import numpy as np
import pytest
from rich.console import Console
from splatpipe.cluster import cli
from splatpipe.cluster.bench.codec_cells import load_cells, scene_paths
from splatpipe.cluster.bench.codecs import bench_codecs, print_codecs
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.codecs import eci, occupancy
from splatpipe.shared.codecs.grid import from_grid
from splatpipe.shared.errors import CodecError, InputError
from splatpipe.shared.synth.sphere import SphereScan
from typer.testing import CliRunner

SMALL = {"bits": 6, "most_cells": 3, "points_per_cell": 1500, "n_default": 4000, "size": 64, "repeats": 1}


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scenes") / "ball.scene"
    build_scene([SphereScan(4000)], path, settings=BuildSettings(points_per_cell=300))
    return path


@pytest.fixture(scope="module")
def results():
    return bench_codecs([], **SMALL)


def rows_of(results):
    return {row["codec"]: row for row in results["rows"]}


def test_every_codec_has_its_size_and_an_error_within_its_bound(results):
    assert json.loads(json.dumps(results)) == results
    rows = rows_of(results)
    assert {"float32", "10-bit fixed point", "streams", "ci", "eci", "occupancy", "groups"} <= set(rows)
    for row in rows.values():
        assert row["failed"] is None
        assert 0 < row["error"] <= row["bound"]
        assert row["foreground_px"] > 100
    sizes = {name: row["bytes_per_point"] for name, row in rows.items()}
    assert sizes["occupancy"] < sizes["eci"] < sizes["10-bit fixed point"] == 4 < sizes["float32"] == 12
    assert rows["float32"]["error"] < 1e-6 < rows["10-bit fixed point"]["error"] < rows["ci"]["error"]
    assert rows["groups"]["rms"] > rows["ci"]["rms"] == rows["eci"]["rms"]  # lossy, and lossless on one grid


def test_frames_show_the_same_points_from_whatever_form(results):
    rows = rows_of(results)
    assert rows["streams"]["drawn_from"] == "streams"
    assert rows["groups"]["drawn_from"] == "groups"
    assert rows["ci"]["drawn_from"] == "decoded points"
    assert rows["ci"]["foreground_px"] == rows["occupancy"]["foreground_px"]
    assert abs(rows["streams"]["foreground_px"] - rows["ci"]["foreground_px"]) <= 2


def test_figures_stand_beside_those_of_the_papers(results, capsys):
    rows = rows_of(results)
    assert 0 < rows["streams"]["figures"]["coverage"] <= 1
    assert 0 < rows["groups"]["figures"]["removed"] < 1
    assert f"{8 * rows['ci']['bytes_per_point']:.1f} bits/point" == rows["ci"]["ours"]
    print_codecs(results, Console(width=140))
    printed = capsys.readouterr().out
    assert "5.0 bits/point" in printed
    assert "3 of" in printed


def test_more_points_may_be_removed_where_the_error_may_be_larger(scene):
    small = SMALL | {"most_cells": 2}
    exact, rough = (rows_of(bench_codecs([str(scene)], **small, epsilon=e))["groups"] for e in (0.0, 0.05))
    assert exact["figures"]["removed"] < rough["figures"]["removed"]
    assert exact["bound"] < rough["bound"]
    assert exact["error"] < rough["error"]


def test_cells_hold_the_stored_points_on_their_grid(scene):
    chosen = load_cells("ball", scene, bits=10, most_cells=5, leaves=False, size=64)
    again = load_cells("ball", scene, bits=10, most_cells=5, leaves=False, size=64)
    everything = load_cells("ball", scene, bits=10, most_cells=1000, leaves=False, size=64)
    leaves = load_cells("ball", scene, bits=10, most_cells=1000, leaves=True, size=64)
    assert len(chosen.cells) == 5
    assert all(np.array_equal(a.points, b.points) for a, b in zip(chosen.cells, again.cells, strict=True))
    assert len(leaves.cells) < len(everything.cells) == everything.n_owners
    assert leaves.n_stored == 4000
    for cell in everything.cells:
        assert len(np.unique(cell.points, axis=0)) == len(cell.points) == len(cell.colour)
        off = np.abs(from_grid(cell.points, np.zeros(3), cell.edge, 10) - cell.positions)
        assert off.max() <= cell.edge / 2**11 * (1 + 1e-3)
        radius = np.linalg.norm(cell.positions + cell.lower, axis=1)
        assert radius.min() > 0.84
        assert radius.max() < 1.16


def test_scenes_and_point_files_in_turn(scene, tmp_path):
    np.savetxt(tmp_path / "scatter.xyz", np.random.default_rng(1).uniform(0, 1, (500, 3)))
    with scene_paths([str(scene), str(tmp_path), str(scene)], 1, 100) as paths:
        assert [name for name, _ in paths] == ["ball", "scatter", "ball (2)"]
        assert load_cells(*paths[1], bits=8, most_cells=1000, leaves=True, size=64).n_stored == 500
        built = paths[1][1]
    assert scene.exists()
    assert not built.exists()
    with pytest.raises(InputError, match="missing"), scene_paths([str(tmp_path / "missing.las")], 1, 100):
        pass


def one_beside(data, bits, most_points):
    points = ORIGINAL_DECODE(data, bits, most_points)
    points[0] ^= 1
    return points


def one_fewer(data, bits, most_points):
    return ORIGINAL_DECODE(data, bits, most_points)[1:]


def refuses(data, bits, most_points):
    raise CodecError("coded points: found damage")


ORIGINAL_DECODE = occupancy.decode


@pytest.mark.parametrize(
    ("decode", "reason"), [(one_beside, "grid steps"), (one_fewer, "expected"), (refuses, "found damage")]
)
def test_what_is_not_decoded_as_it_was_fails_the_command(scene, monkeypatch, decode, reason):
    monkeypatch.setattr(occupancy, "decode", decode)
    arguments = ["bench", "codecs", str(scene), "--bits", "6", "--cells", "2", "--size", "64", "--repeats", "1"]
    found = CliRunner().invoke(cli.app, arguments)
    assert found.exit_code == 1
    assert "failed" in found.output
    row = rows_of(bench_codecs([str(scene)], **SMALL))["occupancy"]
    assert reason in row["failed"]
    assert row["ms"] == row["points_per_s"] == {}


def test_an_order_that_names_a_point_twice_fails(scene, monkeypatch):
    encode = eci.encode

    def twice(points, bits):
        encoded = encode(points, bits)
        encoded.order[0] = encoded.order[1]
        return encoded

    monkeypatch.setattr(eci, "encode", twice)
    rows = rows_of(bench_codecs([str(scene)], **SMALL))
    assert "every point once" in rows["eci"]["failed"]
    assert rows["ci"]["failed"] is None


def test_what_cannot_take_the_points_is_left_out_with_its_reason(scene, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    results = bench_codecs([str(scene)], **SMALL | {"bits": 9})
    reasons = {item["codec"]: item["reason"] for item in results["omitted"]}
    assert set(reasons) == {"streams", "draco"}
    assert "expected 1 … 8" in reasons["streams"]
    assert "splatpipe[bench]" in reasons["draco"]
    assert not {"streams", "draco"} & set(rows_of(results))
    print_codecs(results, Console(width=200))
    assert "draco: left out" in capsys.readouterr().out


def test_draco_gives_the_same_points(results):
    pytest.importorskip("DracoPy", reason="the bench extra is not installed")
    row = rows_of(results)["draco"]
    assert row["failed"] is None
    assert row["error"] == rows_of(results)["ci"]["error"]

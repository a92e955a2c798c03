"""The rasterizer benchmark, on a small cloud."""

import json

import pytest
from rich.console import Console
from splatpipe.cluster.bench.raster import ONE_PIXEL, SHUFFLED_BATCHES, bench_raster, print_raster
from splatpipe.cluster.bench.roofline import bench_roofline, print_roofline
from splatpipe.nodes.raster import gl_context
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.shared.errors import DeviceError


def test_every_row_reports_speed_with_its_error():
    results = bench_raster(20_000, size=64, repeats=3, rasterizers=("cpu", "numpy"))
    assert json.loads(json.dumps(results)) == results
    assert [(row["rasterizer"], row["order"]) for row in results["rows"]] == [
        (name, order)
        for order in ("morton", "stored", "random", SHUFFLED_BATCHES, ONE_PIXEL)
        for name in ("cpu", "numpy")
    ]
    for row in results["rows"]:
        assert row["frames"] == 3
        assert (row["foreground_px"] == 1) == (row["order"] == ONE_PIXEL)
        assert row["differing_share"] is None or row["differing_share"] <= 0.005


def test_compact_positions_are_a_contestant():
    rows = bench_raster(20_000, size=64, repeats=3, rasterizers=("cpu compact",))["rows"]
    assert {row["rasterizer"] for row in rows} == {"cpu compact"}
    assert all(row["differing_share"] is None or row["differing_share"] <= 0.15 for row in rows)


def test_roofline_names_the_slowest_part(monkeypatch, capsys):
    monkeypatch.setattr("splatpipe.cluster.bench.roofline.SIZES", ((64, 48), (33, 70)))
    results = bench_roofline(20_000, repeats=3)
    assert json.loads(json.dumps(results)) == results
    assert len(results["rows"]) == 2 * 6 * 2
    for row in results["rows"]:
        parts = {part: ms["median"] for part, ms in row["parts_ms"].items()}
        assert parts[row["limit"]] == max(parts.values())
        assert min(parts.values()) > 0
        most = 12 if "one colour" in row["order"] else 16
        assert row["bytes_per_point"] == most or row["positions"] == "compact"
        assert most - 8 <= row["bytes_per_point"] <= most
    print_roofline(results, Console(width=200))
    assert "33×70" in capsys.readouterr().out


def test_what_cannot_run_is_left_out_with_its_reason(monkeypatch, capsys):
    def no_driver(_device_index):
        raise DeviceError("OpenGL: no driver here")

    monkeypatch.setattr(gl_context, "open_context", no_driver)
    results = bench_raster(2_000, size=16, repeats=3, rasterizers=("gl", "cpu"))
    assert results["omitted"] == [{"rasterizer": "gl", "reason": "OpenGL: no driver here"}]
    assert {row["rasterizer"] for row in results["rows"]} == {"cpu"}
    print_raster(results, Console(width=200))
    printed = capsys.readouterr().out
    assert "gl: left out, OpenGL: no driver here" in printed
    assert ONE_PIXEL in printed


@pytest.mark.gl
@pytest.mark.skipif(not gl_available()[0], reason=gl_available()[1])
def test_vtk_draws_the_same_picture():
    pytest.importorskip("vtk", reason="the bench extra is not installed")
    results = bench_raster(20_000, size=64, repeats=3, rasterizers=("vtk",))
    assert results["rows"][0]["differing_share"] < 0.1

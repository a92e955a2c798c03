"""``splatpipe bench budget`` on a few cells: what is held and sent, the same pictures, what is printed, without OpenGL."""

import json

import numpy as np
import pytest
from rich.console import Console
from splatpipe.cluster import cli
from splatpipe.cluster.bench import budget
from splatpipe.cluster.bench.budget import bench_budget, print_budget
from splatpipe.nodes.raster.gl import GlComputeRasterizer
from splatpipe.nodes.raster.gl_context import gl_available
from splatpipe.shared.errors import DeviceError
from test_raster_gl import N_POINTS, SOME, camera, points  # noqa: F401 (a fixture)
from typer.testing import CliRunner

AVAILABLE, REASON = gl_available()
SMALL = {"bits": 5, "most_cells": 5, "points_per_cell": 4000, "n_default": 12_000, "size": 64, "repeats": 2}


@pytest.fixture(scope="module")
def results():
    return bench_budget([], **SMALL)


@pytest.mark.gl
@pytest.mark.skipif(not AVAILABLE, reason=REASON)
class TestOnDevice:
    def test_every_way_has_the_same_device_memory_and_sends_the_rest(self, results):
        json.dumps(results, allow_nan=False)
        assert [row["rasterizer"] for row in results["rows"]] == ["gl", "gl-points"]
        for row in results["rows"]:
            n, ways, held = row["points"], row["ways"], row["pool_bytes"]
            assert 0.3 < row["coverage"] < 1
            assert ways["float32"]["bytes"] == 16 * n
            assert ways["pools"]["bytes"] < ways["grid"]["bytes"] < ways["float32"]["bytes"]
            assert ways["pools"]["sent_bytes"] == pytest.approx(5 * (1 - row["coverage"]) * n, abs=4)
            for name, step in (("float32", 16), ("grid", 5)):
                assert held - step < ways[name]["bytes"] - ways[name]["sent_bytes"] <= held + 3
            assert set(row["gain"]) == {"float32", "grid"}
            frame = {name: way["frame_ms"]["min"] for name, way in ways.items()}
            assert all(ms > 0 for ms in frame.values())

    def test_every_way_draws_the_same_points(self, results):
        for row in results["rows"]:
            drawn = [way["foreground_px"] for way in row["ways"].values()]
            assert min(drawn) > 500
            assert abs(drawn[1] - drawn[2]) <= 2  # one rounding and another
            assert abs(drawn[0] - drawn[2]) <= 0.05 * drawn[2]  # as stored, and in the middle of a bin

    def test_the_papers_figures_are_printed_beside_ours(self, results, capsys):
        print_budget(results, Console(width=160))
        printed = capsys.readouterr().out
        assert printed.count("(paper: 17%–32%)") == 4
        assert f"{results['rows'][0]['gain']['float32']:+.0%} frames/s" in printed

    def test_what_is_sent_again_is_what_was_there(self, points):  # noqa: F811
        with GlComputeRasterizer(points, 160, 100) as rasterizer:
            expected = rasterizer.draw(camera(), SOME).copy()
            sent = rasterizer.points_sent(N_POINTS - 100)
            assert sent.n_bytes == 1600
            assert rasterizer.points_sent(0).n_bytes == rasterizer.resident_bytes
            assert rasterizer.points_sent(N_POINTS).n_bytes == rasterizer.loose_sent(0).n_bytes == 0
            with rasterizer._context:
                for column in rasterizer._points.chunks[0]:
                    column.write(bytes(400), offset=column.size - 400)
            lost = rasterizer.draw(camera(), SOME).copy()
            sent.send()
            np.testing.assert_array_equal(rasterizer.draw(camera(), SOME), expected)
            assert (lost != expected).any()


def test_without_opengl_it_is_one_line(monkeypatch):
    def refuse(what):
        raise DeviceError(f"{what}: OpenGL: moderngl is not installed")

    monkeypatch.setattr(budget, "require_gl", refuse)
    found = CliRunner().invoke(cli.app, ["bench", "budget"])
    assert isinstance(found.exception, DeviceError)
    assert "bench budget: OpenGL" in str(found.exception)


@pytest.mark.parametrize(
    ("draw_ms", "sent", "rate"),
    [
        ((10.0, 10.0), (10_000_000, 2_000_000), (10e6 - 1.17 * 2e6) / (0.17 * 0.010)),
        ((20.0, 10.0), (10_000_000, 2_000_000), None),  # faster by drawing alone
        ((10.0, 10.0), (2_000_000, 2_000_000), None),  # sends as much
    ],
)
def test_the_rate_at_which_the_papers_gain_is_reached(draw_ms, sent, rate):
    other, ours = ({"draw_ms": {"median": d}, "sent_bytes": s} for d, s in zip(draw_ms, sent, strict=True))
    found = budget._rate_for_gain(other, ours, 0.17)
    assert found == pytest.approx(rate) if rate else found is None
    if rate:
        times = [d * 1e-3 + s / rate for d, s in zip(draw_ms, sent, strict=True)]
        assert times[0] / times[1] == pytest.approx(1.17)

"""``splatpipe bench codecs --sizes``: rows of every form, every point drawn, crossovers, caches as the system tells them."""

import json

import numpy as np
import pytest
from splatpipe.cluster import cli
from splatpipe.cluster.bench import codec_sizes
from splatpipe.cluster.bench.codec_sizes import bench_sizes, cache_bytes, crossovers
from splatpipe.shared.errors import InputError
from typer.testing import CliRunner

FORMS = ["float32", "10-bit fixed point", "pools", "groups"]


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    monkeypatch.setattr(codec_sizes, "_GENERATED_POINTS", 4000)
    monkeypatch.setattr(codec_sizes, "_POINTS_PER_CELL", 1000)


def test_a_table_of_sizes_and_forms(tmp_path):
    path = tmp_path / "sizes.json"
    arguments = ["bench", "codecs", "--sizes", "0.02,0.005", "--bits", "5", "--size", "64", "--repeats", "2"]
    found = CliRunner().invoke(cli.app, [*arguments, "--json", str(path)])
    assert found.exit_code == 0, found.output
    results = json.loads(path.read_text())
    assert [row["form"] for row in results["rows"]] == 2 * FORMS
    points = [row["points"] for row in results["rows"]]
    assert len(set(points[:4])) == len(set(points[4:])) == 1
    assert 4000 < points[0] < 6000 < 18_000 < points[4] < 22_000
    for row in results["rows"]:
        assert row["ms"]["min"] <= row["ms"]["median"] <= row["ms"]["max"]
        assert row["gb_per_s"] == pytest.approx(row["bytes_read"] / row["ms"]["median"] / 1e6)
    per_point = {item["form"]: item["bytes_per_point"] for item in results["crossovers"]}
    assert per_point["float32"] == 16 > per_point["10-bit fixed point"] == 8 > per_point["pools"] > 1
    assert "float32: 16.00 bytes read a point" in found.output
    for form in FORMS[1:]:
        assert f"{form}: " in found.output


def test_every_form_draws_every_point_inside_the_image(monkeypatch):
    frames = []
    enter = codec_sizes.resident_frame

    def watched(points, camera, compact):
        m = camera.pixel_from_world
        place = points.block_origin[np.searchsorted(points.block_first_point, np.arange(len(points)), "right") - 1]
        u, v, w = ((np.column_stack([points.x, points.y, points.z]) + place) @ m[:, :3].T + m[:, 3]).T
        frames.append(
            ((w > camera.near) & (u >= 0) & (u < camera.width * w) & (v >= 0) & (v < camera.height * w)).all()
        )
        return enter(points, camera, compact)

    monkeypatch.setattr(codec_sizes, "resident_frame", watched)
    bench_sizes([], [0.0001, 0.01, 0.03], bits=5, size=64, repeats=1)
    assert frames == 6 * [True]


def test_wider_grids_leave_pools_out():
    results = bench_sizes([], [0.005], bits=9, size=64, repeats=1)
    assert [row["form"] for row in results["rows"]] == ["float32", "10-bit fixed point", "groups"]
    assert results["omitted"][0]["form"] == "pools"


@pytest.mark.parametrize(
    ("inputs", "sizes", "reason"), [([], [1e6], "GB free"), (["a.ply", "b.ply"], [1.0], "2 inputs")]
)
def test_what_cannot_be_measured_is_one_line(inputs, sizes, reason):
    with pytest.raises(InputError, match=reason):
        bench_sizes(inputs, sizes)


def rows(form, points, ratios):
    return [
        {"form": form, "points": n, "bytes_read": 4 * n, "times_float32": {"median": ratio}}
        for n, ratio in zip(points, ratios, strict=True)
    ]


def test_a_form_crosses_where_it_stays_faster():
    sizes = [1, 2, 4, 8]
    table = rows("float32", sizes, [1, 1, 1, 1]) + rows("a", sizes, [0.9, 1.1, 0.9, 0.8])
    table += rows("b", sizes, [0.9, 0.9, 0.9, 1.0]) + rows("c", sizes, [0.9] * 4)
    found = {item["form"]: item for item in crossovers(table, 40)}
    assert {form: item["faster_from"] for form, item in found.items()} == {"float32": None, "a": 4, "b": None, "c": 1}
    assert found["a"]["leaves_cache_at"] == 10
    assert crossovers(table, None)[0]["leaves_cache_at"] is None


def test_caches_of_two_sockets(tmp_path):
    def write(cpu, index, level, size, shared, kind="Unified"):
        folder = tmp_path / f"cpu{cpu}" / "cache" / f"index{index}"
        folder.mkdir(parents=True)
        for name, text in {"level": level, "size": size, "shared_cpu_list": shared, "type": kind}.items():
            (folder / name).write_text(f"{text}\n")

    for cpu in range(4):
        write(cpu, 0, 1, "48K", cpu)
        write(cpu, 3, 3, "2048K", "0-1" if cpu < 2 else "2-3")
    (tmp_path / "cpu9" / "cache" / "index0").mkdir(parents=True)
    assert cache_bytes(tmp_path) == 2 * 2048 * 1024
    assert cache_bytes(tmp_path / "nothing") is None

"""``splatpipe bench lod`` on small scenes: more points a pixel are fewer holes; scenes are made once; options are checked."""

import pytest
from splatpipe.cluster.bench.lod import bench_lod, print_lod
from splatpipe.cluster.cli import parse_numbers
from splatpipe.shared.errors import InputError
from splatpipe.shared.synth.sphere import SphereScan


def test_points_buy_coverage(tmp_path, capsys):
    settings = {"width": 160, "height": 90, "densities": (0.5, 4.0), "frames": 2, "error_frames": 2}
    results = bench_lod(60_000, **settings, workdir=tmp_path, surfaces=("sphere",))
    built = (tmp_path / "sphere-60000.scene" / "scene.json").stat().st_mtime_ns
    for path in ("orbit", "fly"):
        few, many = (row for row in results["rows"] if row["path"] == path)
        assert few["points_drawn"] < many["points_drawn"]
        assert min(error["holes"] for error in few["errors"]) > max(error["holes"] for error in many["errors"])
        assert few["errors"][0]["psnr_db"] < many["errors"][0]["psnr_db"]
        assert many["bytes_drawn"] == 16 * many["points_drawn"]

    from rich.console import Console

    print_lod(results, Console(width=200))
    assert "frames/s" in capsys.readouterr().out
    bench_lod(60_000, **settings, workdir=tmp_path, surfaces=("sphere",))
    assert (tmp_path / "sphere-60000.scene" / "scene.json").stat().st_mtime_ns == built


def test_sphere_is_the_same_for_any_batches():
    source = SphereScan(70_000)
    whole, parts = (list(source.batches(n)) for n in (70_000, 1000))
    assert len(parts) > len(whole)
    assert b"".join(p.positions.tobytes() for p in parts) == b"".join(w.positions.tobytes() for w in whole)
    with pytest.raises(InputError, match="n_points = 0"):
        SphereScan(0)


@pytest.mark.parametrize("text", ["", "1,x", "0", "-1", "nan", "1,2,3"])
def test_numbers_of_options_are_checked(text):
    with pytest.raises(InputError, match="--size"):
        parse_numbers(text, "--size", 2)

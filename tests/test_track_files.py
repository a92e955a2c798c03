"""Files of tracks: what is read, what is said, what is refused."""

import subprocess
import sys
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.nodes.layers.expand_trajectories import segments
from splatpipe.shared.errors import InputError
from splatpipe.shared.layers.layer_store import open_layer
from splatpipe.shared.layers.readers.tracks import KNOT, TrackRules, trajectories_from_file
from splatpipe.shared.layers.trajectories import NODE

GPX = """<?xml version="1.0"?>
<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><wpt lat="1" lon="2"><ele>7</ele><name>w</name></wpt>
<trk><name>Morning
 ride</name><trkseg>
<trkpt lat="46.0" lon="7.0"><ele>1000</ele><time>2024-05-01T12:00:00Z</time></trkpt>
<trkpt lat="46.001" lon="7.0"><time>2024-05-01T12:00:10Z</time><extensions><speed>3</speed></extensions></trkpt>
<trkpt lat="46.002" lon="7.0"><ele>1020</ele><time>2024-05-01T14:00:20.5+02:00</time></trkpt>
</trkseg><trkseg><trkpt lat="46.01" lon="7.01"><time>2024-05-01T13:00:00Z</time></trkpt></trkseg></trk>
<rte><name>R</name><rtept lat="46.0" lon="7.0"/></rte></gpx>
"""
CSV = """id,t,lon,lat,alt,speed
A,0,7.0,46.0,100,10
A,60,7.01,46.0,,
B,0,7.0,46.1,5,20
A,30,7.005,46.0,200,
B,,7.0,46.2,5,20
"""


def read(path, text=None, **rules):
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    layer, notes = trajectories_from_file(path, TrackRules(**rules))
    nodes = layer.elements[layer.elements["role"] == NODE]
    order = np.argsort(nodes["time"], kind="stable")
    return layer, nodes[order], "\n".join(notes)


def test_gpx_segments_become_trajectories_in_metres(tmp_path):
    layer, nodes, notes = read(tmp_path / "a.gpx", GPX)
    assert layer.parameters["names"] == ["Morning ride", "Morning ride #2", "R"]
    assert len(nodes) == 4
    np.testing.assert_allclose(nodes["time"], [0, 10, 20.5, 3600])
    heights = nodes["position"][:, 2] + layer.origin[2]
    np.testing.assert_allclose(heights[:3], [1000, 1000 + 20 * 10 / 20.5, 1020], atol=1e-3)
    assert nodes["speed"][1] == 3
    north = np.diff(nodes["position"][:3, 1])
    np.testing.assert_allclose(north, 111.15, rtol=1e-3)
    assert layer.parameters["middle_deg"] == pytest.approx([7.005, 46.005])
    for said in ("1 waypoints", "1 of 5 nodes", "longitude 7.005"):
        assert said in notes


def test_gpx_without_times_is_counted(tmp_path):
    text = "<gpx><trk><trkseg><trkpt lat='1' lon='1'/><trkpt lat='1.1' lon='1'/></trkseg></trk></gpx>"
    layer, nodes, notes = read(tmp_path / "a.gpx", text)
    assert "nodes are counted" in notes
    assert nodes["time"].tolist() == [0, 1]
    assert layer.parameters["names"] == ["trk1"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('<!DOCTYPE gpx [<!ENTITY a "b">]><gpx/>', "document type or an entity"),
        ('<!DOCTYPE gpx SYSTEM "file:///etc/passwd"><gpx/>', "document type or an entity"),
        ("<kml/>", "expected gpx"),
        ("<gpx>&a;</gpx>", "not valid XML"),
        ("<gpx><trk>", "not valid XML"),
        ("", "not valid XML"),
        ("<gpx/>", "no point"),
        ("<gpx><wpt lat='1' lon='1'/></gpx>", "1 waypoints"),
        ("<gpx><trkpt lat='1' lon='1'/></gpx>", "in none"),
        ("<gpx><trk><trkseg><trkpt lat='x' lon='1'/></trkseg></trk></gpx>", "line 1: lat"),
        ("<gpx><trk><trkseg><trkpt lon='1'/></trkseg></trk></gpx>", "line 1: lat"),
        ("<gpx><trk><trkseg><trkpt lat='91' lon='1'/></trkseg></trk></gpx>", "expected degrees"),
        ("<gpx><trk><trkseg><trkpt lat='1' lon='nan'/></trkseg></trk></gpx>", "line 1: lon"),
        ("<gpx><trk><trkseg><trkpt lat='1' lon='1'><time>now</time></trkpt></trkseg></trk></gpx>", "time: found 'now'"),
        ("<gpx>" + "<a>" * 100, "deep"),
        ("<?xml version='1.0' encoding='none'?><gpx/>", "not valid XML"),
    ],
)
def test_bad_gpx_is_one_line(tmp_path, text, said):
    with pytest.raises(InputError, match=said) as error:
        read(tmp_path / "a.gpx", text)
    assert "\n" not in str(error.value)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_mutated_gpx_is_read_or_refused(tmp_path_factory, data):
    content = bytearray(GPX.encode())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        cut = data.draw(st.integers(0, 8))
        content[at : at + cut] = data.draw(st.binary(max_size=6))
    path = tmp_path_factory.getbasetemp() / "mutated.gpx"
    path.write_bytes(content)
    with suppress(InputError):
        layer, nodes, _ = read(path)
        assert len(layer) > 0
        assert np.isfinite(nodes["position"]).all()


def test_tables_are_read_by_the_names_of_their_columns(tmp_path):
    pytest.importorskip("pyarrow")
    layer, nodes, notes = read(tmp_path / "a.csv", CSV)
    assert layer.parameters["names"] == ["A", "B"]
    assert len(nodes) == 4
    assert "1 of 5 nodes" in notes
    number = np.repeat(layer.objects["trajectory"], np.diff(layer.first_element))
    a = layer.elements[(number == 0) & (layer.elements["role"] == NODE)]
    assert a["time"].tolist() == [0, 30, 60]
    np.testing.assert_allclose(a["position"][:, 2] + layer.origin[2], [100, 200, 200])
    np.testing.assert_allclose(a["speed"], 10)
    assert (np.diff(a["position"][:, 0]) > 380).all()


def test_columns_units_and_radius_can_be_said(tmp_path):
    pytest.importorskip("pyarrow")
    text = "a,b,when,who,kmh\n0,0,2024-05-01 12:00:00,x,36\n10,0,2024-05-01 12:00:10,x,72\n"
    columns = {"x": "a", "y": "b", "time": "when", "id": "who", "speed": "kmh"}
    layer, nodes, _ = read(tmp_path / "a.csv", text, columns=columns, speed_unit="km/h", radius=2.5, gap_s=0.0)
    np.testing.assert_allclose(nodes["speed"], [10, 20], rtol=1e-6)
    assert layer.parameters["time_origin"] == 1714564800
    assert layer.parameters["radius"] == 2.5
    turned, *_ = read(tmp_path / "a.csv", columns=columns, degrees=True)
    assert "middle_deg" in turned.parameters
    with pytest.raises(InputError, match="column c: not found"):
        read(tmp_path / "a.csv", columns={"x": "c"})


def test_tracks_across_the_antimeridian_stay_short(tmp_path):
    pytest.importorskip("pyarrow")
    layer, *_ = read(tmp_path / "a.csv", "lon,lat,time\n179.9,0,0\n-179.9,0,10\n179.95,0,20\n")
    lower, upper = layer.bounds
    assert (upper - lower).max() < 30_000


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a,b\n1,2\n", "expected x and y, or lon and lat"),
        ("x,y\n", "no row"),
        ("x,y\n1,a\n", "column y: found"),
        ("x,y,time\n1,2,soon\n", "column time: found"),
        ("x,y\nnan,2\n", "no node with a position"),
        ("lon,lat\n1,100\n", "expected degrees"),
        ("x,y\n1e35,2\n", "position of node 0"),
        ("x,y\n1,2\n3\n", "cannot be read"),
        ("", "cannot be read"),
        (b"x,y,\xd4\n1,2,3\n", "cannot be read"),
        ('"x\ny",b\n1,2\n', "expected x and y"),
    ],
)
def test_bad_tables_are_one_line(tmp_path, text, said):
    pytest.importorskip("pyarrow")
    with pytest.raises(InputError, match=said) as error:
        read(tmp_path / "a.csv", text)
    assert "\n" not in str(error.value)


PLY = (
    "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    "property float groundspeed\nproperty float time\nproperty ushort flight\nend_header\n"
    "0 0 100 10 0 3\n10 0 nan nan 1 3\nnan 0 100 10 2 3\n30 0 100 30 3 3\n"
)


def test_ply_vertices_are_nodes_and_nan_is_missing(tmp_path):
    layer, nodes, notes = read(tmp_path / "a.ply", PLY)
    assert layer.parameters["names"] == ["3"]
    assert len(nodes) == 3
    np.testing.assert_allclose(nodes["speed"], np.array([10, 50 / 3, 30]) * KNOT, rtol=1e-6)
    np.testing.assert_allclose(nodes["position"][:, 2] + layer.origin[2], 100)
    for said in ("1 of 4 nodes", "missing in 1 of 4", "in kt"):
        assert said in notes
    with pytest.raises(InputError, match=r"a\.ply"):
        read(tmp_path / "a.ply", PLY[:-20])


@pytest.mark.parametrize(("name", "flights"), [("savan", 17), ("tour_de_france", 3)])
def test_real_flights(data_dir, name, flights):
    layer, nodes, _ = read(data_dir / "objects" / f"flights_{name}.ply")
    assert len(layer.parameters["names"]) == flights
    assert len(nodes) == {"savan": 188_196, "tour_de_france": 98_607}[name]
    assert nodes["speed"].max() < 800 * KNOT
    index = segments(layer).index
    length = np.linalg.norm(np.diff(layer.elements["position"][index[:, 1:3]], axis=1), axis=2)
    assert np.median(length) < 1000


def command(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "splatpipe.cluster", "layer", "trajectories", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=60,
    )


def test_the_command_makes_a_layer_or_one_line(tmp_path):
    (tmp_path / "a.gpx").write_text(GPX)
    done = command(tmp_path / "a.gpx", "-o", tmp_path / "a.layer")
    assert done.returncode == 0, done.stderr
    assert "trajectories: 3, nodes: 4" in done.stdout
    assert open_layer(tmp_path / "a.layer").kind == "trajectories"
    for options, said in (
        (["--column", "w=a"], "--column w=a: expected ROLE=NAME"),
        (["--speed-unit", "c"], "--speed-unit c: expected"),
        (["--radius", "-1"], "--radius: found -1"),
        (["--overwrite", "--gap", "nan"], "--gap: found nan"),
    ):
        done = command(tmp_path / "a.gpx", "-o", tmp_path / "b.layer", *options)
        assert done.returncode == 2
        assert said in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "b.layer").exists()

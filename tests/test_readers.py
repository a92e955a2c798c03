"""Round trips of generated files of every format, and the rules that all readers share."""

import sys
from pathlib import Path

import numpy as np
import pytest
from reader_files import write_e57, write_las, write_pcd, write_ply, write_ply_lists, write_text
from splatpipe.shared.errors import InputError
from splatpipe.shared.points import ATTRIBUTES, concatenate, pack_rgb, unpack_normals, unpack_rgb
from splatpipe.shared.readers import expand_inputs, open_source
from splatpipe.shared.readers.columns import ColourRange

N = 1000
FAR = np.array([6.4e6, -1.2e6, 300.0])


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture
def cloud(rng):
    """Columns of N points far from the origin, positions on a millimetre grid."""
    normals = rng.normal(size=(N, 3))
    return {
        "positions": np.round(FAR + rng.random((N, 3)) * 100, 3),
        "colours": rng.integers(0, 256, (N, 3), np.uint8),
        "normals": normals / np.linalg.norm(normals, axis=1)[:, None],
        "intensity": rng.integers(0, 65536, N).astype(np.uint16),
        "classification": rng.integers(0, 32, N).astype(np.uint8),
        "return_number": rng.integers(1, 6, N).astype(np.uint8),
        "gps_time": rng.random(N) * 1e9,
    }


def read(path, max_points=333, attributes=None):
    source = open_source(path)
    batches = [batch.check() for batch in source.batches(max_points, attributes)]
    assert all(0 < len(batch) <= max_points for batch in batches)
    whole = concatenate(batches)
    assert source.info.n_points in (None, len(whole))
    if attributes is None:
        assert tuple(whole.attributes) == source.info.attributes
    assert source.info.attributes == tuple(a for a in ATTRIBUTES if a in source.info.attributes)
    return source.info, whole


def records(cloud, *, kind="f8", names=("nx", "ny", "nz", "red", "green", "blue", "intensity")):
    groups = {"n": cloud["normals"], "c": cloud["colours"]}
    parts = {
        **dict(zip(("nx", "ny", "nz"), groups["n"].T.astype("f4"), strict=True)),
        **dict(zip(("red", "green", "blue"), groups["c"].T, strict=True)),
        "intensity": cloud["intensity"],
    }
    dtype = [(axis, kind) for axis in "xyz"] + [(name, parts[name].dtype) for name in names]
    out = np.zeros(len(cloud["positions"]), dtype)
    for i, axis in enumerate("xyz"):
        out[axis] = cloud["positions"][:, i]
    for name in names:
        out[name] = parts[name]
    return out


def same_attributes(batch, cloud):
    np.testing.assert_array_equal(unpack_rgb(batch.attributes["rgb"])[:, :3], cloud["colours"])
    np.testing.assert_array_equal(batch.attributes["intensity"], cloud["intensity"].astype(np.float32))
    np.testing.assert_allclose(unpack_normals(batch.attributes["normal"]), cloud["normals"], atol=1e-4)


@pytest.mark.parametrize("suffix", ["las", "laz"])
@pytest.mark.parametrize("point_format", [0, 1, 2, 3, 6, 7, 8])
def test_las_and_laz(tmp_path, cloud, suffix, point_format):
    columns = {k: cloud[k] for k in ("intensity", "classification", "return_number")}
    if point_format in (1, 3, 6, 7, 8):
        columns["gps_time"] = cloud["gps_time"]
    if point_format in (2, 3, 7, 8):
        columns |= dict(zip(("red", "green", "blue"), cloud["colours"].T.astype(np.uint16) << 8, strict=True))
    path = write_las(tmp_path / f"a.{suffix}", cloud["positions"], point_format=point_format, **columns)
    info, batch = read(path)
    assert info.format == suffix
    assert set(info.attributes) == {*columns, "rgb"} - {"red", "green", "blue"} - ({"rgb"} - {*info.attributes})
    assert ("rgb" in info.attributes) == ("red" in columns)
    np.testing.assert_allclose(batch.positions, cloud["positions"], rtol=0, atol=1e-6)
    np.testing.assert_allclose(info.lower, cloud["positions"].min(axis=0), rtol=0, atol=1e-3)
    np.testing.assert_allclose(info.upper, cloud["positions"].max(axis=0), rtol=0, atol=1e-3)
    for name in {*columns} & {*ATTRIBUTES}:
        np.testing.assert_array_equal(batch.attributes[name], cloud[name].astype(ATTRIBUTES[name]))
    if "rgb" in info.attributes:
        np.testing.assert_array_equal(batch.attributes["rgb"], pack_rgb(*cloud["colours"].T))


@pytest.mark.parametrize("suffix", ["las", "laz"])
def test_las_matches_laspy_bit_by_bit(tmp_path, rng, suffix):
    import laspy

    path = write_las(tmp_path / f"a.{suffix}", FAR + rng.random((70_000, 3)) * 1000, point_format=7, scale=0.00025)
    _, batch = read(path, 30_011)
    np.testing.assert_array_equal(batch.positions, laspy.read(path).xyz)


def test_eight_bit_colours_in_sixteen_bit_fields(tmp_path, cloud):
    channels = dict(zip(("red", "green", "blue"), cloud["colours"].T.astype(np.uint16), strict=True))
    _, batch = read(write_las(tmp_path / "a.las", cloud["positions"], **channels))
    np.testing.assert_array_equal(batch.attributes["rgb"], pack_rgb(*cloud["colours"].T))


def test_black_throughout_means_no_colours(tmp_path, cloud):
    assert "rgb" not in read(write_las(tmp_path / "a.las", cloud["positions"]))[0].attributes


@pytest.mark.parametrize(
    ("values", "bytes_"),
    [
        (np.array([0.0, 0.5, 1.0, np.nan]), [0, 128, 255, 0]),
        (np.array([0.0, 127.5, 254.0, 300.0], np.float32), [0, 128, 254, 255]),
        (np.array([0, 255, 256, 65535], np.uint16), [0, 0, 1, 255]),
        (np.array([0, 255, 256, 65535], ">u2"), [0, 0, 1, 255]),
        (np.array([-1, 3, 200], np.int32), [0, 3, 200]),
        (np.array([0, 1, 1], np.uint8), [0, 1, 1]),
    ],
)
def test_colour_ranges(values, bytes_):
    sample = values[values <= 255] if 300.0 in values else values
    np.testing.assert_array_equal(ColourRange.of(sample).to_bytes(values), bytes_)


@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, "<"), (False, ">")])
def test_ply(tmp_path, cloud, text, order):
    path = write_ply(tmp_path / "a.ply", {"vertex": records(cloud)}, text=text, order=order)
    info, batch = read(path)
    assert info.format == "ply"
    np.testing.assert_array_equal(batch.positions, cloud["positions"])
    same_attributes(batch, cloud)


@pytest.mark.parametrize(("text", "order"), [(True, "<"), (False, "<"), (False, ">")])
def test_ply_with_lists_and_elements_before_the_vertices(tmp_path, text, order):
    face = np.array([([0, 1, 2], 7), ([3], 8), ([], 9)], [("vertex_indices", object), ("id", "u1")])
    camera = np.array([(1.5,), (2.5,)], [("focal", "f8")])
    vertex = np.zeros(5, [("x", "f4"), ("neighbours", object), ("y", "f8"), ("z", "i4"), ("intensity", "f4")])
    for i in range(5):
        vertex[i] = (i, list(range(i)), i / 3, -i, 2 * i)
    plain = vertex[["x", "y", "z", "intensity"]]
    expected = np.column_stack([vertex[axis].astype(np.float64) for axis in "xyz"])
    for elements in ({"camera": camera, "vertex": vertex, "face": face}, {"face": face, "vertex": plain}):
        path = write_ply_lists(tmp_path / "a.ply", elements, text=text, order=order)
        _, batch = read(path, 2)
        np.testing.assert_allclose(batch.positions, expected, rtol=1e-15)
        np.testing.assert_array_equal(batch.attributes["intensity"], vertex["intensity"])


@pytest.mark.parametrize("newline", [b"\n", b"\r\n", b"\r"])
def test_ply_header_line_ends(tmp_path, newline):
    lines = [b"ply", b"format binary_little_endian 1.0", b"comment end_header", b"element vertex 1"]
    lines += [b"property double " + axis for axis in (b"x", b"y", b"z")]
    path = tmp_path / "a.ply"
    data = np.array([2.56e-322, 0.0, 3.0]).tobytes()
    path.write_bytes(newline.join([*lines, b"end_header", b""]) + data)
    np.testing.assert_array_equal(read(path)[1].positions, [[2.56e-322, 0.0, 3.0]])


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd(tmp_path, cloud, encoding):
    table = records(cloud, names=("intensity",))
    dtype = [
        *table.dtype.descr,
        ("_", "u1", (3,)),
        ("rgb", "f4"),
        ("normal_x", "f4"),
        ("normal_y", "f4"),
        ("normal_z", "f4"),
    ]
    packed = np.zeros(N, dtype)
    for name in table.dtype.names:
        packed[name] = table[name]
    r, g, b = cloud["colours"].astype(np.uint32).T
    packed["rgb"] = (r << 16 | g << 8 | b).view(np.float32)
    for axis, normal in zip("xyz", cloud["normals"].T, strict=True):
        packed[f"normal_{axis}"] = normal
    packed["x"][:3] = np.nan
    path = write_pcd(tmp_path / "a.pcd", packed, encoding, width=100)
    info, batch = read(path)
    assert info.format == "pcd"
    np.testing.assert_array_equal(batch.positions[3:], cloud["positions"][3:])
    assert np.isnan(batch.positions[:3, 0]).all()
    same_attributes(batch, cloud)


def test_pcd_unsigned_colours(tmp_path):
    table = np.array([(1, 2, 3, 0xFF102030)], [("x", "f4"), ("y", "f4"), ("z", "f4"), ("rgba", "u4")])
    for encoding in ("ascii", "binary", "binary_compressed"):
        _, batch = read(write_pcd(tmp_path / "a.pcd", table, encoding))
        np.testing.assert_array_equal(unpack_rgb(batch.attributes["rgb"]), [[0x10, 0x20, 0x30, 255]])


@pytest.mark.parametrize(
    ("header", "delimiter"),
    [
        ("x,y,z,nx,ny,nz,R,G,B,Intensity", ","),
        ("//X Y Z Nx Ny Nz Red Green Blue i", " "),
        ('"x";"y";"z";nx;ny;nz;r;g;b;"intensity"', " ; "),
    ],
)
def test_text_with_header(tmp_path, cloud, header, delimiter):
    columns = np.column_stack([cloud["positions"], cloud["normals"], cloud["colours"], cloud["intensity"]])
    info, batch = read(write_text(tmp_path / "a.csv", columns, header=header, delimiter=delimiter))
    assert info.format == "text"
    np.testing.assert_array_equal(batch.positions, cloud["positions"])
    same_attributes(batch, cloud)


@pytest.mark.parametrize(
    ("extra", "attributes"),
    [
        ([], ()),
        (["intensity"], ("intensity",)),
        (["colours"], ("rgb",)),
        (["normals"], ("normal",)),
        (["intensity", "colours"], ("rgb", "intensity")),
        (["intensity", "gps_time"], ()),
    ],
)
def test_columns_without_names(tmp_path, cloud, extra, attributes):
    columns = np.column_stack([cloud["positions"], *(cloud[name] for name in extra)])
    np.save(tmp_path / "a.npy", columns)
    np.save(tmp_path / "f.npy", np.asfortranarray(columns))
    for path in (write_text(tmp_path / "a.xyz", columns), tmp_path / "a.npy", tmp_path / "f.npy"):
        info, batch = read(path)
        assert info.attributes == attributes
        np.testing.assert_array_equal(batch.positions, cloud["positions"])
        if "rgb" in attributes:
            np.testing.assert_array_equal(batch.attributes["rgb"], pack_rgb(*cloud["colours"].T))


def test_pts_count_line(tmp_path, cloud):
    columns = np.column_stack([cloud["positions"], cloud["intensity"], cloud["colours"]])
    info, batch = read(write_text(tmp_path / "a.pts", columns, header=str(N)))
    assert info.n_points == N
    np.testing.assert_array_equal(batch.attributes["rgb"], pack_rgb(*cloud["colours"].T))


def test_structured_npy(tmp_path, cloud):
    plain = records(cloud)
    np.save(tmp_path / "a.npy", plain)
    nested = np.zeros(
        N,
        [("id", "S4"), ("position", "f8", (3,)), ("colors", "u1", (4,)), ("normals", "f4", (3,)), ("intensity", "u2")],
    )
    nested["position"], nested["colors"][:, :3] = cloud["positions"], cloud["colours"]
    nested["normals"], nested["intensity"] = cloud["normals"], cloud["intensity"]
    np.save(tmp_path / "b.npy", nested)
    for path in (tmp_path / "a.npy", tmp_path / "b.npy"):
        _, batch = read(path)
        np.testing.assert_array_equal(batch.positions, cloud["positions"])
        same_attributes(batch, cloud)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_npz(tmp_path, cloud, save):
    path = tmp_path / "a.npz"
    save(
        path,
        xyz=np.asfortranarray(cloud["positions"]),
        colors=cloud["colours"] / 255.0,
        normals=cloud["normals"],
        intensity=cloud["intensity"],
        gps_time=cloud["gps_time"],
        unrelated=np.arange(3),
    )
    _, batch = read(path)
    np.testing.assert_array_equal(batch.positions, cloud["positions"])
    np.testing.assert_array_equal(batch.attributes["gps_time"], cloud["gps_time"])
    same_attributes(batch, cloud)


def test_e57_scans_are_placed_by_their_poses(tmp_path, rng):
    pytest.importorskip("pye57", reason="the e57 extra is not installed")
    local = rng.random((2, 50, 3))
    colours = rng.integers(1, 256, (2, 50, 3), np.uint8)
    turn = [np.cos(0.5), 0.0, 0.0, np.sin(0.5)]  # one radian about z
    scans = [
        {
            **dict(zip(("cartesianX", "cartesianY", "cartesianZ"), local[i].T.copy(), strict=True)),
            **dict(zip(("colorRed", "colorGreen", "colorBlue"), colours[i].T.copy(), strict=True)),
            "intensity": rng.random(50).astype(np.float32),
            "rotation": rotation,
            "translation": translation,
        }
        for i, (rotation, translation) in enumerate([([1.0, 0, 0, 0], [0.0, 0, 0]), (turn, list(FAR))])
    ]
    info, batch = read(write_e57(tmp_path / "a.e57", scans), 33)
    c, s = np.cos(1.0), np.sin(1.0)
    turned = local[1] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + FAR
    assert info.attributes == ("rgb", "intensity")
    np.testing.assert_allclose(batch.positions, np.concatenate([local[0], turned]), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(unpack_rgb(batch.attributes["rgb"])[:, :3], colours.reshape(-1, 3))


def test_e57_without_its_library_says_what_to_install(tmp_path, monkeypatch):
    path = tmp_path / "a.e57"
    path.write_bytes(b"ASTM-E57" + bytes(2040))
    monkeypatch.setitem(sys.modules, "pye57.libe57", None)
    with pytest.raises(InputError, match=r"pip install 'splatpipe\[e57\]'"):
        open_source(path)


def test_only_wanted_attributes(tmp_path, cloud):
    paths = [
        write_las(tmp_path / "a.laz", cloud["positions"], point_format=7, red=cloud["intensity"]),
        write_ply(tmp_path / "a.ply", {"vertex": records(cloud)}),
    ]
    for path in paths:
        _, whole = read(path)
        _, batch = read(path, attributes=["rgb", "return_number", "no such column"])
        assert {*batch.attributes} == {"rgb", "return_number"} & {*whole.attributes}
        for name, column in batch.attributes.items():
            np.testing.assert_array_equal(column, whole.attributes[name])
        np.testing.assert_array_equal(batch.positions, whole.positions)


def test_batches_can_be_read_again_and_are_independent(tmp_path, cloud):
    source = open_source(write_las(tmp_path / "a.las", cloud["positions"]))
    first, second = list(source.batches(400)), list(source.batches(400))
    assert [len(b) for b in first] == [400, 400, 200]
    np.testing.assert_array_equal(concatenate(first).positions, concatenate(second).positions)
    assert not np.shares_memory(first[0].positions, first[1].positions)


def test_format_is_told_by_content_before_extension(tmp_path, cloud):
    path = write_ply(tmp_path / "a.ply", {"vertex": records(cloud)})
    assert open_source(path.rename(tmp_path / "a.las")).info.format == "ply"


def test_non_finite_positions_are_passed_on(tmp_path):
    positions = np.array([[0, 0, 0], [np.nan, 1, 2], [np.inf, -np.inf, 3]])
    np.save(tmp_path / "a.npy", positions)
    for path in (tmp_path / "a.npy", write_text(tmp_path / "a.xyz", positions)):
        np.testing.assert_array_equal(read(path)[1].positions, positions)


class TestExpandInputs:
    @pytest.fixture
    def folder(self, tmp_path, monkeypatch):
        (tmp_path / "tiles" / "deep").mkdir(parents=True)
        for name in ("b.las", "a.LAZ", "readme.md", "deep/c.xyz"):
            (tmp_path / "tiles" / name).touch()
        (tmp_path / "odd[1].las").touch()
        (tmp_path / "points.dat").touch()
        monkeypatch.chdir(tmp_path)
        return tmp_path

    @pytest.mark.parametrize(
        ("patterns", "expected"),
        [
            (["tiles"], ["tiles/a.LAZ", "tiles/b.las"]),
            (["tiles/*"], ["tiles/a.LAZ", "tiles/b.las"]),
            (["tiles/**"], ["tiles/a.LAZ", "tiles/b.las", "tiles/deep/c.xyz"]),
            (["tiles/b.las", "tiles", "./tiles/../tiles/b.las"], ["tiles/a.LAZ", "tiles/b.las"]),
            (["odd[1].las", "points.dat"], ["odd[1].las", "points.dat"]),
        ],
    )
    def test_matches(self, folder, patterns, expected):
        assert expand_inputs(patterns) == [Path(p) for p in expected]

    @pytest.mark.parametrize("pattern", ["missing.las", "*.e57", "tiles/deep/*.las", "tiles/*.md"])
    def test_nothing_found_names_the_pattern(self, folder, pattern):
        with pytest.raises(InputError) as caught:
            expand_inputs(["tiles", pattern])
        assert str(caught.value).startswith(pattern)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "format_", "n_points", "attributes"),
    [
        ("formats/lone-star.copc.laz", "copc", 518_862, "intensity classification return_number gps_time"),
        ("formats/lion_takanawa.copc.laz", "copc", 341_989, "rgb intensity classification return_number gps_time"),
        ("formats/zurich.laz", "laz", 656_837, "intensity classification return_number gps_time"),
        ("formats/rand1_6.las", "las", 50_000, "intensity classification return_number gps_time"),
        ("formats/certainty3d-color-utm-feet-navd88.las", "las", 10_126, None),
        ("formats/CSite1_red1-utm.pcd", "pcd", 522_674, ""),
        ("formats/region_growing_rgb_tutorial.pcd", "pcd", 307_200, "rgb"),
        ("formats/horse_big_endian.ply", "ply", 48_485, "rgb"),
        ("formats/fragment_002.ply", "ply", 112_698, "rgb"),
        ("formats/car_cloud400.csv", "text", 24_989, "normal"),
        ("formats/pumpAVisualReferenceImage.e57", "e57", 155_201, "rgb intensity"),
        ("scans/potree-lion_takanawa_normals_rgb.ply", "ply", 341_989, "rgb normal"),
        ("scans/stanford-dragon_stand_rangescans.ply", "ply", 469_193, "normal"),
        ("models/stanford-bunny_35947.ply", "ply", 35_947, "normal intensity"),
    ],
)
def test_real_files(data_dir, name, format_, n_points, attributes):
    info, batch = read(data_dir / name, 100_000)
    assert (info.format, len(batch)) == (format_, n_points)
    if attributes is not None:
        assert info.attributes == tuple(attributes.split())
    if "rgb" in info.attributes:
        assert unpack_rgb(batch.attributes["rgb"])[:, :3].mean() > 30  # a range taken too wide gives near black


@pytest.mark.data
def test_organised_cloud_keeps_its_missing_points(data_dir):
    _, batch = read(data_dir / "formats" / "region_growing_rgb_tutorial.pcd", 50_000)
    assert np.isnan(batch.positions).any(axis=1).sum() == 47_353


@pytest.mark.data
def test_airborne_survey(data_dir):
    source = open_source(data_dir / "scans" / "autzen_10.65M_stateplane_ft_rgb.laz")
    assert source.info.n_points == 10_653_336
    assert source.info.crs.startswith("PROJCS")
    batch = next(source.batches(100_000, ["rgb"]))
    assert 60 < unpack_rgb(batch.attributes["rgb"])[:, :3].mean() < 200  # 0…255 in 16-bit fields


@pytest.mark.data
def test_every_las_file_matches_laspy(data_dir):
    import laspy

    files = sorted((data_dir / "formats").glob("*.la[sz]"))
    assert len(files) > 15
    for path in files:
        _, batch = read(path, 40_000)
        las = laspy.read(path)
        np.testing.assert_array_equal(batch.positions, las.xyz)
        for name in ("intensity", "classification", "return_number"):
            np.testing.assert_array_equal(batch.attributes[name], np.asarray(las[name]))
        if "gps_time" in batch.attributes:
            np.testing.assert_array_equal(batch.attributes["gps_time"], las.gps_time)

"""No file may crash, hang or exhaust memory: each gives points, or one line that names it."""

import io
import random
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest
from reader_files import write_e57, write_las, write_pcd, write_ply, write_text
from splatpipe.shared.errors import InputError
from splatpipe.shared.readers import open_source

N = 200
HUGE = 10**12


def outcome(path):
    """Points read, or the message of the InputError; anything else fails the test."""
    try:
        return sum(len(batch.check()) for batch in open_source(path).batches(100_000))
    except InputError as error:
        message = str(error)
        assert message.startswith(f"{path}: ")
        assert "\n" not in message
        return message


def make(folder, kind):
    rng = np.random.default_rng(3)
    positions = rng.random((N, 3)) * 100
    table = np.zeros(N, [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
    for i, axis in enumerate("xyz"):
        table[axis] = positions[:, i]
    table["red"] = np.arange(N) % 256
    path = folder / kind
    match kind:
        case "3.las" | "3.laz" | "7.las" | "7.laz":
            return write_las(path, positions, point_format=int(kind[0]), red=np.arange(N) * 300)
        case "ascii.ply" | "binary.ply":
            return write_ply(path, {"vertex": table}, text=kind == "ascii.ply")
        case "ascii.pcd" | "binary.pcd" | "binary_compressed.pcd":
            return write_pcd(path, table, path.stem)
        case "a.pts":
            return write_text(path, positions, header=str(N))
        case "a.npy":
            np.save(path, positions)
        case "c.npz":
            np.savez_compressed(path, xyz=positions, colors=table["red"][:, None].repeat(3, 1))
        case "a.e57":
            pytest.importorskip("pye57", reason="the e57 extra is not installed")
            x, y, z = positions.T.copy()
            scan = {"cartesianX": x, "cartesianY": y, "cartesianZ": z}
            return write_e57(path, [{**scan, "rotation": [1.0, 0, 0, 0], "translation": [0.0, 0, 0]}])
    return path


KINDS = [
    *("3.las", "3.laz", "7.las", "7.laz", "ascii.ply", "binary.ply", "ascii.pcd", "binary.pcd"),
    *("binary_compressed.pcd", "a.pts", "a.npy", "c.npz", "a.e57"),
]


@pytest.mark.parametrize("kind", KINDS)
def test_truncated_anywhere(tmp_path, kind):
    path = make(tmp_path, kind)
    data = path.read_bytes()
    assert outcome(path) == N
    last = len(data) - (80 if kind in ("a.pts", "ascii.ply", "ascii.pcd") else 1)  # half a number is a number
    for cut in sorted({0, 1, 3, 8, 100, 230, last, *range(0, last, len(data) // 40)}):
        path.write_bytes(data[:cut])
        assert isinstance(outcome(path), str), f"cut to {cut} of {len(data)} bytes"


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_bytes(tmp_path, kind):
    path = make(tmp_path, kind)
    data = path.read_bytes()
    for seed in range(40):
        rng = random.Random(seed)
        damaged = bytearray(data)
        for _ in range(rng.choice([1, 2, 8])):
            at, width = rng.randrange(min(len(data), 2000)), rng.choice([1, 2, 4, 8])
            damaged[at : at + width] = rng.choice([rng.randbytes(width), b"\xff" * width, bytes(width)])
        path.write_bytes(bytes(damaged))
        assert outcome(path) is not None


def patch(path, at, layout, *values):
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, at, *values)
    path.write_bytes(bytes(data))


def replace(path, old, new):
    data = path.read_bytes()
    assert old in data
    path.write_bytes(data.replace(old, new, 1))


def lie_npy(path):
    header = {"descr": "<f8", "fortran_order": False, "shape": (HUGE, 3)}
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, header)
    data = stream.getvalue() + bytes(4800)
    if path.suffix == ".npy":
        path.write_bytes(data)
    else:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("xyz.npy", data)


LIES = {
    "3.las": lambda p: patch(p, 107, "<I", 0xFFFF_FFFF),
    "3.laz": lambda p: patch(p, 107, "<I", 0xFFFF_FFFF),
    "7.las": lambda p: patch(p, 247, "<Q", HUGE),
    "7.laz": lambda p: patch(p, 247, "<Q", HUGE),
    "ascii.ply": lambda p: replace(p, b"vertex 200", b"vertex %d" % HUGE),
    "binary.ply": lambda p: replace(p, b"vertex 200", b"vertex 201"),
    "ascii.pcd": lambda p: (replace(p, b"POINTS 200", b"POINTS 201"), replace(p, b"WIDTH 200", b"WIDTH 201")),
    "binary.pcd": lambda p: (replace(p, b"POINTS 200", b"POINTS 201"), replace(p, b"WIDTH 200", b"WIDTH 201")),
    "binary_compressed.pcd": lambda p: (
        replace(p, b"POINTS 200", b"POINTS %d" % HUGE),
        replace(p, b"WIDTH 200", b"WIDTH %d" % HUGE),
    ),
    "a.pts": lambda p: replace(p, b"200\n", b"%d\n" % HUGE),
    "a.npy": lie_npy,
    "c.npz": lie_npy,
}


@pytest.mark.parametrize("kind", LIES)
def test_headers_that_promise_too_much(tmp_path, kind):
    path = make(tmp_path, kind)
    outcome(path)  # what is imported or compiled once is not counted below
    LIES[kind](path)
    tracemalloc.start()
    message = outcome(path)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert isinstance(message, str)
    assert "expected" in message or "promises" in message
    assert peak_bytes < 64 << 20


def test_laz_whose_chunk_table_or_layers_lie(tmp_path):
    path = make(tmp_path, "7.laz")
    data = path.read_bytes()
    (start,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, start)
    (record_bytes,) = struct.unpack_from("<H", data, 105)
    for at, layout, value in [
        (start, "<q", len(data) + 5),
        (start, "<q", -7),
        (table + 4, "<I", 0xFFFF_FFFF),
        (start + 8 + record_bytes + 4, "<I", 0xFFFF_FFF0),
        (start + 8 + record_bytes, "<I", N + 50_000),
    ]:
        path.write_bytes(data)
        patch(path, at, layout, value)
        assert "chunk table" in str(outcome(path))


PLY = "ply\nformat ascii 1.0\n"
XYZ = "property float x\nproperty float y\nproperty float z\n"
PCD = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 1\nHEIGHT 1\nPOINTS 1\nDATA ascii\n"


@pytest.mark.parametrize(
    ("name", "content", "complaint"),
    [
        ("a.las", b"", "empty file"),
        ("a.las", b"not a point file at all", "expected a file of the format las"),
        ("a.xyz", b"1 2 3\n\0\0", "binary data"),
        ("a.xyz", b"\n\n# nothing\n", "no points"),
        ("a.xyz", b"x y z\n", "no points"),
        ("a.xyz", b"1 2 3\n4 5\n", "line 2: found 2 columns, expected 3"),
        ("a.xyz", b"x y z\n1 2 3\n\n4 5 six\n", "line 4: found 'six', expected a number"),
        ("a.csv", b"lon,lat\n1,2\n", "expected x, y and z"),
        ("a.pts", b"3\n1 2 3 4\n5 6 7 8\n9 9 9 9", None),
        ("a.pts", b"3\n1 2 3 4\n5 6 7 8 # a comment line\n", "found"),
        ("a.abc", b"1 2 3\n", "unknown format"),
        ("a.ply", PLY.encode(), "end_header"),
        ("a.ply", f"{PLY}end_header\n".encode(), "expected one named vertex"),
        ("a.ply", f"{PLY}element vertex 0\n{XYZ}end_header\n".encode(), "no points"),
        ("a.ply", f"{PLY}element vertex -4\n{XYZ}end_header\n".encode(), "element vertex -4"),
        ("a.ply", f"{PLY}element vertex 1\nproperty quaternion x\nend_header\n1\n".encode(), "quaternion"),
        ("a.ply", f"{PLY}element vertex 1\n{XYZ}property float x\nend_header\n1 2 3 4\n".encode(), "twice"),
        ("a.ply", f"{PLY}element vertex 2\n{XYZ}end_header\n1 2 3\n4 x 6\n".encode(), "expected a number"),
        ("a.ply", b"ply\nelement vertex 1\nend_header\n", "no format line"),
        ("a.pcd", PCD.replace("POINTS 1", "POINTS 2").encode() + b"1 2 3", "the same count"),
        ("a.pcd", PCD.replace("SIZE 4", "SIZE 3").encode() + b"1 2 3", "field x"),
        ("a.pcd", PCD.replace("ascii", "zip").encode() + b"1 2 3", "expected ascii, binary"),
        ("a.pcd", PCD.replace("FIELDS x", "FIELDS w").encode() + b"1 2 3", "expected x, y and z"),
        ("a.pcd", b"1 2 3\n", "PCD header entry"),
        ("a.npz", b"PK\x03\x04 and no more", "malformed"),
    ],
)
def test_hand_written_faults(tmp_path, name, content, complaint):
    path = tmp_path / name
    path.write_bytes(content)
    result = outcome(path)
    assert result == 3 if complaint is None else complaint in str(result)


def test_arrays_that_are_no_points(tmp_path):
    path = tmp_path / "a.npy"
    for array, complaint in [
        (np.zeros((3, 2)), "shape (3, 2)"),
        (np.zeros(5), "shape (5,)"),
        (np.zeros((0, 3)), "no points"),
        (np.zeros((4, 3), complex), "complex128"),
        (np.array([[{}, 1, 2]], object), "unpickled"),
        (np.zeros(2, [("x", "f8"), ("name", "U5")]), "expected x, y and z"),
    ]:
        np.save(path, array, allow_pickle=True)
        assert complaint in str(outcome(path))
    np.savez(path := tmp_path / "a.npz", xyz=np.zeros((4, 3)), intensity=np.zeros(5))
    assert "different lengths" in str(outcome(path))


def test_missing_file_and_directory(tmp_path):
    for path, complaint in [(tmp_path / "none.las", "No such file"), (tmp_path, "a directory")]:
        with pytest.raises(InputError, match=complaint):
            open_source(path)


def test_file_cut_short_while_it_is_read(tmp_path):
    for kind in ("3.las", "binary.ply", "ascii.ply", "a.npy", "7.laz"):
        path = make(tmp_path, kind)
        source = open_source(path)
        path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
        with pytest.raises(InputError, match=str(path)):
            list(source.batches(10))


@pytest.mark.data
def test_known_malformed_files(data_dir):
    files = sorted((data_dir / "malformed").iterdir())
    assert len(files) > 20
    results = {path.name: outcome(path) for path in files}
    assert results["1.2-no-points.las"].endswith("found 0 bytes of point data")
    assert "checksum" in results["corrupt_crc.e57"]
    assert "no points" in results["ZeroPointsInvalid.e57"]
    assert results["simple-laszip-compressor-version-1.2r0.laz"] == 1065
    assert results["cube_binary_header_with_RN_newline.ply"] == 8
    assert results["utm17_space.pcd"] == 10

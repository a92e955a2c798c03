"""Packing of colours and normals, and the check of a batch."""

import numpy as np
import pytest
from splatpipe.shared.errors import InputError
from splatpipe.shared.points import (
    NO_NORMAL,
    PointBatch,
    concatenate,
    pack_normals,
    pack_rgb,
    unpack_normals,
    unpack_rgb,
)


def test_colours_are_rgba_bytes_in_memory():
    words = pack_rgb(*np.array([[1, 255], [2, 0], [3, 7]], np.uint8))
    assert words.tolist() == [0xFF030201, 0xFF0700FF]
    assert unpack_rgb(words).tolist() == [[1, 2, 3, 255], [255, 0, 7, 255]]


def test_normals_survive_within_their_error_bound_at_any_length():
    rng = np.random.default_rng(1)
    normals = rng.normal(size=(100_000, 3))
    normals[:26] = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3), -1).reshape(-1, 3)[np.arange(27) != 13]
    unit = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    for length in (1.0, 1e-300, 1e300):
        got = unpack_normals(pack_normals(unit * length)).astype(np.float64)
        sine = np.linalg.norm(np.cross(got, unit), axis=1)
        assert np.degrees(np.arcsin(sine)).max() < 0.004
        assert ((got * unit).sum(axis=1) > 0).all()


def test_absent_normals_are_marked_and_come_back_as_zero():
    words = pack_normals(np.array([[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0], [0, 0, -2.0]]))
    assert words[:3].tolist() == [NO_NORMAL] * 3
    assert words[3] != NO_NORMAL
    assert unpack_normals(words).tolist()[:3] == [[0, 0, 0]] * 3
    assert np.allclose(unpack_normals(words)[3], [0, 0, -1])


def test_a_batch_with_a_wrong_column_is_refused_by_name():
    xyz = np.zeros((2, 3))
    assert len(PointBatch(xyz, {"intensity": np.zeros(2, "f4")}).check()) == 2
    for columns, said in [
        ({"colour": np.zeros(2)}, "attribute colour: unknown"),
        ({"rgb": np.zeros(2, "u1")}, "attribute rgb: found uint8"),
        ({"rgb": np.zeros(3, "u4")}, r"attribute rgb: found uint32 \(3,\), expected uint32 \(2,\)"),
    ]:
        with pytest.raises(InputError, match=said):
            PointBatch(xyz, columns).check()
    with pytest.raises(InputError, match="positions: found float32"):
        PointBatch(xyz.astype("f4")).check()


def test_batches_join_and_split():
    batch = PointBatch(np.arange(12.0).reshape(4, 3), {"return_number": np.arange(4, dtype="u1")})
    again = concatenate([batch.select(slice(0, 1)), batch.select(np.array([1, 2, 3]))])
    assert np.array_equal(again.positions, batch.positions)
    assert np.array_equal(again.attributes["return_number"], batch.attributes["return_number"])

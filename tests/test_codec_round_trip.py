"""What holds for every codec of grid points that keeps them exactly: round trips, and refusal of damaged data."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.shared.codecs import Codec, ci, eci, occupancy
from splatpipe.shared.errors import CodecError

CODECS: list[Codec] = [ci, eci, occupancy]
each_codec = pytest.mark.parametrize("codec", CODECS, ids=lambda codec: codec.name)


def assert_round_trip(codec, points, bits):
    encoded = codec.encode(points, bits)
    assert encoded.data.dtype == np.uint8
    np.testing.assert_array_equal(np.sort(encoded.order), np.arange(len(points)))
    decoded = codec.decode(encoded.data, bits, len(points))
    assert decoded.dtype == np.uint32
    np.testing.assert_array_equal(decoded, points[encoded.order])
    np.testing.assert_array_equal(codec.encode(points, bits).data, encoded.data)
    return encoded


@st.composite
def clouds(draw):
    """Points of any density, some of them many times."""
    bits = draw(st.integers(1, 21))
    last = (1 << bits) - 1
    near = draw(st.integers(0, last))
    coordinate = st.one_of(st.integers(0, last), st.integers(near, min(near + 3, last)), st.sampled_from([0, last]))
    points = draw(st.lists(st.tuples(coordinate, coordinate, coordinate), max_size=60))
    points += draw(st.lists(st.sampled_from(points), max_size=20)) if points else []
    return bits, np.array(points, np.int64).reshape(-1, 3)


@each_codec
@given(cloud=clouds())
@settings(deadline=None, max_examples=60)
def test_any_points(codec, cloud):
    bits, points = cloud
    assert_round_trip(codec, points, bits)


@each_codec
@given(bits=st.integers(1, 21), seed=st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=30)
def test_one_point_anywhere(codec, bits, seed):
    assert_round_trip(codec, np.random.default_rng(seed).integers(0, 1 << bits, (1, 3)), bits)


@each_codec
@pytest.mark.parametrize("bits", [1, 5, 10, 21])
def test_no_point(codec, bits):
    assert assert_round_trip(codec, np.empty((0, 3), np.int64), bits).data.tolist() == [0]


@each_codec
@pytest.mark.parametrize("bits", [1, 2, 3, 4, 5, 6])
def test_full_cube(codec, bits):
    points = np.indices([1 << bits] * 3).reshape(3, -1).T
    assert_round_trip(codec, np.random.default_rng(0).permutation(points), bits)


@each_codec
def test_faces_of_blocks_and_cells(codec):
    """Pairs on both sides of each face between blocks of 32³, and the corners of the grid."""
    sides = [0, 1, 30, 31, 32, 33, 62, 63, 64, 65, 126, 127]
    points = np.stack(np.meshgrid(sides, sides, sides), -1).reshape(-1, 3)
    assert_round_trip(codec, np.random.default_rng(0).permutation(points), 7)


@each_codec
@pytest.mark.parametrize("n", [2047, 2048, 40000])
def test_many_points_of_the_same_few_positions_keep_their_order(codec, n):
    points = np.random.default_rng(1).integers(5, 9, (n, 3))
    order = assert_round_trip(codec, points, 10).order
    same = (np.diff(points[order], axis=0) == 0).all(axis=1)
    assert (np.diff(order)[same] > 0).all()


@each_codec
@pytest.mark.parametrize("scale", [1, 3, 40])
def test_a_surface_in_many_blocks(codec, scale):
    u, v = np.meshgrid(np.arange(0, 150), np.arange(0, 150))
    points = np.column_stack([u.ravel(), v.ravel(), (u * v).ravel() // 150]) * scale
    assert_round_trip(codec, points, 13)


@each_codec
@pytest.mark.parametrize(
    ("points", "bits"),
    [
        (np.array([[0, 0, 32]]), 5),
        (np.array([[0, -1, 0]]), 5),
        (np.array([[0.0, 0, 0]]), 5),
        (np.array([0, 0, 0]), 5),
        (np.array([[0, 0]]), 5),
        (np.array([[0, 0, 0]]), 0),
        (np.array([[0, 0, 0]]), 22),
    ],
)
def test_what_cannot_be_encoded_is_one_clear_error(codec, points, bits):
    with pytest.raises(CodecError, match="found"):
        codec.encode(points, bits)


@each_codec
@pytest.mark.parametrize("bits", [0, 22])
def test_bits_out_of_range(codec, bits):
    with pytest.raises(CodecError, match="bits: found"):
        codec.decode(np.array([0], np.uint8), bits, 10)


@each_codec
def test_more_points_than_the_caller_allows(codec):
    points = np.array([[1, 2, 3], [4, 5, 6], [4, 5, 6]])
    data = codec.encode(points, 5).data
    assert len(codec.decode(data, 5, 3)) == 3
    with pytest.raises(CodecError, match=r"at most|more than"):
        codec.decode(data, 5, 2)


@each_codec
def test_data_need_not_be_writable_or_contiguous(codec):
    points = np.random.default_rng(4).integers(0, 64, (500, 3))
    encoded = codec.encode(points, 7)
    spread = np.zeros(2 * len(encoded.data), np.uint8)
    spread[::2] = encoded.data
    frozen = np.frombuffer(encoded.data.tobytes(), np.uint8)
    for data in (spread[::2], frozen):
        np.testing.assert_array_equal(codec.decode(data, 7, 500), points[encoded.order])

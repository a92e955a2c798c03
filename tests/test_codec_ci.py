import codec_example as example
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.shared.codecs import ci, ci_reference
from splatpipe.shared.errors import CodecError

HEAD_OF_36 = bytes([2 * 36])


def test_the_cube_of_the_paper_bit_for_bit():
    expected = "".join("1" + cell for cell in example.CI_CELLS)
    labels = [label for cell in example.CELL_POINTS for label in cell]
    cube = [example.point(label) for label in labels]

    assert "".join(map(str, ci_reference.encode_cube(reversed(cube), 4))) == expected
    assert ci_reference.decode_cube(list(map(int, expected)), 4) == (cube, 72)

    shuffled = np.random.default_rng(1).permutation(36)
    encoded = ci.encode(example.points(labels)[shuffled], 2)
    assert encoded.data[:1].tobytes() == HEAD_OF_36
    assert example.bit_string(encoded.data[1:]) == expected
    np.testing.assert_array_equal(shuffled[encoded.order], np.arange(36))
    np.testing.assert_array_equal(ci.decode(encoded.data, 2, 36), cube)


def test_the_cell_of_the_papers_text():
    """Section 4.1: the seed of cell 67 of a cube of 32³ is (0, 8, 6)."""
    encoded = ci.encode(np.array([[0, 8, 6]]), 5)
    assert example.bit_string(encoded.data[1:]) == "0" * 67 + "1" + "10000000" + "0" * (4096 - 68)


@st.composite
def cubes(draw):
    bits = draw(st.integers(1, 5))
    coordinate = st.integers(0, (1 << bits) - 1)
    return bits, draw(st.sets(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=60))


@given(cubes())
@settings(deadline=None, max_examples=40)
def test_reference_and_compiled_give_the_same_bits(cube):
    bits, points = cube
    expected = ci_reference.encode_cube(points, 1 << bits)
    encoded = ci.encode(np.array(list(points)), bits)
    stream = list(map(int, example.bit_string(encoded.data[1:])))
    assert stream[: len(expected)] == expected
    assert stream[len(expected) :] == [0] * (-len(expected) % 8)
    in_order, n_bits = ci_reference.decode_cube(stream, 1 << bits)
    assert n_bits == len(expected)
    np.testing.assert_array_equal(ci.decode(encoded.data, bits, len(points)), in_order)


def test_cubes_are_listed_by_index_and_stand_one_after_the_other():
    points = np.array([[32, 0, 0], [0, 33, 0], [31, 31, 31]])  # blocks 4, 2 and 0 of 2·2·2
    data = ci.encode(points, 6).data
    assert data[:5].tolist() == [2 * 3, 3 - 1, 0, 2 - 0 - 1, 4 - 2 - 1]
    cubes = [ci_reference.encode_cube([p], 32) for p in [(31, 31, 31), (0, 1, 0), (0, 0, 0)]]
    assert example.bit_string(data[5:]) == "".join(str(bit) for cube in cubes for bit in cube)


def test_only_points_that_repeat_cost_bytes_for_it():
    points = np.array([[0, 0, 0], [1, 1, 1], [0, 0, 1], [1, 1, 1], [1, 1, 1]])
    encoded = ci.encode(points, 1)
    assert encoded.data.tolist() == [2 * 3 + 1, 1, 2, 3 - 2, 0b11100000, 0b10000000]
    assert encoded.order.tolist() == [0, 2, 1, 3, 4]


DAMAGED = {
    "no byte": [],
    "a number without its end": [0x80],
    "a number not in its shortest form": [0x82, 0x00, 0b11000000, 0],
    "more points than bits": [2 * 100, 0b11111111],
    "fewer points than said": [2 * 3, 0b11100000, 0],
    "more points than said": [2 * 1, 0b11100000, 0],
    "a filled cell without a point": [2 * 1, 0b10000000, 0],
    "a stream that ends in a cell": [2 * 1, 0b11000000],
    "a bit behind the last": [2 * 1, 0b11000000, 1],
    "a byte behind the last": [2 * 1, 0b11000000, 0, 0],
    "bytes behind no points": [0, 0],
    "repeats of none": [2 * 1 + 1, 0, 0b11000000, 0],
    "repeats of a point that is not there": [2 * 1 + 1, 1, 1, 0, 0b11000000, 0],
    "more repeats than points allowed": [2 * 1 + 1, 1, 0, 100, 0b11000000, 0],
}


@pytest.mark.parametrize("data", DAMAGED.values(), ids=DAMAGED.keys())
def test_damaged_data_is_one_clear_error(data):
    with pytest.raises(CodecError, match="coded points: found"):
        ci.decode(np.array(data, np.uint8), 1, 100)


BLOCKS = {
    "more blocks than points": [2 * 1, 1, 0, 0],
    "a block outside of the grid": [2 * 1, 0, 8],
    "an index that overflows": [2 * 1, 0, *[0xFF] * 8, 0x7F],
    "a block that is listed and holds nothing": [2 * 2, 1, 0, 0, 0b11100000, *[0] * (2 * 512)],
}


@pytest.mark.parametrize("data", BLOCKS.values(), ids=BLOCKS.keys())
def test_damaged_lists_of_blocks(data):
    with pytest.raises(CodecError, match="coded points: found"):
        ci.decode(np.array(data, np.uint8), 6, 100)


def test_reference_refuses_what_no_encoder_writes():
    for bits in ([], [1, 1, 0], [1] + [0] * 8):
        with pytest.raises(CodecError):
            ci_reference.decode_cube(bits, 2)

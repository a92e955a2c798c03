import codec_example as example
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.shared.codecs import eci, eci_reference
from splatpipe.shared.codecs.eci_kernels import layer_blocks, write_blocks_of_layers
from splatpipe.shared.errors import CodecError

LABELS = [label for layer in example.LAYERS for label in layer]


def test_the_cube_of_the_paper_bit_for_bit():
    """Layers, seeds and connectivity found from the bare points; equal ones stand as the figure has them."""
    cube = [example.point(label) for label in LABELS]
    left = {point: place for place, point in enumerate(cube)}
    root = eci_reference.take_component(left)
    assert not left
    assert eci_reference.coded_order(root) == cube
    found = {seed.point: len(seed.connected) for seed in eci_reference.seeds(root)}
    assert found == {example.point(label): connectivity for label, connectivity in example.CONNECTIVITY.items()}

    bits = eci_reference.encode_component(root, root_bits=1)
    assert "".join(map(str, bits)) == example.eci_bits()
    assert len(bits) == 258  # 7.2 bits a point
    assert eci_reference.decode_component(eci_reference.BitReader(bits), 1, 4, set()) == cube


def test_the_compiled_version_gives_the_cube_of_the_paper():
    points = example.points(LABELS).astype(np.uint32)
    layers = layer_blocks(points, np.array([0, 36]))
    sequence, connectivity, n_seeds, is_first = layers
    np.testing.assert_array_equal(sequence, np.arange(36))
    np.testing.assert_array_equal(connectivity, [example.CONNECTIVITY.get(label, 0) for label in LABELS])
    assert n_seeds.sum() == len(example.CONNECTIVITY) - 1
    assert is_first.tolist() == [1] + [0] * 35
    stream = np.zeros(4 * 36, np.uint8)
    n_bits = write_blocks_of_layers(points, *layers, 1, stream)
    assert example.bit_string(stream)[:n_bits] == example.eci_bits() + "0"  # and no other component


@st.composite
def cubes(draw):
    """Sets that hang together and sets that do not."""
    bits = draw(st.integers(1, 5))
    coordinate = st.integers(0, (1 << draw(st.integers(1, bits))) - 1)
    return bits, sorted(draw(st.sets(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=100)))


def in_order_of_ci(points):
    return sorted(points, key=lambda p: ([value >> 1 for value in p], [value & 1 for value in p]))


@given(cubes())
@settings(deadline=None, max_examples=60)
def test_reference_and_compiled_give_the_same_bits(cube):
    bits, points = cube
    left = {point: place for place, point in enumerate(in_order_of_ci(points))}
    expected, order = [], []
    while left:
        root = eci_reference.take_component(left)
        order += eci_reference.coded_order(root)
        expected += [*eci_reference.encode_component(root, bits), int(len(left) > 0)]

    encoded = eci.encode(np.array(points), bits)
    stream = example.bit_string(encoded.data[1 if len(points) < 64 else 2 :])
    assert stream == "".join(map(str, expected)) + "0" * (-len(expected) % 8)
    np.testing.assert_array_equal(np.array(points)[encoded.order], order)
    np.testing.assert_array_equal(eci.decode(encoded.data, bits, len(points)), order)

    reader, taken, decoded, another = eci_reference.BitReader(expected), set(), [], 1
    while another:
        decoded += eci_reference.decode_component(reader, bits, 1 << bits, taken)
        another = reader.number(1)
    assert decoded == order
    assert reader.at == len(expected)


def test_full_cube_equals_the_reference():
    points = [(x, y, z) for x in range(8) for y in range(8) for z in range(8)]
    left = {point: place for place, point in enumerate(in_order_of_ci(points))}
    root = eci_reference.take_component(left)
    expected = [*eci_reference.encode_component(root, 3), 0]
    encoded = eci.encode(np.array(points), 3)
    assert example.bit_string(encoded.data[2:])[: len(expected)] == "".join(map(str, expected))


# Number of points, and a stream in a cube of two bits an axis: first point, connectivity, number of seeds, …
DAMAGED = {
    "no stream": (1, ""),
    "a stream that ends in a component": (2, "010101 00001 1 11"),
    "a point outside of the cube": (2, "000000 00001 0 01010 0"),
    "a point twice, as a neighbour of itself": (2, "010101 00001 0 101010 0"),
    "a point twice, in two components": (2, "000000 00000 1 000000 00000 0"),
    "connectivity above 26": (28, "010101 11011 00000" + 27 * " 111111"),
    "more seeds than connected": (3, "010101 00010 11 111111 00001 0 111110 00001 0" + 4 * " 000"),
    "a seed with nothing connected": (2, "010101 00001 1 111111 00000 0"),
    "more points than said": (1, "010101 00001 0 111111 0"),
    "fewer points than said": (3, "010101 00001 0 111111 0 000000"),
    "a bit behind the last": (2, "010101 00001 0 111111 0 1"),
    "a byte behind the last": (2, "010101 00001 0 111111 0 00000 00000000"),
}


def packed(bits):
    return np.packbits(np.array(list(map(int, bits.replace(" ", ""))), np.uint8))


@pytest.mark.parametrize(("n", "bits"), DAMAGED.values(), ids=DAMAGED.keys())
def test_damaged_data_is_one_clear_error(n, bits):
    with pytest.raises(CodecError, match="coded points: found"):
        eci.decode(np.append(np.uint8(2 * n), packed(bits)), 2, 100)


def test_what_the_damaged_streams_were_before():
    points = [(1, 1, 1), (2, 2, 2)]
    encoded = eci.encode(np.array(points), 2)
    np.testing.assert_array_equal(encoded.data, np.append(np.uint8(2 * 2), packed("010101 00001 0 111111 0")))


def test_one_point_in_its_bits():
    assert eci.encode(np.array([[1, 2, 3]]), 2).data.tolist() == [2 * 1, 0b01101100, 0b00000000]


@pytest.mark.parametrize("bits", ["", "0000", "010101" + "11011" + "00000", "010101" + "00001" + "0" + "101010"])
def test_reference_refuses_what_no_encoder_writes(bits):
    with pytest.raises(CodecError):
        eci_reference.decode_component(eci_reference.BitReader(list(map(int, bits))), 2, 4, set())

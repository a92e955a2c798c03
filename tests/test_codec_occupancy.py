import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.shared.codecs import ci, mixing, occupancy, range_coder
from splatpipe.shared.codecs.occupancy_reference import encode_stream
from splatpipe.shared.errors import CodecError


@given(st.lists(st.tuples(st.integers(0, 1), st.integers(1, 65535)), max_size=300))
@settings(deadline=None, max_examples=60)
def test_range_coder_gives_back_what_was_written(answers):
    out, state = np.empty(range_coder.MOST_BYTES * (len(answers) + 1), np.uint8), range_coder.start_writing()
    for bit, probability in answers:
        range_coder.write_bit(state, out, bit, probability)
    data = range_coder.finish_writing(state, out)
    state = range_coder.start_reading(data)
    assert [range_coder.read_bit(state, data, p) for _, p in answers] == [bit for bit, _ in answers]
    range_coder.check_end(state, data)
    with pytest.raises(CodecError, match="coded points: found"):
        range_coder.check_end(state, np.append(data, np.uint8(0)))


def test_range_coder_costs_what_probabilities_say():
    rng = np.random.default_rng(5)
    probability = rng.integers(200, 65336, 20000)
    bits = (rng.random(20000) < probability / 65536).astype(int)
    out, state = np.empty(80000, np.uint8), range_coder.start_writing()
    for bit, p in zip(bits, probability, strict=True):
        range_coder.write_bit(state, out, bit, p)
    said = -np.log2(np.where(bits, probability, 65536 - probability) / 65536).sum()
    assert 8 * len(range_coder.finish_writing(state, out)) == pytest.approx(said, rel=1e-3)


def test_rounded_tables_are_the_same_on_any_machine():
    """No entry lies within 1e-9 of a half: far more than libraries of logarithms and exponentials differ by."""
    for exact, table in zip(mixing.exact_tables(), mixing.tables(), strict=True):
        assert np.abs(exact - np.floor(exact) - 0.5).min() > 1e-9
        assert np.abs(table - exact).max() <= 0.5


def test_probabilities_stay_inside_the_coders_range():
    stretch, squash, _ = mixing.tables()
    assert stretch.min() == -2047
    assert stretch.max() == 2047
    assert squash.min() > 0
    assert squash.max() < 65536


@st.composite
def sets_of_points(draw):
    bits = draw(st.sampled_from([1, 2, 3, 5, 9]))
    coordinate = st.integers(0, min((1 << bits) - 1, draw(st.sampled_from([3, 7, 500]))))
    return bits, draw(st.sets(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=40))


@given(sets_of_points())
@settings(deadline=None, max_examples=40)
def test_reference_and_compiled_give_the_same_bytes(case):
    bits, points = case
    data = occupancy.encode(np.array(list(points)), bits).data
    assert data[1:].tobytes() == encode_stream(points, bits)


def test_repeats_cost_about_what_their_number_tells():
    """Half of the points twice: one bit a distinct point, and a point that stands there 1000 times a few bytes."""
    points = sphere(6)
    twice = np.concatenate([points, points[np.random.default_rng(0).random(len(points)) < 0.5]])
    n_bytes = [len(occupancy.encode(p, 6).data) for p in (points, twice, np.repeat(points[:1], 1000, axis=0))]
    assert 8 * (n_bytes[1] - n_bytes[0]) == pytest.approx(len(points), rel=0.05)
    assert n_bytes[2] < 20


def test_more_repeats_than_the_caller_allows():
    data = occupancy.encode(np.zeros((50, 3), np.int64), 3).data
    with pytest.raises(CodecError, match="more than 49 points"):
        occupancy.decode(data, 3, 49)


def sphere(bits):
    """Distinct grid points of a sphere, sampled far more densely than the grid is fine."""
    direction = np.random.default_rng(2).normal(size=(40 << 2 * bits, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return np.unique(((direction * 0.49 + 0.5) * (1 << bits)).astype(np.int64), axis=0)


def test_a_surface_costs_a_third_of_cell_identification():
    points = sphere(6)
    assert occupancy.encode(points, 6).bits_per_point < ci.encode(points, 6).bits_per_point / 3


def test_points_without_order_cost_little_more_than_they_must():
    """1000 of 2**30 positions: log2(2**30) − log2(1000!)/1000 = 21.5 bits a point."""
    points = np.random.default_rng(3).integers(0, 1024, (1000, 3))
    assert occupancy.encode(points, 10).bits_per_point < 1.15 * 21.5


def test_data_that_ends_early_or_late_is_one_clear_error():
    """Much too early: the last byte alone may tell of other points, which are then as valid as the first."""
    data = occupancy.encode(sphere(4), 4).data
    n = len(sphere(4))
    for damaged in (data[:0], data[:1], data[:2], data[: len(data) // 2], np.append(data, np.uint8(0))):
        with pytest.raises(CodecError, match="coded points: found"):
            occupancy.decode(damaged, 4, n)
    with pytest.raises(CodecError, match="expected at most"):
        occupancy.decode(data, 4, n - 1)
    for nothing in ([0, 0], [1]):
        with pytest.raises(CodecError, match="behind no points"):
            occupancy.decode(np.array(nothing, np.uint8), 4, n)

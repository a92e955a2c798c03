"""The streams codec: bytes as stated, round trips, damaged data, the gate."""

import numpy as np
import pytest
import stream_example as example
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.shared.codecs import pools_reference, streams
from splatpipe.shared.codecs.grid import to_grid
from splatpipe.shared.errors import CodecError
from splatpipe.shared.readers import open_source
from test_codec_pools import bits_of, surface


def data_of(table, tags, behind=()) -> np.ndarray:
    """A stream with the vertices and translations of figure 4, written byte by byte."""
    data = [2 * int(table.sum()), 1, 4, 4, *example.TRANSLATIONS.ravel(), *example.VERTICES.ravel()]
    for tag in tags:
        data += [tag, 0, 0, 0]
    return np.array([*data, *behind], np.uint8)


@pytest.mark.parametrize(
    ("table", "tags"), [(example.TABLE_A, example.TAGS_A), (example.TABLE_B, example.TAGS_B)], ids="ab"
)
def test_the_streams_of_figure_4_byte_for_byte(table, tags):
    data = data_of(table, tags)
    pooled = streams.read_pools(data, 3, 16)
    np.testing.assert_array_equal(pooled.pools[0].tags.ravel(), tags)
    np.testing.assert_array_equal(bits_of(pooled.pools[0]), table)
    assert len(pooled) == table.sum()
    np.testing.assert_array_equal(streams.decode(data, 3, 16), example.points(table))


def test_bytes_are_as_stated():
    points = np.random.default_rng(1).permutation(surface(48))
    encoded = streams.encode(points, 7)
    pooled = streams.read_pools(encoded.data, 7, len(points))
    sizes = [size for pool in pooled.pools for size in (len(pool.vertices), len(pool.translations))]
    head = streams.write_varints(np.array([2 * len(points), len(pooled.pools), *sizes]))
    arrays = [array for pool in pooled.pools for array in (pool.translations, pool.vertices, pool.tags)]
    assert len(pooled.pools) >= 1
    assert encoded.data.tobytes() == head.tobytes() + b"".join(map(np.ndarray.tobytes, (*arrays, pooled.loose)))
    in_pools = [pools_reference.pool_points(pool.vertices, pool.translations, bits_of(pool)) for pool in pooled.pools]
    np.testing.assert_array_equal(np.concatenate([*in_pools, pooled.loose]), points[encoded.order])
    assert pooled.coverage == pytest.approx(sum(map(len, in_pools)) / len(points))
    assert pooled.coverage > 0.4
    assert pooled.n_bytes == len(encoded.data) - len(head)


def test_no_pools_is_three_bytes_a_point():
    points = surface(32)
    encoded = streams.encode(points, 5, n_pools=0)
    assert encoded.data.tolist() == [*streams.write_varints(np.array([2 * len(points)])), 0, *points.ravel()]
    pooled = streams.read_pools(encoded.data, 5, len(points))
    assert (pooled.pools, pooled.coverage) == ((), 0)


def test_a_stream_is_the_same_for_any_order_of_the_points():
    points = surface(32)
    shuffled = np.random.default_rng(4).permutation(points)
    np.testing.assert_array_equal(streams.encode(points, 5).data, streams.encode(shuffled, 5).data)


def cube(edge):
    return np.stack(np.meshgrid(*[np.arange(edge)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)


SETS = {
    "none": np.empty((0, 3), int),
    "one": np.array([(127, 0, 5)]),
    "one, three times": np.array([(7, 7, 7)] * 3),
    "full cube": cube(16),
    "faces of the cell": cube(128)[(cube(128) % 127 == 0).any(axis=1)][::3],
    "a line": np.column_stack([np.arange(128), np.zeros(128, int), np.full(128, 127)]),
    "surface": surface(64),
    "repeats": np.concatenate([surface(48), surface(48)[::2], surface(48)[::5]]),
}


@pytest.mark.parametrize("n_pools", [0, 1, 2, 5])
@pytest.mark.parametrize("points", SETS.values(), ids=SETS.keys())
def test_round_trip(points, n_pools):
    encoded = streams.encode(points, 7, n_pools)
    np.testing.assert_array_equal(np.sort(encoded.order), np.arange(len(points)))
    decoded = streams.decode(encoded.data, 7, len(points))
    assert decoded.dtype == np.uint32
    np.testing.assert_array_equal(decoded, points[encoded.order])
    assert len(streams.read_pools(encoded.data, 7, len(points))) == len(np.unique(points, axis=0))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.integers(1, 8), st.data())
def test_round_trip_of_anything(bits, data):
    coordinate = st.integers(0, min(2**bits - 1, data.draw(st.sampled_from([1, 5, 255]))))
    points = data.draw(st.lists(st.tuples(coordinate, coordinate, coordinate), max_size=120))
    points = np.array(points, int).reshape(-1, 3)
    encoded = streams.encode(points, bits, data.draw(st.integers(0, 3)), data.draw(st.sampled_from([None, 32, 256])))
    np.testing.assert_array_equal(streams.decode(encoded.data, bits, len(points)), points[encoded.order])


@pytest.mark.parametrize(("bits", "width"), [(0, None), (9, None), (7, 0), (7, 33), (7, 288)])
def test_settings_out_of_range(bits, width):
    with pytest.raises(CodecError, match=r"(bits|tags): found"):
        streams.encode(np.zeros((1, 3), int), bits, width=width)


A = data_of(example.TABLE_A, example.TAGS_A)
DAMAGED = {
    "no byte": A[:0],
    "no number of pools": A[:1],
    "bytes behind no points": np.array([0, 0], np.uint8),
    "a count that no data holds": np.array([0x80, 0x80, 0x80, 0x80, 0x08, 1, 1, 1], np.uint8),
    "more pools than bytes": np.array([2, 0xFF, 0xFF, 0xFF, 0x7F, 1], np.uint8),
    "a pool that ends too early": A[:-1],
    "a byte behind the last": np.append(A, np.uint8(0)),
    "more points than said": np.append(np.uint8(2 * 15), A[1:]),
    "fewer points than said": data_of(np.ones(17), example.TAGS_A),
    "a point in two pools": np.concatenate([[2 * 32, 2, 4, 4, 4, 4], A[4:], A[4:]]).astype(np.uint8),
    "a loose point that a pool covers": data_of(np.ones(17), example.TAGS_A, behind=(4, 1, 1)),
    "a loose point outside of the grid": data_of(np.ones(17), example.TAGS_A, behind=(8, 0, 0)),
    "an empty tag": data_of(np.ones(12), [15, 15, 15, 0]),
    "a tag with a bit too many": data_of(np.ones(17), [15, 15, 15, 31]),
    "a pool without vertices": np.array([2, 1, 0, 1, 0, 0, 0, 1, 1, 1], np.uint8),
    "a pool without translations": np.array([2, 1, 1, 0, 1, 1, 1, 1, 0, 0, 0], np.uint8),
    "a pool of 257 translations": np.array([2, 1, 1, 0x81, 2, *[0] * 2000], np.uint8),
    "a point below the grid": np.array([2, 1, 1, 1, 255, 0, 0, 0, 0, 0, 1, 0, 0, 0], np.uint8),
}


@pytest.mark.parametrize("data", DAMAGED.values(), ids=DAMAGED.keys())
def test_damaged_data_is_one_clear_error(data):
    with pytest.raises(CodecError, match="coded points: found"):
        streams.decode(data, 3, 100)


def test_more_points_than_allowed():
    with pytest.raises(CodecError, match="found 16 points, expected at most 15"):
        streams.decode(A, 3, 15)


def test_fuzzed_streams_decode_to_distinct_points_or_raise_one_error():
    """30 000 inputs: real streams cut, changed, and spliced; nothing else is raised, nothing grows beyond its bound."""
    rng = np.random.default_rng(5)
    sources = [A, data_of(example.TABLE_B, example.TAGS_B), streams.encode(surface(32), 5).data]
    sources.append(streams.encode(np.repeat(surface(16)[:100], 2, axis=0), 5).data)
    most, outcomes = 2000, [0, 0]
    for i in range(30_000):
        data = sources[i % len(sources)].copy()
        kind = rng.integers(4)
        if kind == 0:
            data = data[: rng.integers(len(data))]
        elif kind == 1:
            data = np.concatenate([data[: rng.integers(12)], rng.integers(0, 256, rng.integers(40))]).astype(np.uint8)
        else:
            where = rng.integers(0, min(len(data), (8, 60, len(data))[rng.integers(3)]), rng.integers(1, 4))
            data[where] = rng.integers(0, 256, len(where))
        try:
            points = streams.decode(data, 5, most)
        except CodecError:
            outcomes[0] += 1
        else:
            outcomes[1] += 1
            assert points.shape[0] <= most
            assert points.size == 0 or points.max() < 32
    assert min(outcomes) > 100


def test_the_gate():
    dense = streams.encode(surface(64), 7)
    assert streams.keeps_pools(streams.read_pools(dense.data, 7, 10_000))
    assert not streams.keeps_pools(streams.read_pools(dense.data, 7, 10_000), least_gain=10)
    plain = streams.encode(surface(64), 7, n_pools=0)
    assert not streams.keeps_pools(streams.read_pools(plain.data, 7, 10_000), least_gain=1)
    sparse = np.random.default_rng(3).integers(0, 128, (500, 3))
    assert not streams.keeps_pools(streams.read_pools(streams.encode(sparse, 7).data, 7, 500), least_gain=1)


@pytest.mark.parametrize(
    ("file", "n_distinct", "bytes_per_point", "coverage"),
    [
        ("stanford-dragon_stand_rangescans.ply", 24_533, 0.97, 0.83),
        ("potree-lion_takanawa_normals_rgb.ply", 27_856, 0.99, 0.83),
    ],
)
def test_pools_of_real_scans(data_dir, file, n_distinct, bytes_per_point, coverage):
    batches = open_source(data_dir / "scans" / file).batches(1 << 20)
    positions = np.concatenate([batch.positions for batch in batches]).astype(np.float64)
    lower = positions.min(axis=0)
    grid = to_grid(positions, lower, np.ptp(positions, axis=0).max() * (1 + 1e-9), 7)
    points = np.unique(grid, axis=0)
    encoded = streams.encode(points, 7)
    pooled = streams.read_pools(encoded.data, 7, len(points))
    assert len(points) == n_distinct
    assert len(encoded.data) <= bytes_per_point * len(points)
    assert pooled.coverage >= coverage
    np.testing.assert_array_equal(streams.decode(encoded.data, 7, len(points)), points[encoded.order])

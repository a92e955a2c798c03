"""Common translations and pools: the paper's figures, and the compiled versions held against the plain ones."""

import numpy as np
import pytest
import stream_example as example
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.shared.codecs import pools_reference as reference
from splatpipe.shared.codecs.autocorrelation import LEAST_SHARE, MAX_REACH, common_translations
from splatpipe.shared.codecs.pools import Pool, greedy_pools


def surface(n=32, seed=0):
    """Grid points of a bumpy sheet in n³."""
    rng = np.random.default_rng(seed)
    x, y = (c.ravel() for c in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    z = n / 2 + n / 4 * np.sin(x / n * 5 + seed) * np.cos(y / n * 4)
    keep = rng.random(len(x)) < 0.8
    return np.column_stack([x, y, z.astype(int)])[keep].astype(np.uint32)


@st.composite
def point_sets(draw):
    edge = draw(st.sampled_from([1, 2, 3, 5, 9]))
    coordinate = st.integers(0, edge)
    some = draw(st.sets(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=60))
    return np.array(sorted(some), np.uint32)


@pytest.mark.parametrize("printed", [example.TABLE_A, example.TABLE_B], ids="ab")
def test_the_tables_of_figure_4(printed):
    """A null translation and three more take four vertices to 16 and to 12 points."""
    points = example.points(printed)
    assert len(np.unique(points, axis=0)) == len(points) == printed.sum()
    table = reference.table(example.VERTICES, example.TRANSLATIONS, points)
    np.testing.assert_array_equal(table, printed)
    np.testing.assert_array_equal(reference.pool_points(example.VERTICES, example.TRANSLATIONS, table), points)


def test_the_pool_of_figure_3():
    """Every vertex meets every translation: the greedy choice finds the figure's four and four, and its full tags."""
    points = example.points(example.TABLE_A)
    points = points[np.lexsort(points.T)]  # the four vertices first
    (pool,), covered, loose = greedy_pools(points, example.TRANSLATIONS, 1, 32, least_saved=-1000)
    assert sorted(pool.vertices.tolist()) == sorted(example.VERTICES.tolist())
    np.testing.assert_array_equal(pool.translations, example.TRANSLATIONS)
    assert pool.tags.tolist() == [[tag] for tag in example.TAGS_A]
    assert len(loose) == 0
    assert sorted(covered) == list(range(16))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(point_sets(), st.sampled_from([1, 7, 256]), st.sampled_from([None, 0, 2, 5]))
def test_counts_are_those_of_all_pairs(points, size, longest):
    reach = MAX_REACH if longest is None else longest
    expected = {t: n for t, n in reference.translation_counts(points).items() if max(map(abs, t)) <= reach}
    least = len(points) * LEAST_SHARE
    ranked = sorted((t for t in expected if expected[t] >= least), key=lambda t: (-expected[t], max(map(abs, t)), t))
    translations, counts = common_translations(points, size, longest)
    assert list(map(tuple, translations.tolist())) == ranked[:size]
    assert counts.tolist() == [expected[t] for t in ranked[:size]]


def test_a_common_translation_is_found_however_long_it_is():
    """(62, −6, −5): the paper's example, longer than the reach that is tried first."""
    rng = np.random.default_rng(2)
    base = np.unique(rng.integers(10, 60, (400, 3)), axis=0)
    points = np.unique(np.concatenate([base, base + np.array([62, -6, -5])]), axis=0).astype(np.uint32)
    translations, counts = common_translations(points)
    found = {tuple(t): n for t, n in zip(translations.tolist(), counts.tolist(), strict=True)}
    expected = reference.translation_counts(points)
    assert found[62, -6, -5] == found[-62, 6, 5] == expected[62, -6, -5] >= len(base)
    assert all(expected[t] == n for t, n in found.items())


def test_no_translation_is_longer_than_a_byte_holds():
    points = np.array([(0, 0, 0), (1, 0, 0), (200, 0, 0), (201, 0, 0)], np.uint32)
    translations, _ = common_translations(points)
    assert translations.tolist() == [[0, 0, 0], [-1, 0, 0], [1, 0, 0]]
    assert np.abs(translations).max() <= MAX_REACH


@pytest.mark.parametrize("width", [32, 64])
@pytest.mark.parametrize("seed", [0, 1])
def test_pools_equal_the_twin(width, seed):
    points = surface(24, seed)
    translations, _ = common_translations(points)
    pools, covered, loose = greedy_pools(points, translations, 3, width, least_saved=-1000)
    assert len(pools) == 3
    left, start = np.ones(len(points), bool), 0
    for pool in pools:
        rows, vertices, bits = reference.next_pool(points, translations, left, width)
        np.testing.assert_array_equal(pool.translations, translations[rows])
        np.testing.assert_array_equal(pool.vertices, points[vertices])
        np.testing.assert_array_equal(bits_of(pool), bits)
        stop = start + pool.n_points
        np.testing.assert_array_equal(
            points[covered[start:stop]], reference.pool_points(points[vertices], translations[rows], bits)
        )
        left[covered[start:stop]] = False
        start = stop
    np.testing.assert_array_equal(np.flatnonzero(left), loose)


def bits_of(pool: Pool) -> np.ndarray:
    """(m, v) bool."""
    bits = np.unpackbits(pool.tags.astype("<u4").view(np.uint8), axis=1, bitorder="little")
    return bits[:, : len(pool.translations)].T.astype(bool)


def test_the_width_left_open_is_the_one_that_saves_most():
    points = surface(64)
    translations, _ = common_translations(points)

    def first(width):
        return greedy_pools(points, translations, 1, width)[0][0]

    saved = [first(width).saved_bytes for width in (32, 64, 96, 128)]
    assert first(None).saved_bytes == max(saved) > 0
    assert len(set(saved)) > 1


def test_a_pool_that_saves_nothing_is_not_made():
    points = np.unique(np.random.default_rng(3).integers(0, 128, (500, 3)), axis=0).astype(np.uint32)
    translations, _ = common_translations(points)
    pools, covered, loose = greedy_pools(points, translations, 2)
    assert pools == []
    assert len(covered) == 0
    np.testing.assert_array_equal(loose, np.arange(len(points)))

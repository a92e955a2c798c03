"""Splitting entries into pieces: the same points in the same order, cut where a kernel cannot go on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.nodes.raster.pieces import split_entries, split_forms
from splatpipe.shared.errors import MessageError
from splatpipe.shared.messages import RENDER_POINT

N_POINTS = 200

entry = st.tuples(
    st.integers(0, N_POINTS), st.integers(0, N_POINTS), st.integers(1, 2**32 - 1) | st.integers(1, 9)
).map(lambda e: (e[0], min(e[1], N_POINTS - e[0]), e[2]))


@settings(derandomize=True, max_examples=300, deadline=None)
@given(
    st.lists(entry, max_size=8),
    st.lists(st.integers(0, N_POINTS), max_size=6),
    st.integers(1, 50),
)
def test_pieces_draw_the_entries_points_in_order(rows, borders, limit):
    entries = np.array(rows, RENDER_POINT)
    segment_first = np.array([0, *sorted(borders)])
    pieces = split_entries(entries, segment_first, N_POINTS, limit)
    drawn = [p["first"] + np.arange(p["count"]) * int(p["stride"]) for p in pieces]
    expected = [np.arange(o, o + r, s) for o, r, s in entries.tolist()]
    np.testing.assert_array_equal(np.concatenate([[], *drawn]), np.concatenate([[], *expected]))
    ends = np.append(segment_first[1:], N_POINTS)
    for piece, points in zip(pieces, drawn, strict=True):
        assert 1 <= len(points) <= limit
        assert segment_first[piece["segment"]] <= points[0]
        assert points[-1] < ends[piece["segment"]]


@pytest.mark.parametrize(
    "bad",
    [(0, 10, 0), (0, 11, 1), (10, 1, 1), (11, 0, 1), (2**64 - 1, 2, 1), (2**63, 0, 1), (5, 2**32 - 1, 1)],
)
def test_entries_beyond_the_point_array_are_refused(bad):
    entries = np.array([(0, 10, 1), bad], RENDER_POINT)
    with pytest.raises(MessageError, match="entry 1: found offset"):
        split_entries(entries, np.array([0]), 10, 256)


@settings(derandomize=True, max_examples=300, deadline=None)
@given(
    st.lists(st.integers(1, 30), max_size=8), st.lists(st.tuples(st.booleans(), st.integers(0, 8), st.integers(0, 8)))
)
def test_ranges_and_pooled_cells_are_told_apart(sizes, rows):
    first_pooled = np.cumsum([0, *sizes])
    entries, expected = [], []
    for pooled, a, b in rows:
        begin, end = sorted((min(a, len(sizes)), min(b, len(sizes))))
        offset, n = first_pooled[begin], first_pooled[end] - first_pooled[begin]
        entries.append((offset, n, 0) if pooled else (a, b, 1))
        expected += [*range(begin, end)] if pooled else []
    ranges, cells = split_forms(np.array(entries, RENDER_POINT), first_pooled)
    assert cells.tolist() == expected
    assert ranges.tolist() == [entry for entry in entries if entry[2]]


@pytest.mark.parametrize(
    "bad", [(0, 3, 0), (1, 9, 0), (4, 7, 0), (10, 5, 0), (10, 1, 0), (11, 0, 0), (2**64 - 1, 2, 0), (0, 2**32 - 1, 0)]
)
def test_pooled_points_that_are_not_whole_cells_are_refused(bad):
    entries = np.array([(0, 10, 1), (4, 6, 0), bad], RENDER_POINT)
    with pytest.raises(MessageError, match=f"entry 2: found offset {bad[0]}, .*whole cells within 10 pooled points"):
        split_forms(entries, np.array([0, 4, 10]))
    with pytest.raises(MessageError, match=r"entry 1: .*expected whole cells within 0 pooled points"):
        split_forms(entries, np.zeros(1, np.int64))

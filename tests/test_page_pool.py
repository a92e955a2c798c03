"""The pool of pages: what is needed gets there, what is least recently needed goes, and never more than the budget."""

import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.nodes.raster.page_pieces import PageCutter
from splatpipe.nodes.raster.page_pool import PagePool
from splatpipe.nodes.raster.paged import coarsest_pages
from splatpipe.nodes.raster.paged_points import SetTable
from splatpipe.shared.errors import InputError, MessageError, StoreError
from splatpipe.shared.messages import RENDER_POINT

PAGE = 8
N_POINTS = 20 * PAGE - 3
N_PAGES = 20


def numbered(first, x, y, z, colour):
    """Every column of a point is its number."""
    for column in (x, y, z, *([] if colour is None else [colour])):
        column[:] = np.arange(first, first + len(x))


def pool_of(n_slots, read=numbered, **options):
    return PagePool(N_POINTS, PAGE, n_slots * PAGE * 16 + 5, read, **options)


def need(pool, *pages):
    with pool.lock:
        pool.need([np.array(p, np.int64) for p in pages])


def resident(pool):
    return set(np.flatnonzero(pool.slot_of_page >= 0).tolist())


def check_contents(pool):
    """Each resident page has a slot of its own, and its own points in it."""
    slots = pool.slot_of_page[sorted(resident(pool))]
    assert len(set(slots.tolist())) == len(slots) <= pool.n_slots
    assert len(pool.x) == len(pool.colour) == pool.n_slots * PAGE
    for page in resident(pool):
        first, at = page * PAGE, pool.slot_of_page[page] * PAGE
        n = min(PAGE, N_POINTS - first)
        for column in (pool.x, pool.y, pool.z, pool.colour):
            np.testing.assert_array_equal(column[at : at + n], np.arange(first, first + n))


needs = st.lists(
    st.lists(st.lists(st.integers(0, N_PAGES - 1), max_size=9), min_size=1, max_size=3), min_size=1, max_size=8
)


@settings(max_examples=60, derandomize=True, deadline=None)
@given(needs, st.integers(1, 7), st.sampled_from([1, 3]))
def test_what_is_needed_is_there_and_what_goes_was_needed_least_recently(asked, n_slots, loaders):
    last_need = {}
    with pool_of(n_slots, loaders=loaders) as pool:
        for clock, frames in enumerate(asked):
            before = resident(pool)
            need(pool, *frames)
            pool.settle()
            needed = list(dict.fromkeys(page for frame in frames for page in frame))[:n_slots]
            last_need |= dict.fromkeys(needed, clock)
            after = resident(pool)
            assert set(needed) <= after, "as many as fit, in the order in which they are needed"
            assert after - before <= set(needed), "nothing else is loaded"
            assert max((last_need[page] for page in before - after), default=-1) <= min(
                (last_need[page] for page in after - set(needed)), default=clock
            )
            check_contents(pool)


def test_pages_that_are_not_needed_go_only_for_those_that_are():
    with pool_of(3, loaders=1) as pool:
        for page in (5, 6, 7, 5):
            need(pool, [page])
            pool.settle()
        need(pool, [8])
        pool.settle()
        assert resident(pool) == {5, 7, 8}
        need(pool, [5, 7, 8, 9])
        pool.settle()
        assert resident(pool) == {5, 7, 8}, "a page that is needed is never evicted"
        assert pool.n_evicted == 1
        assert pool.loaded_bytes == 4 * PAGE * 16


def test_pinned_pages_stay():
    with pool_of(4, pinned=np.array([2, 19])) as pool:
        assert resident(pool) == {2, 19}, "they are there from the start"
        assert pool.capacity == 2
        for page in range(N_PAGES):
            need(pool, [page, (page + 7) % N_PAGES, 19])
            pool.settle()
            assert {2, 19, page} <= resident(pool)
        check_contents(pool)


def test_the_coarsest_levels_are_pinned_whole():
    level = np.array([3, 3, 2, 2, 2, 1, 0], np.uint8)
    assert coarsest_pages(level, 7).tolist() == list(range(7))
    assert coarsest_pages(level, 4).tolist() == [5, 6]
    assert coarsest_pages(level, 1).tolist() == [6]
    assert coarsest_pages(level, 0).tolist() == []


def test_one_colour_takes_no_slots():
    with PagePool(N_POINTS, PAGE, 2 * PAGE * 12, numbered, one_colour=np.uint32(7)) as pool:
        assert pool.n_slots == 2
        assert pool.colour.strides == (0,)
        need(pool, [3])
        pool.settle()
        assert pool.x[pool.slot_of_page[3] * PAGE] == 3 * PAGE


def test_there_are_no_more_slots_than_pages():
    with pool_of(1000) as pool:
        assert pool.n_slots == N_PAGES


def test_a_budget_below_a_page_is_refused():
    with pytest.raises(InputError, match=r"memory.budget: found 127 bytes, expected at least 128, a page of 8 points"):
        PagePool(N_POINTS, PAGE, 127, numbered)
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("page-")]


def test_whoever_waits_is_told_what_a_loader_failed_with_and_threads_end():
    def read(first, *_):
        if first == 3 * PAGE:
            raise StoreError("x.npy: ended early")

    with pool_of(4, read) as pool:
        need(pool, [1, 2])
        pool.settle()
        need(pool, [3])
        with pytest.raises(StoreError, match="ended early"):
            pool.settle()
        with pytest.raises(StoreError, match="ended early"):
            need(pool, [1])
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("page-")]


def test_a_pool_that_is_closed_while_loading_ends():
    started, go_on = threading.Event(), threading.Event()

    def read(*_):
        started.set()
        go_on.wait(10)

    pool = pool_of(4, read, loaders=2)
    need(pool, range(4))
    started.wait(10)
    go_on.set()
    pool.close()
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("page-")]


# --- pieces of pages ---------------------------------------------------------------------------------------------


def random_sets(rng, n_sets):
    """Sets of a forest, in any stored order."""
    borders = np.sort(rng.choice(np.arange(1, N_POINTS), n_sets - 1, replace=False))
    parent = np.array([rng.integers(-1, i) if i else -1 for i in range(n_sets)], np.int32)
    place = rng.permutation(n_sets).astype(np.int32)
    shuffled = np.empty(n_sets, np.int32)
    shuffled[place] = np.where(parent < 0, -1, place[parent])
    return SetTable(np.r_[0, borders, N_POINTS].astype(np.int64), shuffled, np.zeros(n_sets, np.uint8))


def drawn_twin(entries, there, sets, fallback):
    """(points drawn, sorted; points of entries that are missing): plain Python."""
    drawn, missing, ancestors = [], [], set()
    for offset, length, stride in entries.tolist():
        lost = {}  # page → first of its points that is missed
        for point in range(offset, offset + length, stride):
            (drawn if there[point // PAGE] else missing).append(point)
            if fallback and not there[point // PAGE]:
                lost.setdefault(point // PAGE, point)
        for page, first in lost.items():
            stop = min((page + 1) * PAGE, offset + length)
            for cell in range(len(sets.parent)):
                if sets.first[cell] >= stop or sets.first[cell + 1] <= first:
                    continue
                ancestor = sets.parent[cell]
                while ancestor >= 0:
                    begin, end = sets.first[ancestor], sets.first[ancestor + 1]
                    if all(there[begin // PAGE : (end - 1) // PAGE + 1]):
                        ancestors.add(int(ancestor))
                        break
                    ancestor = sets.parent[ancestor]
    for ancestor in ancestors:
        drawn += range(sets.first[ancestor], sets.first[ancestor + 1])
    return sorted(drawn), len(missing)


entry = st.tuples(st.integers(0, N_POINTS), st.integers(0, 90), st.sampled_from([1, 1, 1, 3, 20]))


@settings(max_examples=300, derandomize=True, deadline=None)
@given(st.lists(entry, max_size=5), st.integers(0, 2**32 - 1), st.integers(1, 12), st.booleans(), st.integers(1, 12))
def test_pieces_are_the_resident_part_and_ancestors_of_the_rest(rows, seed, n_sets, fallback, limit):
    rng = np.random.default_rng(seed)
    entries = np.array([(o, min(r, N_POINTS - o), s) for o, r, s in rows], RENDER_POINT)
    sets = random_sets(rng, n_sets)
    there = rng.random(N_PAGES) < rng.random()
    slots = np.where(there, rng.permutation(N_PAGES), -1).astype(np.int32)
    segment_first = np.unique(np.r_[0, rng.integers(1, N_POINTS, 4)])
    cutter = PageCutter(N_POINTS, PAGE, segment_first, sets, limit)
    for _ in range(2):  # marks of the first call do not matter
        cut = cutter.cut(entries, slots, fallback=fallback)
    page_of_slot = np.full(N_PAGES, -1)
    page_of_slot[slots[there]] = np.flatnonzero(there)
    drawn, ends = [], np.r_[segment_first[1:], N_POINTS]
    for piece in cut.pieces:
        at = piece["first"] + np.arange(piece["count"]) * int(piece["stride"])
        assert len(set((at // PAGE).tolist())) == 1, "a piece lies in one slot"
        assert 1 <= len(at) <= limit
        stored = page_of_slot[at // PAGE] * PAGE + at % PAGE
        assert segment_first[piece["segment"]] <= stored[0] <= stored[-1] < ends[piece["segment"]]
        drawn += stored.tolist()
    expected, n_missing = drawn_twin(entries, there, sets, fallback)
    wanted = [p for o, r, s in entries.tolist() for p in range(o, o + r, s)]
    assert sorted(drawn) == expected
    assert (cut.n_wanted, cut.n_missing) == (len(wanted), n_missing)
    assert set(cut.used.tolist()) == {p // PAGE for p in drawn}
    assert set(cut.missing.tolist()) >= {p // PAGE for p in wanted if not there[p // PAGE]}
    assert not there[cut.missing].any()
    pages = cutter.pages(entries).tolist()
    assert len(set(pages)) == len(pages)
    assert set(pages) >= {p // PAGE for p in wanted}


def test_entries_beyond_the_point_array_are_refused():
    cutter = PageCutter(N_POINTS, PAGE, np.zeros(1, np.int64), random_sets(np.random.default_rng(0), 3), 8)
    for bad in ((N_POINTS, 1, 1), (0, 4, 0)):
        with pytest.raises(MessageError, match="render-points entry 0"):
            cutter.pages(np.array([bad], RENDER_POINT))

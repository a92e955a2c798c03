"""Compositing policies against np.minimum.reduce: in threads on any number of ranks, and on real ones."""

import queue
import re
import sys
import threading
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from splatpipe.cluster.compositing import make_compositor
from splatpipe.cluster.compositing.model import POLICIES, Rates, cheapest, compositing_cost
from splatpipe.cluster.compositing.rounds import k_values, part_held
from splatpipe.cluster.launch import mpi_available
from splatpipe.cluster.transport import Received
from splatpipe.shared import framebuffer_runs_reference as reference
from splatpipe.shared.errors import ConfigError, MessageError
from splatpipe.shared.framebuffer_runs import encode_runs, merge_runs
from splatpipe.shared.messages import FRAMEBUFFER_EMPTY, HEADER, Framebuffer, Kind, encode
from test_transport import RANKS, mpiexec

PATIENCE_S = 20


class World:
    """Ranks of one process: a bounded queue for each pair, so that a send waits as ``Transport``'s does."""

    def __init__(self, size: int, depth: int = 2) -> None:
        self.sent = [Counter() for _ in range(size)]
        self.queues = {(a, b): queue.Queue(depth) for a in range(size) for b in range(size)}
        self.ranks = [Fake(self, rank) for rank in range(size)]
        self._reduced, self._barriers = {}, {}
        self._lock = threading.Lock()

    def minimum_of(self, rank, ranks):
        with self._lock:
            barrier = self._barriers.setdefault(tuple(ranks), threading.Barrier(len(ranks)))

        def minimum(values):
            self._reduced[rank] = values
            barrier.wait(PATIENCE_S)
            least = np.minimum.reduce([self._reduced[r] for r in ranks]) if rank == ranks[0] else None
            barrier.wait(PATIENCE_S)
            return least

        return minimum

    def run(self, policy, ranks, frames, **options):
        """frames : of each, the words of all ranks. Returns what the root has of each; the others must have nothing."""

        def work(rank):
            compositor = make_compositor(policy, self.ranks[rank], ranks, **options)
            found = []
            for frame, words in enumerate(frames):
                whole = compositor.composite(frame, words[ranks.index(rank)])
                found.append(None if whole is None else whole.copy())
            return found

        with ThreadPoolExecutor(len(ranks)) as pool:
            root, *others = pool.map(work, ranks, timeout=3 * PATIENCE_S)
        assert all(words is None for found in others for words in found)
        assert all(q.empty() for q in self.queues.values()), "every message is taken"
        return root


class Fake:
    """The part of ``Transport`` that compositing calls."""

    def __init__(self, world: World, rank: int) -> None:
        self._world, self.rank, self.size = world, rank, len(world.sent)

    def send(self, dest, message):
        head, payload = encode(message)
        assert dest != self.rank
        self._world.sent[self.rank].update(messages=1, bytes=len(head) + len(payload))
        self._world.queues[self.rank, dest].put((message.frame, payload), timeout=PATIENCE_S)

    def receive(self, source, expected, max_bytes, *, patient=False):
        frame, payload = self._world.queues[source, self.rank].get(timeout=PATIENCE_S)
        assert expected is Kind.FRAMEBUFFER
        if len(payload) > max_bytes:
            raise MessageError(f"found {len(payload)} bytes, expected at most {max_bytes}")
        return Received(frame, payload)

    def minimum_of(self, ranks):
        return self._world.minimum_of(self.rank, ranks)


def drawn(rng, shape, coverage):
    """(height, width) words with runs of drawn pixels."""
    words = rng.integers(0, 2**64 - 1, shape, np.uint64)
    words[np.repeat(rng.random((shape[0], -(-shape[1] // 3))) >= coverage, 3, axis=1)[:, : shape[1]]] = (
        FRAMEBUFFER_EMPTY
    )
    return words


# --- all policies, any number of ranks ---------------------------------------------------------------------------

coverages = st.sampled_from([0.0, 0.05, 0.5, 1.0])


@settings(max_examples=60, deadline=None)
@given(
    policy=st.sampled_from([*POLICIES, "auto"]),
    coverage=st.lists(coverages, min_size=1, max_size=13),
    shape=st.tuples(st.integers(1, 9), st.integers(1, 17)),
    radix=st.integers(2, 9),
    depth=st.integers(1, 2),
    seed=st.integers(0, 2**32),
)
def test_any_policy_on_any_ranks_gives_the_minimum(policy, coverage, shape, radix, depth, seed):
    rng = np.random.default_rng(seed)
    n = len(coverage)
    ranks = rng.permutation(n + 2)[:n].tolist()  # some of the world take no part; the root is anywhere
    frames = [[drawn(rng, shape, c) for c in coverage] for _ in range(3)]
    before = [[words.copy() for words in frame] for frame in frames]
    found = World(n + 2, depth).run(policy, ranks, frames, radix=radix)
    for words, copies, whole in zip(frames, before, found, strict=True):
        assert all(np.array_equal(w, c) for w, c in zip(words, copies, strict=True)), "the rasterizer's own"
        assert whole.shape == shape
        assert whole.dtype == np.uint64
        assert np.array_equal(whole, np.minimum.reduce(copies))


@pytest.mark.parametrize("n", [*range(1, 10), 13])
@pytest.mark.parametrize("policy", POLICIES)
def test_sizes_that_do_not_divide_and_less_pixels_than_ranks(policy, n):
    rng = np.random.default_rng(n)
    for shape in ((7, 11), (1, 1), (1, 5)):
        words = [drawn(rng, shape, 0.5) for _ in range(n)]
        (whole,) = World(n).run(policy, list(range(n)), [words])
        assert np.array_equal(whole, np.minimum.reduce(words))


@pytest.mark.parametrize("policy", POLICIES[:-1])
def test_ranks_that_drew_nothing_send_headers_alone(policy):
    shape, n = (40, 50), 7
    nothing = np.full(shape, FRAMEBUFFER_EMPTY)
    world = World(n)
    (whole,) = world.run(policy, list(range(n)), [[nothing] * n])
    assert np.array_equal(whole, nothing)
    assert all(sent["bytes"] == HEADER.size * sent["messages"] for sent in world.sent)
    one = nothing.copy()
    one[20, 25] = 5
    world = World(n)
    (whole,) = world.run(policy, list(range(n)), [[nothing] * 5 + [one, nothing]])
    assert np.array_equal(whole, one)
    bodies = [sent["bytes"] - HEADER.size * sent["messages"] for sent in world.sent]
    assert sum(bodies) <= 24 * 4, "one pixel, one run and a head: once in each round that it crosses"


@pytest.mark.parametrize("policy", POLICIES[:-1])
def test_a_framebuffer_of_another_frame_or_size_is_refused(policy):
    words = np.full((4, 4), np.uint64(7))
    for frame, size, expected in ((8, 8, "found frame 8, expected frame 3"), (3, 17, "expected at most")):
        world = World(2)
        root = make_compositor(policy, world.ranks[0], [0, 1])
        world.queues[1, 0].put((frame, encode(Framebuffer(frame, encode_runs(np.zeros(size, np.uint64))))[1]))
        with pytest.raises(MessageError, match=expected):
            root.composite(3, words)


def test_another_policy_is_refused_in_one_line():
    with pytest.raises(ConfigError, match=r"pipeline\.compositing = 'swap': expected auto or one of direct, direct-r"):
        make_compositor("swap", World(1).ranks[0], [0])


# --- rounds ------------------------------------------------------------------------------------------------------


@given(st.integers(1, 3000), st.integers(2, 40))
def test_k_values_leave_the_fewest_ranks_over(n, radix):
    values = k_values(n, radix)
    met = int(np.prod(values, dtype=np.int64))
    assert all(2 <= k <= radix for k in values)
    assert n < 2 * met <= 2 * n, "each left over has a rank of its own to fold into"
    assert list(values) == sorted(values, reverse=True)
    if n <= radix:
        assert values == ((n,) if n > 1 else ())


@given(st.integers(1, 200), st.integers(2, 9), st.integers(0, 500))
def test_the_parts_that_ranks_hold_are_the_picture(n, radix, n_pixels):
    values = k_values(n, radix)
    held = np.zeros(n_pixels, np.int64)
    sizes = []
    for position in range(int(np.prod(values, dtype=np.int64))):
        first, stop = part_held(position, values, n_pixels)
        held[first:stop] += 1
        sizes.append(stop - first)
    assert (held == 1).all()
    assert max(sizes) - min(sizes) <= len(values) + 1


# --- runs --------------------------------------------------------------------------------------------------------


@given(st.integers(0, 60), st.sampled_from([0.0, 0.2, 0.7, 1.0]), st.integers(0, 2**32))
def test_compiled_runs_are_those_of_the_twin(n, coverage, seed):
    rng = np.random.default_rng(seed)
    words, ours = (drawn(rng, (1, n), c).reshape(-1) for c in (coverage, 0.5))
    runs = encode_runs(words)
    assert np.array_equal(runs, reference.encode_runs(words))
    theirs = ours.copy()
    merge_runs(runs.data, ours)
    reference.merge_runs(runs.data, theirs)
    assert np.array_equal(ours, theirs)


# --- the model ---------------------------------------------------------------------------------------------------

RATES = Rates(latency_s=1e-4, bytes_per_s=1e9, merge_per_s=5e8, scan_per_s=5e8, message_s=1e-5)


@pytest.mark.parametrize("n", [2, 3, 4, 7, 8, 13])
@pytest.mark.parametrize("policy", POLICIES[:-1])
@pytest.mark.parametrize("coverage", [0.0, 1.0])
def test_the_model_counts_what_is_sent(policy, n, coverage):
    words = [np.full((30, 56), FRAMEBUFFER_EMPTY if not coverage else np.uint64(r)) for r in range(n)]
    world = World(n)
    world.run(policy, list(range(n)), [words])
    cost = compositing_cost(policy, n, 30 * 56, coverage, RATES, run_px=1e9)
    assert cost.all_messages == sum(sent["messages"] for sent in world.sent)
    sent = sum(sent["bytes"] for sent in world.sent)
    assert sent == pytest.approx(cost.all_bytes, abs=9 * cost.all_messages), "a run a message, which the model rounds"


def test_the_model_of_one_rank_of_latency_and_of_the_root():
    assert compositing_cost("radix-k", 1, 10**6, 0.5, RATES).seconds == 0
    for policy in POLICIES:
        one, two = (compositing_cost(policy, 64, 10**6, 0.2, Rates(a, 1e9, 5e8, 5e8)).seconds for a in (0, 1e-3))
        rounds = {"direct": 1, "direct-reduce": 2, "binary-swap": 7, "radix-k": 3, "mpi-min": 12}[policy]
        assert two - one == pytest.approx(rounds * 1e-3)
    direct, swap = (compositing_cost(p, 64, 10**6, 1.0, RATES) for p in ("direct", "binary-swap"))
    assert direct.seconds > 10 * swap.seconds, "the root of direct merges 63 pictures, of binary swap one"
    kept = compositing_cost("binary-swap", 64, 10**6, 1.0, RATES, gather=False)
    assert kept.seconds < swap.seconds


def test_auto_is_direct_for_two_ranks_or_few_pixels_and_rounds_for_many():
    assert cheapest(2, 10_000, 0.25, RATES) == "direct"
    assert cheapest(4, 10_000, 0.25, RATES) == "direct"
    assert cheapest(64, 10**6, 0.25, RATES) in ("binary-swap", "radix-k", "direct-reduce")
    assert cheapest(4096, 64 * 10**6, 0.01, RATES) == "radix-k"


# --- real ranks --------------------------------------------------------------------------------------------------


@pytest.mark.mpi
@pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
def test_groups_of_real_ranks_give_the_minimum():
    n = 7
    done = mpiexec(n, sys.executable, str(RANKS / "composite.py"))
    said = sorted(re.findall(r"rank \d done", done.stdout))
    assert said == [f"rank {rank} done" for rank in range(n)], done.stdout + done.stderr

"""When messages are coded, and that nobody sees it in the pictures."""

import io
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from splatpipe.cluster import compression
from splatpipe.cluster.bench.messages import bench_messages, print_messages
from splatpipe.cluster.compression import FASTEST_BYTES_PER_S, Choice, Coding, Link, Tried, pairs_that_talk
from splatpipe.cluster.launch import find_mpiexec, mpi_available
from splatpipe.cluster.plan.command import plan_command
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.config import PipelineSection
from splatpipe.shared.message_codecs import unpack
from splatpipe.shared.messages import (
    RENDER_POINT,
    Framebuffer,
    RenderPoints,
    VisibilityBits,
    encode,
    is_coded,
    parse_header,
)
from splatpipe.shared.synth import CityScan

RANKS = Path(__file__).parent / "ranks"
needs_mpi = pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
GIGABIT, FAST_ETHERNET = 125e6, 12.5e6


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compression")
    build_scene([CityScan(n_points=20_011)], folder / "city", settings=BuildSettings(points_per_cell=300))
    path = folder / "run.toml"
    path.write_text(
        '[scene]\npath = "city"\n[camera]\nwidth = 163\nheight = 91\n'
        '[render]\npoint_size_px = 2\nrasterizer = "cpu"\n[output]\nframes = 4\n'
    )
    return path


# --- the choice ------------------------------------------------------------------------------------------------------


seconds = st.floats(1e-6, 1)


@settings(max_examples=200, derandomize=True)
@given(st.floats(1e3, 1e9), st.integers(1, 10**9), st.floats(0, 1), seconds, seconds)
def test_a_message_is_coded_where_the_link_takes_longer_than_the_codec(bytes_per_s, raw, share, encode_s, decode_s):
    coded = int(raw * share)
    choice = Choice(Link(bytes_per_s))
    choice.learn(Tried(raw, coded, encode_s, decode_s))
    assert choice.codes == ((raw - coded) / bytes_per_s > encode_s + decode_s)
    assert choice.why.startswith("coded: " if choice.codes else "raw: ")


def test_a_framebuffer_is_coded_on_fast_ethernet_and_not_on_gigabit_where_the_codec_is_slower():
    for bytes_per_s, expected in ((FAST_ETHERNET, True), (GIGABIT, False)):
        choice = Choice(Link(bytes_per_s))
        choice.learn(Tried(2_541_488, 1_194_809, 9.9e-3, 7.7e-3))  # a city, 1280 × 720
        assert choice.codes == expected
    assert choice.why == (
        "raw: 125 MB/s; 2,541,488 → 1,194,809 bytes save 10.8 ms and take 9.9 ms + 7.7 ms: pays below 76.5 MB/s"
    )


def test_what_does_not_pay_is_tried_again_now_and_then():
    choice = Choice(Link(GIGABIT))
    tried = 0
    for _ in range(3 + 640):
        code, trial = choice.wants()
        assert code == trial
        if code:
            tried += 1
            choice.learn(Tried(1000, 900, 1.0, 1.0))
    assert tried == 3 + 10
    for _ in range(2):
        choice.learn(Tried(10**9, 0, 0.1, 0.1))  # two of the last three pay
    assert choice.wants() == (True, False)


@pytest.mark.parametrize(
    ("link", "why"),
    [
        (Link(10e9), "raw: 10.0 GB/s; nothing is tried above 2.0 GB/s"),
        (Link(1e9, shared_memory=True), "raw: 1.0 GB/s, shared memory of one host"),
        (Link(), "raw: the link was not measured"),
    ],
)
def test_fast_links_cost_nothing(monkeypatch, link, why):
    monkeypatch.setattr(compression, "pack", None)  # not called
    coding = Coding({1: link})
    head, payload = encode(VisibilityBits(3, 80_000, np.zeros(10_000, np.uint8)))
    for _ in range(100):
        assert coding.coded(1, head, payload) == (head, payload)
    (record,) = coding.record(0)
    counts = record["kinds"]["VISIBILITY"]
    assert counts == {
        "messages": 100, "raw_bytes": 10**6, "sent_bytes": 10**6, "encode_s": 0, "decode_s": 0,
        "forms": {"raw": 100}, "why": why,
    }  # fmt: skip
    assert (record["sender"], record["receiver"]) == (0, 1)
    assert json.dumps(record)


@pytest.mark.parametrize("how", [{"always": True}, {}])
def test_a_slow_link_gets_coded_messages_that_say_so(how):
    entries = np.zeros(2000, RENDER_POINT)
    entries["offset"], entries["range"], entries["stride"] = 20 * np.arange(2000), 10, 1
    coding = Coding({1: Link(10e3)}, **how)
    for message in (RenderPoints(5, entries), VisibilityBits(5, 80_000, np.zeros(10_000, np.uint8))):
        head, payload = encode(message)
        for _ in range(5):
            coded_head, coded = coding.coded(1, head, payload)
            kind, frame, length = parse_header(coded_head)
            assert (kind, frame, length) == (parse_header(head)[0], 5, len(coded))
            assert is_coded(coded_head)
            assert unpack(kind, coded, len(payload)).tobytes() == bytes(payload)
    noise = encode(Framebuffer(5, np.frombuffer(np.random.default_rng(1).bytes(5000), np.uint8)))
    assert coding.coded(1, *noise) == noise, "it is no smaller"
    counts = coding.record(0)[0]["kinds"]
    assert counts["RENDER_POINTS"]["sent_bytes"] < counts["RENDER_POINTS"]["raw_bytes"] / 4
    assert counts["FRAMEBUFFER"]["forms"] == {"raw": 1}
    assert counts["VISIBILITY"]["forms"] == {"runs of bits": 5}


def test_only_ranks_that_send_what_can_be_coded_are_measured():
    def pairs(topology, size, **keys):
        return pairs_that_talk(PipelineSection(topology=topology, **keys), size)

    for topology in ("auto", "pipelined"):
        assert pairs(topology, 5) == [(0, 1), (1, 2)]
    assert pairs("sort-first-only", 4) == [(0, 1), (0, 2), (0, 3)]
    assert pairs("sort-last-only", 4) == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)], "any two may composite"
    assert pairs("sort-last-only", 40) == [(0, rank) for rank in range(1, 40)]
    assert pairs("master-slave", 3) == [(0, 1), (0, 2)]
    assert pairs("hybrid", 4, render_split="shares") == [(0, 1), (1, 2), (1, 3), (2, 3)]
    assert pairs("frame-parallel", 4) == pairs("single", 4) == []
    assert FASTEST_BYTES_PER_S > 1e9


class SlowLink:
    """Stands for a transport: a link that lets a burst pass and is slow from there on; its clock is simulated."""

    def __init__(self, bytes_per_s: float, burst_bytes: int) -> None:
        self.now, self._bytes_per_s, self._burst_bytes = 0.0, bytes_per_s, burst_bytes

    def perf_counter(self) -> float:
        return self.now

    def send_note(self, *_) -> None: ...

    receive_note = send_note

    def bounce(self, _, payload: np.ndarray, *, serve: bool) -> None:
        assert serve
        self.now += 2 * (50e-6 + max(len(payload) - self._burst_bytes, 100) / self._bytes_per_s)


@pytest.mark.parametrize(
    ("bytes_per_s", "burst_bytes"),
    [(1e6, 2000), (12.5e6, 1500), (12.5e6, 1 << 15), (12.5e6, 1 << 17), (125e6, 1 << 16), (1.25e9, 1 << 16), (10e9, 0)],
)
def test_a_link_is_measured_in_fifty_milliseconds_though_bursts_pass_at_once(monkeypatch, bytes_per_s, burst_bytes):
    link = SlowLink(bytes_per_s, burst_bytes)
    monkeypatch.setattr(compression, "time", link)
    found, latency_s = compression.measure_link(link, 1, compression.MOST_LINK_S, serve=True)  # type: ignore[arg-type]
    assert found == pytest.approx(bytes_per_s, rel=0.6 if burst_bytes > 1 << 16 else 0.2)
    assert latency_s == pytest.approx(50e-6 + 100 / bytes_per_s)
    assert link.now < 1.3 * compression.MOST_LINK_S


def test_the_plan_says_what_coding_would_bring(config):
    def part(*sets: str) -> dict:
        plan = plan_command(config, list(sets))
        (found,) = [part for part in plan["parts"] if part["what"] == "compression of messages"]
        return found

    assert part("pipeline.topology=single")["left_out"]
    assert part("pipeline.topology=frame-parallel", "pipeline.ranks=4")["left_out"]
    sort_last = ["pipeline.topology=sort-last-only", "pipeline.ranks=4"]
    auto = part(*sort_last)
    assert not auto["left_out"]
    assert "auto: framebuffers, about 355,992 → " in auto["why"]
    assert "between hosts whose link is measured below about 149 MB/s" in auto["why"]
    slow, fast = (part(*sort_last, f"pipeline.link_mb_per_s={rate}") for rate in (1, 1000))
    assert (slow["left_out"], fast["left_out"]) == (False, True)
    assert slow["gain"] < 0 < fast["gain"] < auto["gain"]
    assert "would save 185 ms at pipeline.link_mb_per_s = 1" in slow["why"]
    assert part(*sort_last, "pipeline.compression=off")["left_out"]
    assert "visibility bits and render-points" in part("pipeline.topology=pipelined")["why"]


def test_the_bench_measures_every_kind_and_says_where_it_pays(config):
    results = bench_messages([config, config.parent / "city"], ["camera.width=64"], frames=2, ranks=2, repeats=1)
    assert [(row["scene"], row["message"]) for row in results["rows"]] == [
        (scene, what)
        for scene in ("run", "city")
        for what in ("visibility", "render-points", "framebuffer", "1 of 2 shares")
    ]
    for row in results["rows"]:
        assert not row["failed"]
        assert row["coded_bytes"] < row["raw_bytes"]
        spent_s = row["encode_s"] + row["decode_s"]
        assert row["break_even_bytes_per_s"] == pytest.approx((row["raw_bytes"] - row["coded_bytes"]) / spent_s)
    console = Console(width=200, record=True, file=io.StringIO())
    print_messages(results, console)
    assert "1 of 2 shares" in console.export_text()


# --- on ranks --------------------------------------------------------------------------------------------------------


@needs_mpi
@pytest.mark.mpi
def test_a_link_is_measured_and_messages_cross_coded():
    command = [str(find_mpiexec()), "-n", "2", sys.executable, str(RANKS / "coded.py")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    said = sorted(re.findall(r"rank \d done", done.stdout))
    assert said == ["rank 0 done", "rank 1 done"], done.stdout + done.stderr


def drawn(config: Path, name: str, *sets: str) -> tuple[dict[str, bytes], dict]:
    out = config.parent / name
    command = [sys.executable, "-m", "splatpipe.cluster", "run", str(config)]
    for item in (f"output.directory={out}", *sets):
        command += ["--set", item]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert done.returncode == 0, done.stderr
    return {path.name: path.read_bytes() for path in out.glob("*.png")}, json.loads((out / "run.json").read_text())


@needs_mpi
@pytest.mark.mpi
def test_pictures_are_the_same_whatever_is_coded(config):
    alone, single = drawn(config, "single", "pipeline.topology=single")
    assert len(alone) == 4
    assert "links" not in single
    for topology, how, kinds in (
        ("pipelined", "compression=on", ["RENDER_POINTS", "VISIBILITY"]),
        ("pipelined", "link_mb_per_s=0.01", ["RENDER_POINTS", "VISIBILITY"]),
        ("sort-last-only", "link_mb_per_s=0.01", ["FRAMEBUFFER"]),
        ("sort-last-only", "compression=auto", ["FRAMEBUFFER"]),
    ):
        ranks = ["pipeline.ranks=2"] if topology == "sort-last-only" else []
        pictures, run = drawn(config, f"{topology}-{how}", f"pipeline.topology={topology}", f"pipeline.{how}", *ranks)
        assert pictures == alone, (topology, how)
        coded = how != "compression=auto"
        for kind in kinds:
            counts = run["messages"][kind]
            assert ("raw_bytes" in counts) == coded, (kind, how)
            assert not coded or counts["bytes"] < 0.8 * counts["raw_bytes"]
            of_links = [link["kinds"][kind] for link in run["links"] if kind in link["kinds"]]
            assert sum(of["messages"] for of in of_links) == counts["count"]
            for of in of_links:
                assert ("raw" in of["forms"]) != coded
                if how == "compression=auto":
                    assert "shared memory of one host" in of["why"]
                if how == "link_mb_per_s=0.01":
                    assert of["why"].startswith("coded: 0.01 MB/s; ")

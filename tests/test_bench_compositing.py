"""``splatpipe bench compositing`` on two ranks: what is counted, the same bits, the paper's case, what is refused."""

import json

import pytest
from rich.console import Console
from splatpipe.cluster import cli
from splatpipe.cluster.bench.compositing import (
    BLUE_GENE_P,
    PAPER,
    extrapolated,
    parse_cases,
    plot_compositing,
    print_compositing,
)
from splatpipe.cluster.compositing.model import POLICIES, Rates
from splatpipe.cluster.launch import mpi_available
from splatpipe.shared.errors import InputError
from splatpipe.shared.messages import HEADER
from typer.testing import CliRunner

RATES = Rates(latency_s=1e-4, bytes_per_s=4e9, merge_per_s=1e9, scan_per_s=1e9, message_s=4e-5, at_once=2)


@pytest.mark.mpi
@pytest.mark.skipif(not mpi_available(), reason="mpi4py or mpiexec is missing: splatpipe[mpi]")
def test_policies_take_turns_and_agree(tmp_path):
    options = ["--ranks", "2", "--sizes", "64x48", "--coverages", "20,100", "--frames", "2"]
    files = ["--json", str(tmp_path / "found.json"), "--plot", str(tmp_path / "found.png")]
    done = CliRunner().invoke(cli.app, ["bench", "compositing", *options, *files])
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "found.json").read_text())
    assert [(row["coverage"], row["policy"]) for row in found["rows"]] == [(c, p) for c in (0.2, 1) for p in POLICIES]
    assert all(row["same_bits"] and row["ms"]["min"] > 0 and row["cpu_ms"] > 0 for row in found["rows"])
    direct = found["rows"][5]
    assert direct["rank_bytes"] == HEADER.size + 16 + 8 * 64 * 48
    assert direct["rank_messages"] == 1
    assert direct["model"]["rank_bytes"] == pytest.approx(direct["rank_bytes"], rel=0.07), "one run, not one of 16 px"
    assert all(found["rates"][name] > 0 for name in ("latency_s", "bytes_per_s", "merge_per_s", "scan_per_s"))
    assert (tmp_path / "found.png").read_bytes()[1:4] == b"PNG"
    assert "binary-swap" in done.output
    assert "← auto" in done.output


def test_the_paper_is_met_by_parts_and_not_at_one_root():
    rows = extrapolated(RATES, 8)
    few = {row["policy"]: row for row in rows if row["coverage"] < 1}
    all_of_it = {row["policy"]: row for row in rows if row["coverage"] == 1}
    gathered_s = 8 * PAPER["pixels"] / BLUE_GENE_P["bytes_per_s"]
    for row in (few["radix-k"], all_of_it["radix-k"]):
        assert row["bounded_s"] < row["parts_s"] < row["root_s"]
        assert row["root_s"] > 0.9 * gathered_s, "64 million words into one link"
    assert 0.25 < few["radix-k"]["parts_s"] / PAPER["seconds"] < 4
    assert few["direct"]["parts_s"] is None
    assert few["direct"]["root_s"] > 10 * few["radix-k"]["root_s"]
    assert all_of_it["direct-reduce"]["rank_messages"] == 32_768


def test_tables_and_plot_of_what_was_found(tmp_path):
    ms = {"median": 2.0, "min": 1.0, "p95": 3.0}
    case = {
        "ranks": 2,
        "width": 64,
        "height": 48,
        "coverage": 0.1,
        "ms": ms,
        "rank_bytes": 3e6,
        "rank_messages": 1,
        "n_drawing": 1,
        "cpu_ms": 4.0,
    }
    model = {"ms": 1.0, "rank_bytes": 1e6, "rank_messages": 2}
    rows = [case | {"policy": p, "model": model, "auto": p == "direct", "same_bits": p != "radix-k"} for p in POLICIES]
    found = {
        "frames": 1,
        "radix": 8,
        "rows": rows,
        "rates": vars(RATES),
        "extrapolated": extrapolated(RATES, 8),
        "paper": PAPER,
        "machine": {"cpu": "one", "cores": 2, "commit": None},
    }
    console = Console(width=160, record=True)
    print_compositing(found, console)
    said = console.export_text()
    assert "direct ← auto" in said
    assert "2 (1 drew)" in said
    assert "radix-k: OTHER BITS" in said
    assert "1.00 *" in said, "MPI's own bytes are by the model"
    plot_compositing(found, tmp_path / "plot.png")
    assert (tmp_path / "plot.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("1", "64x48", [10], ""), "--ranks '1': expected a whole number, 2 to 64"),
        (("2,x", "64x48", [10], ""), "--ranks 'x'"),
        (("2", "64", [10], ""), "--sizes '64': expected WIDTHxHEIGHT"),
        (("2", "64x99999", [10], ""), "--sizes '99999': expected a whole number, 1 to 16384"),
        (("2", "64x48", [10, 101], ""), "--coverages: found 101, expected at most 100"),
        (("2", "64x48", [10], "direct,swap"), "--policies 'swap': expected one of direct, direct-reduce"),
    ],
)
def test_cases_that_are_none_are_refused_in_one_line(arguments, expected):
    with pytest.raises(InputError, match=expected):
        parse_cases(*arguments)


def test_cases_of_the_command_line():
    cases = parse_cases("2, 4", "64x48,1x2", [10, 50], "")
    assert cases == {"ranks": [2, 4], "sizes": [(64, 48), (1, 2)], "coverages": [0.1, 0.5], "policies": list(POLICIES)}

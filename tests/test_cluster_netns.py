"""Hosts on one machine: what the script refuses, and a run over three hosts joined by TCP alone."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from splatpipe.cluster.launch import find_mpiexec, mpi_available
from splatpipe.shared.build import BuildSettings, build_scene
from splatpipe.shared.synth import CityScan

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "cluster_netns"
SPLATPIPE = [sys.executable, "-m", "splatpipe.cluster"]


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(arguments, capture_output=True, text=True, timeout=100, check=False)


@pytest.fixture
def cluster():
    """The script; skips where it cannot make a cluster, with what it says."""
    missing = [tool for tool in ("ip", "tc", "unshare", "nsenter", "setpriv") if shutil.which(tool) is None]
    if missing:
        pytest.skip(f"{missing[0]} is missing: Debian's iproute2 or util-linux")
    if os.getuid():
        pytest.skip("network namespaces need root")
    tried = call(str(SCRIPT), "--hosts", "1", "--", "true")
    if tried.returncode:
        pytest.skip(f"no namespaces here: {tried.stderr.strip()}")
    if not mpi_available() or "HYDRA" not in call(str(find_mpiexec()), "--version").stdout:
        pytest.skip("mpi4py with MPICH is missing: splatpipe[mpi]")
    return str(SCRIPT)


@pytest.mark.mpi
def test_three_hosts_draw_the_bits_of_one_rank(cluster, tmp_path):
    build_scene([CityScan(n_points=20_011)], tmp_path / "city", settings=BuildSettings(points_per_cell=300))
    config = tmp_path / "run.toml"
    config.write_text(
        f'[scene]\npath = "{tmp_path}/city"\n[camera]\nwidth = 163\nheight = 91\n[render]\nrasterizer = "cpu"\n'
        "threads = 1\n[output]\nframes = 3\n"
    )
    run = [*SPLATPIPE, "run", str(config), "--set"]
    alone = call(*run, "pipeline.topology=single", "--set", f"output.directory={tmp_path}/alone")
    assert alone.returncode == 0, alone.stderr
    over = call(
        *(cluster, "--rate", "1gbit", "--", "sh", "-c"),
        f"ip -o link | wc -l; {' '.join(run)} pipeline.topology=pipelined --set output.directory={tmp_path}/over",
    )
    assert over.returncode == 0, over.stderr
    record = json.loads((tmp_path / "over" / "run.json").read_text())
    assert [rank["host"] for rank in record["ranks"]] == ["host1", "host2", "host3"]
    pictures = {
        folder: {p.name: p.read_bytes() for p in (tmp_path / folder).glob("*.png")} for folder in ("alone", "over")
    }
    assert len(pictures["alone"]) == 3
    assert pictures["over"] == pictures["alone"]
    assert "switch0" not in call("ip", "-o", "link").stdout, "nothing is left"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--rate", "5", "--", "true"], "--rate 5: expected a whole number of kbit, mbit or gbit"),
        (["--hosts", "0", "--", "true"], "--hosts 0: expected 1 to 250"),
        (["--frobnicate"], "--frobnicate: expected --hosts"),
        ([], "no command"),
    ],
)
def test_what_the_script_refuses(arguments, said):
    if shutil.which("bash") is None:
        pytest.skip("bash is missing")
    done = call(str(SCRIPT), *arguments)
    assert done.returncode == 2
    assert done.stderr.startswith(f"cluster_netns: {said}")
    assert done.stderr.count("\n") == 1

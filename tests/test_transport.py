"""The transport on real ranks, and what the launcher says of ranks that die."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from splatpipe.cluster.launch import find_mpiexec

pytest.importorskip("mpi4py", reason="mpi4py is missing: splatpipe[mpi]")
pytestmark = pytest.mark.mpi
RANKS = Path(__file__).parent / "ranks"


def mpiexec(n_ranks: int, *command: str, timeout: float = 60) -> subprocess.CompletedProcess[str]:
    program = find_mpiexec()
    assert program is not None
    return subprocess.run(
        [program, "-n", str(n_ranks), *command], capture_output=True, text=True, timeout=timeout, env=dict(os.environ)
    )


def test_messages_of_every_kind_go_round_in_pieces_and_bad_ones_are_refused():
    done = mpiexec(3, sys.executable, str(RANKS / "exchange.py"))
    said = sorted(re.findall(r"rank \d done", done.stdout))
    assert said == ["rank 0 done", "rank 1 done", "rank 2 done"], done.stdout + done.stderr

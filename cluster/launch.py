"""Starting ranks: find the ``mpiexec`` of mpi4py, run it, relay what its ranks say, name the one that died.

Ranks talk to the launcher in *records*: lines on standard output that start with ``RECORD``, so that progress,
results and process ids survive the way through mpiexec. Everything else a rank prints is passed on.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import selectors
import shutil
import signal
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..shared.errors import DeviceError, SplatpipeError

RECORD = "@splatpipe "
EXPECTED_RANKS = "SPLATPIPE_RANKS"
_WORLD_VARIABLES = ("PMI_RANK", "PMIX_RANK", "OMPI_COMM_WORLD_RANK", "MPI_LOCALRANKID")
_NOISE = re.compile(
    r"^(=+|=   .*|Abort\(\d+\) on node .*|YOUR APPLICATION TERMINATED .*|This typically refers .*|"
    r"Please see the FAQ .*|)$"
)


def inside_mpi() -> bool:
    """Whether this process is a rank that an ``mpiexec`` or ``srun`` has started."""
    return any(name in os.environ for name in _WORLD_VARIABLES)


def world_size() -> int | None:
    """How many ranks the ``mpiexec`` has started that started this one, where it says so: whichever MPI it is of."""
    sizes = (os.environ.get(name, "") for name in ("PMI_SIZE", "OMPI_COMM_WORLD_SIZE"))
    return next((int(size) for size in sizes if size.isdigit()), None)


def mpi_available() -> bool:
    """Whether mpi4py and an ``mpiexec`` are installed. Imports neither."""
    return importlib.util.find_spec("mpi4py") is not None and find_mpiexec() is not None


def find_mpiexec() -> str | None:
    """Path of the ``mpiexec`` beside this Python (MPI installed by pip), else of the one on PATH."""
    beside = Path(sys.executable).parent / "mpiexec"
    return str(beside) if beside.exists() else shutil.which("mpiexec")


def record(**content: Any) -> None:
    """Send a record to the launcher. Does nothing where there is none, so that a bare ``mpirun`` prints no noise."""
    if EXPECTED_RANKS in os.environ:
        sys.stdout.write(RECORD + json.dumps(content) + "\n")
        sys.stdout.flush()


def say_failed(message: str, status: int) -> None:
    """Say in one line why this rank fails: to the launcher, which repeats the first, or to standard error."""
    line = "splatpipe: " + " ".join(message.split())
    if EXPECTED_RANKS in os.environ:
        record(failed=status, why=line)
    else:
        print(line, file=sys.stderr, flush=True)


def launch(
    arguments: Sequence[str],
    ranks: int,
    on_record: Callable[[dict[str, Any]], None],
    variables: Mapping[str, str] | None = None,
    module: str = "splatpipe.cluster",
) -> int:
    """Run ``python -m MODULE ARGUMENTS`` on ``ranks`` ranks; the exit status.

    on_record : called with each record that is not about a rank's start.
    variables : added to the environment of the ranks.
    Raises DeviceError where there is no mpiexec; SplatpipeError naming rank and cause when a rank dies without a word.
    """
    mpiexec = find_mpiexec()
    if mpiexec is None:
        raise DeviceError("mpiexec: not found beside Python or on PATH; install splatpipe[mpi] or an MPI")
    command = [
        mpiexec,
        *_options(mpiexec),
        "-n",
        str(ranks),
        sys.executable,
        "-m",
        module,
        *arguments,
    ]
    environment = os.environ | {EXPECTED_RANKS: str(ranks), "PYTHONUNBUFFERED": "1"} | dict(variables or {})
    environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=environment,
        start_new_session=True,
    )
    with process, _terminated_with_us(process):
        return _Relay(process, on_record).run()


def _options(mpiexec: str) -> list[str]:
    version = subprocess.run([mpiexec, "--version"], capture_output=True, text=True, check=False)
    if "Open MPI" in version.stdout + version.stderr:
        return [
            "--oversubscribe",
            "--bind-to",
            "none",
        ]  # else it refuses more ranks than cores and pins the threads
    return []


class _terminated_with_us:
    """Ends the ranks when the launcher is interrupted or terminated: no orphans."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def __enter__(self) -> None:
        self._old = signal.getsignal(signal.SIGTERM)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))

    def __exit__(self, *_: object) -> None:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self._old)
        if self._process.poll() is None:
            for sign, patience_s in ((signal.SIGTERM, 3.0), (signal.SIGKILL, None)):
                os.killpg(self._process.pid, sign)
                try:
                    self._process.wait(patience_s)
                    break
                except subprocess.TimeoutExpired:
                    continue


class _Relay:
    """Reads what the ranks print until they have ended, and finds out who ended first when one died.

    The kernel says that a process has ended when its last thread has; ``mpiexec`` ends the other ranks as soon as it
    loses one. A rank that is slow to go can therefore, seldom, be overtaken by one that was ended for its sake.
    """

    def __init__(self, process: subprocess.Popen[str], on_record: Callable[[dict[str, Any]], None]) -> None:
        self._process = process
        self._on_record = on_record
        self._ranks: dict[int, dict[str, Any]] = {}  # pid → announcement
        self._first_dead: int | None = None
        self._failed: int | None = None  # exit status of the first rank that said why
        self._tail: deque[str] = deque(maxlen=40)
        self._selector = selectors.DefaultSelector()

    def run(self) -> int:
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        reader = threading.Thread(target=self._read_errors, daemon=True)
        watcher = threading.Thread(target=self._watch, daemon=True)
        reader.start()
        watcher.start()
        for line in self._process.stdout:
            if line.startswith(RECORD):
                self._take(json.loads(line[len(RECORD) :]))
            elif not _NOISE.match(line.rstrip("\n")):
                sys.stdout.write(line)
            else:
                self._tail.append(line)
        status = self._process.wait()
        reader.join(5)
        self._selector.close()
        if status != 0 and self._failed is None:
            raise SplatpipeError(self._obituary(status))
        return self._failed or status

    def _take(self, content: dict[str, Any]) -> None:
        if "failed" in content:
            if self._failed is None:  # the others fail of the same cause, or because this one has gone
                self._failed = content["failed"]
                print(content["why"], file=sys.stderr, flush=True)
            return
        if "pid" not in content:
            self._on_record(content)
            return
        self._ranks[content["pid"]] = content
        try:
            descriptor = os.pidfd_open(content["pid"])
        except OSError:
            return  # on another host, or gone already: mpiexec's own report must do
        self._selector.register(descriptor, selectors.EVENT_READ, content["pid"])

    def _watch(self) -> None:
        while self._first_dead is None and self._process.poll() is None:
            try:
                ready = self._selector.select(timeout=0.05)
            except (OSError, RuntimeError, KeyError):
                return  # the relay has closed it
            for key, _ in ready:
                if self._first_dead is None:
                    self._first_dead = key.data

    def _read_errors(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self._tail.append(line)
            if not _NOISE.match(line.rstrip("\n")):
                sys.stderr.write(line)
                sys.stderr.flush()

    def _obituary(self, status: int) -> str:
        tail = "".join(self._tail)
        reported = re.search(r"PID (\d+) RUNNING AT", tail)
        pid = self._first_dead or (int(reported[1]) if reported else None)
        who = self._ranks.get(pid or -1)
        name = f"rank {who['rank']} ({who['role']}, pid {pid})" if who else "a rank"
        killed = re.search(r"signal (\d+)\)|signal (\d+)", tail)
        number = int(killed[1] or killed[2]) if killed else status - 128 if status > 128 else 0
        if number and number in set(signal.Signals):
            return f"{name} died: killed by {signal.Signals(number).name}"
        return f"{name} died: exit status {status}"

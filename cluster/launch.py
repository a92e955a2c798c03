"""Starting ranks: find the ``mpiexec`` of mpi4py, run it, relay what its ranks say, name the one that died.

Ranks talk to the launcher in *records*: lines on standard output that start with ``RECORD``, so that progress,
results and process ids survive the way through mpiexec. Everything else a rank prints is passed on.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TextIO

from ..shared.errors import DeviceError, InputError, SplatpipeError
from .watch import MPIEXEC_ENDS_S, RANK_VARIABLES, TAG, Watch, die_with_parent, end_all

RECORD = "@splatpipe "
MPIEXEC_ENDS_US_S = 2.0
"""How long a rank whose MPI call failed keeps quiet: a rank that died is to be named, not the one that noticed."""
EXPECTED_RANKS = "SPLATPIPE_RANKS"
_WORLD_VARIABLES = ("PMI_RANK", "PMIX_RANK", "OMPI_COMM_WORLD_RANK", "MPI_LOCALRANKID")
_TASKS_OF_STEP = "SLURM_STEP_NUM_TASKS"
_WORLD_SIZES = {
    EXPECTED_RANKS: "mpiexec",
    "OMPI_COMM_WORLD_SIZE": "mpiexec",
    "PMI_SIZE": "mpiexec or srun",
    _TASKS_OF_STEP: "srun",
}
"""Variables that say how many ranks were started, and by what; the innermost starter first."""
_REMEDY = {
    "": "start it with the mpiexec beside its Python, or install mpi4py for the MPI of this machine",
    "srun": "try srun --mpi=pmix (Open MPI) or srun --mpi=pmi2 (MPICH); srun --mpi=list says what there is",
}
_NOISE = re.compile(
    r"^(NBC_Progress: .*|Error in NBC_.*|"
    r"=+|=   .*|Abort\(\d+\) on node .*|YOUR APPLICATION TERMINATED .*|This typically refers .*|"
    r"Please see the FAQ .*|)$"
)

_FRAME = "-" * 40
_ABOUT_DEATHS = re.compile(
    r"MPI_ABORT was invoked|noticed that process|job\s+terminated|exited with non-zero|lost commun"
)


def inside_mpi() -> bool:
    """Whether this process is a rank that an ``mpiexec`` or ``srun`` has started."""
    of_step = os.environ.get(_TASKS_OF_STEP, "1")  # without PMI srun sets nothing that MPI would know
    return any(name in os.environ for name in _WORLD_VARIABLES) or (of_step.isdigit() and int(of_step) > 1)


def started_rank() -> int:
    """Number of this process among those that ``mpiexec`` or ``srun`` has started, whatever MPI makes of them."""
    names = (name for name in (*RANK_VARIABLES, "SLURM_PROCID") if os.environ.get(name, "").isdigit())
    return int(os.environ.get(next(names, ""), 0))


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
        sys.stdout.flush()
        os.write(1, f"{RECORD}{json.dumps(content)}\n".encode())  # at once, as threads send records, too


def beat(lives: bool) -> None:
    """Tell the launcher that this rank lives, or that it ends by itself."""
    record(beat=started_rank(), lives=lives)


def say_failed(message: str, status: int) -> None:
    """Say in one line why this rank fails: to the launcher, which repeats the first, or to standard error."""
    line = "splatpipe: " + " ".join(message.split())
    if EXPECTED_RANKS in os.environ:
        record(failed=status, why=line)
    else:
        print(line, file=sys.stderr, flush=True)


def say_refused(transport: Any, statuses: Sequence[int], who: str, why: str) -> int:
    """Of ranks of which some refuse to begin, the first says why; the exit status of all. Collective.

    statuses : of every rank, 0 where it would begin.
    """
    first = next((rank for rank, status in enumerate(statuses) if status), 0)
    if transport.rank == first and (first or started_rank() == 0):  # or each of many worlds of one would say it
        say_failed(f"{who}: {why}" if first else why, statuses[first])
    transport.meet()  # so that the line is out before a rank ends
    return max(statuses)


def fail_all(transport: Any, message: str, status: int, error: BaseException) -> None:
    """Say in one line why this rank fails, and end every rank."""
    show_traceback(error)
    if transport.failed(error):
        time.sleep(MPIEXEC_ENDS_US_S)  # if a rank has died, mpiexec ends this one meanwhile, and the launcher says who
    say_failed(message, status)
    time.sleep(0.2)  # so that the line is relayed before mpiexec tears everything down
    transport.abort(status)


def fail_rank(transport: Any, role: str, error: BaseException) -> None:
    """Say which rank failed and why, in one line, and end every rank."""
    cause = str(error) if isinstance(error, SplatpipeError) else f"{type(error).__name__}: {error}"
    fail_all(transport, f"rank {transport.rank} ({role}): {cause}", getattr(error, "exit_status", 1), error)


def show_traceback(error: BaseException) -> None:
    """On standard error, with ``--debug``."""
    if "SPLATPIPE_DEBUG" in os.environ:
        import traceback

        traceback.print_exception(error)


def launch(
    arguments: Sequence[str],
    ranks: int,
    on_record: Callable[[dict[str, Any]], None],
    variables: Mapping[str, str] | None = None,
    module: str = "splatpipe.cluster",
    timeout_s: float = 300.0,
    survive: bool = False,
) -> int:
    """Run ``python -m MODULE ARGUMENTS`` on ``ranks`` ranks; the exit status.

    on_record : called with each record that is not about a rank's start.
    variables : added to the environment of the ranks.
    timeout_s : how long a process of the run may be stopped before that ends it.
    survive : where MPI can do that, the other ranks go on when one dies.
    Raises DeviceError where there is no mpiexec; SplatpipeError naming rank and cause when a rank dies without a word.
    """
    mpiexec = find_mpiexec()
    if mpiexec is None:
        raise DeviceError("mpiexec: not found beside Python or on PATH; install splatpipe[mpi] or an MPI")
    options, survives = _options(mpiexec, survive)
    command = [
        mpiexec,
        *options,
        "-n",
        str(ranks),
        sys.executable,
        "-m",
        module,
        *arguments,
    ]
    environment = os.environ | {EXPECTED_RANKS: str(ranks), "PYTHONUNBUFFERED": "1"} | dict(variables or {})
    environment |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    tag = f"{os.getpid()}-{secrets.token_hex(8)}"
    environment[TAG] = tag
    watch = Watch(tag, timeout_s, ranks if survives else 0, lambda why: print(f"splatpipe: {why}", file=sys.stderr))
    process = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        errors="replace",
        env=environment,
        start_new_session=True,
        preexec_fn=die_with_parent,
    )
    with process, _ended_with_us(process, tag):
        return _Relay(process, on_record, watch).run()


def _options(mpiexec: str, survive: bool) -> tuple[list[str], bool]:
    """What this ``mpiexec`` needs to be told, and whether ranks will go on when one dies."""
    version = subprocess.run([mpiexec, "--version"], capture_output=True, text=True, check=False)
    if not re.search(r"Open MPI|OpenRTE", version.stdout + version.stderr):  # OpenRTE: of Open MPI 4 and before
        return [], False
    options = ["--oversubscribe", "--bind-to", "none"]  # else it refuses more ranks than cores and pins the threads
    number = re.search(r"\) (\d+)\.", version.stdout)
    survives = survive and number is not None and int(number[1]) >= 5 and _has_ulfm(mpiexec)
    return options + ["--with-ft", "ulfm"] * survives, survives


def _has_ulfm(mpiexec: str) -> bool:
    """Whether an Open MPI was built with user-level fault mitigation."""
    info = Path(mpiexec).resolve().parent / "ompi_info"
    info = info if info.exists() else Path(mpiexec).parent / "ompi_info"
    try:
        said = subprocess.run([str(info)], capture_output=True, text=True, check=False, timeout=30).stdout
    except (OSError, subprocess.SubprocessError):
        return False
    return "FT MPI support: yes" in said


def check_starter(library: str) -> None:
    """Raise InputError if the ranks were started by Open MPI and ``library``, mpi4py's, is another, which cannot begin.

    Other mixtures begin, as worlds of one rank each: ``check_started``.
    """
    if "OMPI_COMM_WORLD_SIZE" in os.environ and not library.startswith("Open MPI"):
        raise InputError(f"mpiexec: found that of Open MPI, expected that of mpi4py's MPI ({library}); {_REMEDY['']}")


def check_started(size: int, library: str) -> None:
    """Raise InputError if the world of MPI is not what its starter says: another MPI than mpi4py's has started it."""
    for name, starter in _WORLD_SIZES.items():
        if not os.environ.get(name, "").isdigit():
            continue
        if int(os.environ[name]) != size:
            raise InputError(
                f"{starter}: found a world of {size} ranks, expected {os.environ[name]} ({name}); "
                f"it belongs to another MPI than mpi4py's ({library}): {_REMEDY.get(starter, _REMEDY[''])}"
            )
        return


class _ended_with_us:
    """Ends the ranks when the launcher is interrupted or terminated: no orphans."""

    def __init__(self, process: subprocess.Popen[str], tag: str) -> None:
        self._process = process
        self._tag = tag

    def __enter__(self) -> None:
        self._old = signal.getsignal(signal.SIGTERM)
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))

    def __exit__(self, *_: object) -> None:
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self._old)
        if self._process.poll() is None:
            with suppress(ProcessLookupError, subprocess.TimeoutExpired):
                os.killpg(self._process.pid, signal.SIGTERM)  # so that it ends those on other hosts
                self._process.wait(MPIEXEC_ENDS_S)
        end_all(self._tag)


class _Relay:
    """Reads what the ranks print until they have ended; says which one died, by what the watch has seen."""

    def __init__(
        self, process: subprocess.Popen[str], on_record: Callable[[dict[str, Any]], None], watch: Watch
    ) -> None:
        self._process = process
        self._on_record = on_record
        self._watch = watch
        self._failed: int | None = None  # exit status of the first rank that said why
        self._done: int | None = None  # exit status on which all ranks agree
        self._tail: deque[str] = deque(maxlen=40)

    def run(self) -> int:
        assert self._process.stdout is not None
        self._watch.start(self._process)
        reader = threading.Thread(target=self._read_errors, daemon=True)
        reader.start()
        for line in self._process.stdout:
            if line.startswith(RECORD):
                self._take(line[len(RECORD) :])
            else:
                self._pass_on(line, sys.stdout)
        status = self._process.wait()
        self._watch.finish()
        reader.join(5)
        if self._failed is None and self._done is not None:
            return self._done
        if self._failed is None and (status != 0 or self._watch.verdict):
            raise SplatpipeError(self._watch.verdict or self._obituary(status))
        return self._failed or status

    def _take(self, line: str) -> None:
        try:
            content = json.loads(line)
        except ValueError:
            return  # cut off by a rank's death
        if "failed" in content:
            if self._failed is None:  # the others fail of the same cause, or because this one has gone
                self._failed = content["failed"]
                stopped = self._watch.stopped()
                why = content["why"]
                print(
                    f"splatpipe: {stopped} is stopped: {why.removeprefix('splatpipe: ')}" if stopped else why,
                    file=sys.stderr,
                )
                self._watch.failed()
        elif "done" in content and "doing" not in content:
            self._done = content["done"]
            self._watch.over()
        elif "beat" in content:
            self._watch.heard(content["beat"], content["lives"])
        elif "pid" in content:
            self._watch.announce(content)
        else:
            self._on_record(content)

    def _read_errors(self) -> None:
        assert self._process.stderr is not None
        block: list[str] | None = None  # Open MPI frames what it has to say itself in dashes
        for line in self._process.stderr:
            if not line.startswith(_FRAME):
                if block is None:
                    self._pass_on(line, sys.stderr)
                else:
                    block.append(line)
            elif block is None:
                block = []
            else:
                self._tail.extend(block)
                if not _ABOUT_DEATHS.search("".join(block)):
                    sys.stderr.writelines(block)
                block = None
        self._tail.extend(block or ())

    def _pass_on(self, line: str, to: TextIO) -> None:
        """Print a line of a rank's, and keep one of mpiexec's."""
        self._tail.append(line)
        if not _NOISE.match(line.rstrip("\n")):
            to.write(line)
            to.flush()

    def _obituary(self, status: int) -> str:
        tail = "".join(self._tail)
        pid = self._watch.first_dead()
        name = self._watch.name(pid) if pid else "a rank"
        killed = re.search(r"signal (\d+)", " ".join(tail.split()))
        if pid is None and status < 0:
            name, killed = self._watch.name(self._process.pid), None
        number = int(killed[1]) if killed else -status if status < 0 else status - 128 if status > 128 else 0
        if number and number in set(signal.Signals):
            return f"{name} died: killed by {signal.Signals(number).name}"
        return f"{name} died: exit status {status}"

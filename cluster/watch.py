"""Watching the ranks of a run from the launcher, so that whatever befalls one of them ends the run and is named.

A rank holds a connection to the launcher for as long as it lives. The kernel closes it with the rank's other files,
which is what ``mpiexec`` notices, too; so the first connection that breaks off is that of the rank that died, and not
of one that ``mpiexec`` ended for its sake. A rank that ends by itself says so first. On other hosts, which the
connection does not reach, a rank sends a *beat* now and then instead.

A stopped process (SIGSTOP) holds its connection and says nothing: the launcher looks for such ones. Everything that
``mpiexec`` starts has the run's tag in its environment, so that nothing is left over on this host, whoever its parent
has become. The other way round the ranks, and what started them, are killed by the kernel when their parent dies.
"""

from __future__ import annotations

import atexit
import ctypes
import os
import selectors
import signal
import socket
import struct
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

TAG = "SPLATPIPE_RUN"
"""Environment variable that marks every process of a run."""
RANK_VARIABLES = ("PMI_RANK", "PMIX_RANK", "OMPI_COMM_WORLD_RANK")
MPIEXEC_ENDS_S = 3.0
"""How long ``mpiexec`` has to end the other ranks when one has died or failed; then the launcher does it."""
MPI_ENDS_S = 10.0
"""How long ranks have that have done all their work; a death would leave the others waiting for it in MPI_Finalize."""
BEAT_S = 5.0
LEAST_SILENCE_S = 30.0
"""A rank on another host that is not heard of for this long, or for ``timeout_s`` if that is longer, is lost."""
_SELECT_S = 0.05
_LEAVING = b"leaving"
_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """Have the kernel kill this process when the thread that started it ends. Linux; also of a stopped process."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def attach(beat: Callable[[bool], None]) -> None:
    """Let the launcher watch this rank until it ends; to be called first thing. Does nothing without a launcher.

    beat : says that this rank lives, or that it ends by itself; where the launcher is on another host, called by a
        thread every ``BEAT_S``.
    """
    if TAG not in os.environ:
        return
    die_with_parent()
    rank = next((os.environ[name] for name in RANK_VARIABLES if name in os.environ), "")
    link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        link.connect(_address(os.environ[TAG]))
        link.sendall(rank.encode() + b"\n")
    except OSError:
        link.close()
        ending = threading.Event()
        thread = threading.Thread(target=_beat, args=(beat, ending), name="beat", daemon=True)
        thread.start()
        atexit.register(lambda: (ending.set(), thread.join()))
        return
    threading.Thread(target=_end_with_launcher, args=(link,), name="launcher", daemon=True).start()
    atexit.register(_leave, link)


def _leave(link: socket.socket) -> None:
    with suppress(OSError):
        link.sendall(_LEAVING)


def _end_with_launcher(link: socket.socket) -> None:
    with suppress(OSError):
        link.recv(1)
    os.kill(os.getpid(), signal.SIGKILL)  # the launcher has gone, and says nothing before


def _beat(beat: Callable[[bool], None], ending: threading.Event) -> None:
    beat(True)
    while not ending.wait(BEAT_S):
        beat(True)
    beat(False)


def _address(tag: str) -> str:
    return f"\0splatpipe-{tag}"


def processes_of(tag: str) -> Iterator[tuple[int, str]]:
    """(pid, state) of the processes on this host that have a run's tag, this one left out. Cost: a look at each."""
    wanted = f"{TAG}={tag}".encode()
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        with suppress(OSError, IndexError):
            if wanted in (entry / "environ").read_bytes().split(b"\0"):
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
                if state not in "ZX":
                    yield int(entry.name), state


def _rank_of(pid: int) -> str:
    """Number of a rank that has said nothing yet, by its environment; empty if the process is no rank."""
    with suppress(OSError):
        variables = Path(f"/proc/{pid}/environ").read_bytes().decode(errors="replace").split("\0")
        found = {variable.partition("=")[0]: variable.partition("=")[2] for variable in variables}
        return next((found[name] for name in RANK_VARIABLES if name in found), "")
    return ""


def end_all(tag: str, patience_s: float = 5.0) -> None:
    """Kill every process of a run on this host, stopped ones too, and wait until they have gone."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        left = [pid for pid, _ in processes_of(tag)]
        if not left:
            return
        for pid in left:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.01)


class Watch:
    """Watches ``mpiexec`` and its ranks in a thread, and ends them when one has died, failed or fallen silent.

    tag : of the run, in the environment of all its processes.  timeout_s : how long a process may be stopped.
    survivable : 0, or how many ranks there are, of which the others go on when one dies once all have announced
        themselves; then a stopped rank is killed, so that they notice.
    say : called with a line about a rank whose death is survived.
    """

    def __init__(self, tag: str, timeout_s: float, survivable: int, say: Callable[[str], None]) -> None:
        self._tag, self._timeout_s, self._survivable, self._say = tag, timeout_s, survivable, say
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(_address(tag))
        self._listener.listen(1024)
        self._listener.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._ranks: dict[int, dict[str, Any]] = {}  # pid → what it has announced
        self._numbers: dict[int, str] = {}  # pid → rank, as it connected
        self._leaving: set[int] = set()
        self._dead: list[int] = []  # pids, in the order in which they died
        self._stopped_since: dict[int, float] = {}
        self._heard: dict[int, float] = {}  # rank on another host → when it was heard of last
        self._deadline = float("inf")
        self.verdict = ""
        """Why the launcher ended the run, where it did."""

    def start(self, process: subprocess.Popen[str]) -> None:
        """Begin; ``process`` is that of ``mpiexec``."""
        self._process = process
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._thread.start()

    def finish(self) -> None:
        """Wait until ``mpiexec`` and all ranks have gone."""
        self._thread.join()

    def announce(self, content: dict[str, Any]) -> None:
        """Take what a rank says of itself: rank, role, pid."""
        self._ranks[content["pid"]] = content

    def heard(self, rank: int, lives: bool) -> None:
        """A rank on another host lives, or ends by itself."""
        if lives:
            self._heard[rank] = time.monotonic()
        else:
            self._heard.pop(rank, None)

    def failed(self) -> None:
        """A rank has failed and said why: the run must end soon."""
        self._deadline = min(self._deadline, time.monotonic() + MPIEXEC_ENDS_S)

    def over(self) -> None:
        """All ranks have done their work together: none may keep the others waiting at the end of MPI."""
        self._deadline = min(self._deadline, time.monotonic() + MPI_ENDS_S)

    def first_dead(self) -> int | None:
        """Process id of the rank that died first."""
        return self._dead[0] if self._dead else None

    def stopped(self) -> str:
        """Name of the process that has been stopped for longest, empty if none is."""
        self._look_for_stopped()
        return self.name(next(iter(self._stopped_since))) if self._stopped_since else ""

    def name(self, pid: int) -> str:
        """What a process is called where it is named."""
        if pid == self._process.pid:
            return f"mpiexec (pid {pid})"
        if pid in self._ranks:
            return f"rank {self._ranks[pid]['rank']} ({self._ranks[pid]['role']}, pid {pid})"
        number = self._numbers.get(pid) or _rank_of(pid)
        if number:
            return f"rank {number} (starting, pid {pid})"
        return f"a process of mpiexec (pid {pid})"

    def _run(self) -> None:
        look_s = min(max(self._timeout_s / 4, 0.25), 5.0)
        next_look = time.monotonic() + look_s
        while self._process.poll() is None:
            for key, _ in self._selector.select(_SELECT_S):
                self._take(key)
            now = time.monotonic()
            if now >= next_look:
                self._look(now)
                next_look = now + look_s
            if now >= self._deadline:
                end_all(self._tag)
                break
        for key, _ in self._selector.select(0):
            self._take(key)
        end_all(self._tag)
        for key in list(self._selector.get_map().values()):
            self._close(key.fileobj)

    def _close(self, link: Any) -> None:
        self._selector.unregister(link)
        link.close()

    def _take(self, key: selectors.SelectorKey) -> None:
        link: Any = key.fileobj
        if link is self._listener:
            with suppress(OSError):
                self._accept(link.accept()[0])
            return
        pid = key.data
        try:
            said = link.recv(64)
        except OSError:
            said = b""
        if said.endswith(_LEAVING):
            self._leaving.add(pid)
            said = said.removesuffix(_LEAVING)
        elif not said:
            self._close(link)
            if pid not in self._leaving:
                self._died(pid)
        if said.strip().isdigit():
            self._numbers[pid] = said.decode().strip()

    def _accept(self, link: socket.socket) -> None:
        pid, user, _ = struct.unpack("3i", link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        if user != os.getuid():
            link.close()
            return
        link.setblocking(False)
        self._selector.register(link, selectors.EVENT_READ, pid)

    def _died(self, pid: int) -> None:
        self._dead.append(pid)
        if self._survives(pid):
            self._say(f"{self.name(pid)} died; the others go on")
        else:
            self._deadline = min(self._deadline, time.monotonic() + MPIEXEC_ENDS_S)

    def _survives(self, pid: int) -> bool:
        return pid in self._ranks and 0 < self._survivable <= len(self._ranks)

    def _look(self, now: float) -> None:
        self._look_for_stopped()
        for pid, since in list(self._stopped_since.items()):
            if now - since < self._timeout_s:
                continue
            if self._survives(pid):
                os.kill(pid, signal.SIGKILL)
            else:
                self._end(f"{self.name(pid)} was stopped (SIGSTOP) for {self._timeout_s:g} s")
        silence_s = max(self._timeout_s, LEAST_SILENCE_S)
        for rank, heard in list(self._heard.items()):
            if now - heard > silence_s:
                self._end(f"rank {rank}, on another host, has not been heard of for {silence_s:g} s")

    def _look_for_stopped(self) -> None:
        stopped = {pid for pid, state in processes_of(self._tag) if state == "T"}
        now = time.monotonic()
        self._stopped_since = {pid: self._stopped_since.get(pid, now) for pid in stopped}
        self._stopped_since = dict(sorted(self._stopped_since.items(), key=lambda item: item[1]))

    def _end(self, why: str) -> None:
        self.verdict = self.verdict or why
        self._deadline = 0.0

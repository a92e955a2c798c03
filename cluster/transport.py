"""Messages between ranks: the only module that imports mpi4py.

Sends do not block; a receive polls and sleeps, because under MPICH a blocked receive spins and takes the core from the
ranks that work (measured: two working ranks of four on two cores lost half their speed). A payload above
``PIECE_BYTES`` goes in pieces: one MPI library fails on a single message above 2 GiB.
"""

from __future__ import annotations

import json
import os
import threading
import time
import warnings
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..shared.errors import DeviceError, MessageError, SplatpipeError
from ..shared.messages import HEADER, Kind, Message, encode, header, is_coded, parse_header
from .launch import check_starter

if TYPE_CHECKING:
    from .compression import Coding

PIECE_BYTES = 1 << 30
_ULFM = "OMPI_MCA_mpi_ft_enable"
"""Set by the ``mpiexec`` of Open MPI 5 that is called with ``--with-ft ulfm``."""
MAX_STATISTICS_BYTES = 64 << 20
_SPINS = 50
_SLEEP_S = (100e-6, 1e-3)
_SLEEP_SHARE = 1 / 8
"""A waiting rank sleeps this share of the time it has waited, within these bounds: short waits end promptly, and long
ones cost nearly nothing (at a constant 0.1 ms two waiting ranks took a tenth of a core from the third)."""


class Received(NamedTuple):
    """A message as it arrived: frame number and payload bytes."""

    frame: int
    payload: memoryview


class Transport:
    """Point-to-point messages over a private communicator of COMM_WORLD.

    depth : messages to one rank that may be under way before ``send`` waits (double-buffered: 2).
    timeout_s : longest wait in ``receive`` and ``send``; then SplatpipeError naming the rank waited for.
    patience_s : longest wait for ranks that may be loading: in collectives and patient receives.
    coding : codes what is sent (``compression``); None: nothing is. What arrives says itself whether it is coded.
    """

    coding: Coding | None = None

    def __init__(self, timeout_s: float = 300.0, depth: int = 2, piece_bytes: int = PIECE_BYTES) -> None:
        try:
            import mpi4py

            mpi4py.rc.initialize = False  # an MPI that cannot start here says much and ends the process
            mpi4py.rc.finalize = True
            from mpi4py import MPI
        except (ImportError, RuntimeError) as error:
            raise DeviceError(f"MPI: {str(error).splitlines()[0]}; install splatpipe[mpi]") from None
        self._mpi = MPI
        self.library = MPI.Get_library_version().splitlines()[0].strip("\0 ")
        if not MPI.Is_initialized():
            check_starter(self.library)
            with warnings.catch_warnings(action="ignore"):  # of another starter, which is checked once there is a world
                MPI.Init_thread(MPI.THREAD_MULTIPLE)
        self._comm: Any = MPI.COMM_WORLD.Dup()
        self.rank: int = self._comm.Get_rank()
        self.size: int = self._comm.Get_size()
        self._any_thread = MPI.Query_thread() >= MPI.THREAD_SERIALIZED
        self.timeout_s = timeout_s
        self.patience_s = 3600.0
        self._depth = depth
        self._piece_bytes = piece_bytes
        self._under_way: dict[int, deque[tuple[list[Any], Any]]] = defaultdict(deque)
        self._bytes: dict[str, int] = defaultdict(int)
        self._count: dict[str, int] = defaultdict(int)
        self._received: dict[str, int] = defaultdict(int)
        self._left_behind: list[Any] = []  # requests whose memory MPI may still touch

    @property
    def survives(self) -> bool:
        """Whether ranks can go on when one has died: MPI was started with ULFM, and mpi4py knows it."""
        return os.environ.get(_ULFM) == "1" and hasattr(self._comm, "Shrink")

    def lost_a_rank(self, error: BaseException) -> bool:
        """Whether an error says that a rank has died, or that another has noticed one, or may: of several requests
        MPI only says that one failed.
        """
        mpi = self._mpi
        classes = (mpi.ERR_PROC_FAILED, mpi.ERR_PROC_FAILED_PENDING, mpi.ERR_REVOKED, mpi.ERR_IN_STATUS)
        return isinstance(error, mpi.Exception) and error.Get_error_class() in classes

    def unanimous(self, done: bool) -> bool:
        """Whether all ranks are done and none has died; the same answer on all. Collective, also after a death.

        Who is not done makes every other rank's call fail (``lost_a_rank``), so that it comes here, too.
        """
        if not done and not self._comm.Is_revoked():
            self._comm.Revoke()
        try:
            flag = np.array([done], np.intc)
            self._poll([self._comm.Iagree(flag)])
            return bool(flag[0])
        except self._mpi.Exception:
            return False

    def go_on(self) -> list[int]:
        """Leave out the ranks that have died; the numbers that they had. The others are numbered anew. Collective."""
        if not self._comm.Is_revoked():
            self._comm.Revoke()
        shrunk = self._comm.Shrink()
        before, after = self._comm.Get_group(), shrunk.Get_group()
        gone = self._mpi.Group.Difference(before, after)
        numbers = gone.Translate_ranks(range(gone.Get_size()), before)
        self._left_behind.append((self._comm, dict(self._under_way)))
        self._under_way.clear()
        self._comm, self.rank, self.size = shrunk, shrunk.Get_rank(), shrunk.Get_size()
        return list(numbers)

    def send(self, dest: int, message: Message) -> None:
        """Start sending a message, whose arrays must not change any more. Waits while ``depth`` are under way."""
        head, payload = encode(message)
        if self.coding is not None:
            head, payload = self.coding.coded(dest, head, payload)
        self._post(dest, head, payload)

    def send_note(self, dest: int, kind: Kind, frame: int, note: dict[str, Any] | None = None) -> None:
        """Start sending a small note as JSON: frame finished, statistics at the end."""
        payload = memoryview(json.dumps(note).encode() if note is not None else b"")
        self._post(dest, header(kind, frame, len(payload)), payload)

    def receive(self, source: int, expected: Kind, max_bytes: int, *, patient: bool = False) -> Received:
        """The next message of kind ``expected`` from a rank; polite while it waits.

        patient : wait for it for up to ``patience_s``, as for a rank that is loading a scene.
        Raises MessageError for a foreign header, a payload above ``max_bytes`` (nothing is allocated for it) or a coded
        one that is damaged, SplatpipeError after ``timeout_s``.
        """
        head = bytearray(HEADER.size)
        request = self._comm.Irecv([head, self._mpi.BYTE], source, int(expected))
        self._wait([request], source, expected.name, self.patience_s if patient else self.timeout_s)
        kind, frame, length = parse_header(bytes(head))
        if kind is not expected:
            raise MessageError(f"from rank {source}: found {kind.name}, expected {expected.name}")
        if length > max_bytes:
            raise MessageError(f"{kind.name} from rank {source}: found {length} bytes, expected at most {max_bytes}")
        payload = np.empty(length, np.uint8)
        requests = [self._comm.Irecv([piece, self._mpi.BYTE], source, int(expected)) for piece in self._pieces(payload)]
        self._wait(requests, source, expected.name, self.timeout_s)
        self._received[kind.name] += len(head) + length
        if is_coded(head):
            from ..shared.message_codecs import unpack

            payload = unpack(kind, payload.data, max_bytes)
        return Received(frame, payload.data)

    def receive_note(self, source: int, expected: Kind) -> tuple[int, dict[str, Any]]:
        """(frame, note) of the next note of a kind. Raises MessageError if it is not a JSON object."""
        received = self.receive(source, expected, MAX_STATISTICS_BYTES)
        try:
            note = json.loads(bytes(received.payload) or b"{}")
        except ValueError:
            note = None
        if not isinstance(note, dict):
            raise MessageError(f"{expected.name} from rank {source}: expected a JSON object")
        return received.frame, note

    def has_note(self, source: int, kind: Kind) -> bool:
        """Whether a message of a kind waits to be received. Cost: one probe."""
        return bool(self._comm.Iprobe(source, int(kind)))

    def may_talk(self) -> bool:
        """Whether the thread that asks may send and receive: any, one at a time, where MPI allows it."""
        return self._any_thread or threading.current_thread() is threading.main_thread()

    def agree(self, status: int) -> list[int]:
        """The status, or another small number, of every rank. Collective."""
        statuses = np.empty(self.size, np.int32)
        self._poll([self._comm.Iallgather(np.array([status], np.int32), statuses)])
        return statuses.tolist()

    def join(self, values: np.ndarray | Sequence[float]) -> np.ndarray:
        """(sum of n,) float64: the (n,) values of every rank, end to end in the order of ranks. Collective."""
        counts = self.agree(len(values))
        joined = np.empty(sum(counts))
        self._poll([self._comm.Iallgatherv(np.ascontiguousarray(values, np.float64), [joined, counts])])
        return joined

    def total(self, counts: np.ndarray) -> np.ndarray:
        """Int64 sums over all ranks of an array that has the same shape on each. Collective."""
        sums = np.empty_like(counts)
        self._poll([self._comm.Iallreduce(np.ascontiguousarray(counts), sums)])
        return sums

    def gather(self, data: bytes) -> list[bytes]:
        """The bytes that each rank gives, below 2 GiB together. Collective."""
        lengths = self.agree(len(data))
        joined = bytearray(sum(lengths))
        self._poll([self._comm.Iallgatherv([data, self._mpi.BYTE], [joined, lengths, None, self._mpi.BYTE])])
        ends = np.cumsum(lengths).tolist()
        return [bytes(joined[end - n : end]) for end, n in zip(ends, lengths, strict=True)]

    def minimum_of(self, ranks: Sequence[int]) -> Callable[[np.ndarray], np.ndarray | None]:
        """What takes (n,) uint64 of each of these ranks to their minimum on the first of them, None elsewhere.

        Collective over ``ranks``, as is each call of what is returned; polite while it waits.
        """
        group = self._comm.Get_group()
        chosen = group.Incl(ranks)
        comm = self._comm.Create_group(chosen)
        chosen.Free()
        group.Free()

        def minimum(values: np.ndarray) -> np.ndarray | None:
            least = np.empty_like(values) if self.rank == ranks[0] else None
            request = comm.Ireduce(np.ascontiguousarray(values), least, self._mpi.MIN, 0)
            self._wait([request], ranks[0], "a minimum over ranks", self.timeout_s)
            return least

        return minimum

    def count_here(self, counted: bool) -> int:
        """How many of the ranks that share this rank's host are to be counted. Collective."""
        here = self._comm.Split_type(self._mpi.COMM_TYPE_SHARED)
        n = here.allreduce(int(counted))
        here.Free()
        return n

    def hosts(self) -> list[int]:
        """Of every rank, the lowest rank on its host. Collective."""
        here = self._comm.Split_type(self._mpi.COMM_TYPE_SHARED)
        lowest = np.array([self.rank], np.int32)
        here.Allreduce(self._mpi.IN_PLACE, lowest, self._mpi.MIN)
        here.Free()
        return self.agree(int(lowest[0]))

    def bounce(self, peer: int, payload: np.ndarray, *, serve: bool) -> None:
        """Send an (n,) uint8 payload to a rank and take it back, or the other way round, with MPI's own blocking calls.

        For measuring a link, not for work: no header, no limit, no politeness.
        """
        buffer = [payload, self._mpi.BYTE]
        if serve:
            self._comm.Send(buffer, peer)
        self._comm.Recv(buffer, peer)
        if not serve:
            self._comm.Send(buffer, peer)

    def idle(self, dest: int) -> bool:
        """Whether all that was sent to a rank has gone."""
        queue = self._under_way[dest]
        while queue and self._mpi.Request.Testall(queue[0][0]):
            queue.popleft()
        return not queue

    def traffic(self) -> dict[str, dict[str, int]]:
        """Messages and bytes (headers included) this rank has sent, by kind."""
        sent = dict(self._bytes)  # a copy, since others may ask while this rank sends
        return {kind: {"count": self._count[kind], "bytes": n} for kind, n in sent.items()}

    def received_bytes(self) -> dict[str, int]:
        """Bytes (headers included, coded as they came) this rank has received, by kind."""
        return dict(self._received)

    def start_counting(self) -> None:
        """Forget what ``traffic`` and ``received_bytes`` have counted so far."""
        self._bytes.clear()
        self._count.clear()
        self._received.clear()

    def meet(self, meanwhile: Callable[[], None] | None = None) -> None:
        """Wait until every rank is here, for up to ``patience_s``: loading a scene takes its time. Collective.

        meanwhile : called time and again while this rank waits, which then has no limit.
        """
        request = self._comm.Ibarrier()
        if meanwhile is None:
            self._poll([request])
            return
        while not request.Test():
            meanwhile()
            time.sleep(_SLEEP_S[1])

    def finish(self) -> None:
        """Wait until everything sent has gone and every rank is here. Collective."""
        for dest in list(self._under_way):
            self._drain(dest, 0)
        self.meet()

    def failed(self, error: BaseException) -> bool:
        """Whether an error is MPI's own, as when the rank at the other end has gone."""
        return isinstance(error, self._mpi.Exception)

    def abort(self, status: int) -> None:
        """End every rank of the run with an exit status."""
        self._comm.Abort(status)

    def _post(self, dest: int, head: bytes, payload: memoryview) -> None:
        kind = parse_header(head)[0]
        self._drain(dest, self._depth - 1)
        body = np.frombuffer(payload, np.uint8)
        tag = int(kind)
        requests = [self._comm.Isend([head, self._mpi.BYTE], dest, tag)]
        requests += [self._comm.Isend([piece, self._mpi.BYTE], dest, tag) for piece in self._pieces(body)]
        self._under_way[dest].append((requests, (head, payload)))
        self._bytes[kind.name] += len(head) + len(payload)
        self._count[kind.name] += 1

    def _pieces(self, body: np.ndarray) -> list[np.ndarray]:
        return [body[i : i + self._piece_bytes] for i in range(0, len(body), self._piece_bytes)]

    def _drain(self, dest: int, at_most: int) -> None:
        self.idle(dest)  # takes out what has gone
        queue = self._under_way[dest]
        while len(queue) > at_most:
            self._wait(queue[0][0], dest, "a message sent to it to be taken", self.timeout_s)
            queue.popleft()

    def _poll(self, requests: list[Any]) -> None:
        """Wait for a collective, for up to ``patience_s``: the other ranks may be loading."""
        self._wait(requests, None, "all to have loaded, or finished", self.patience_s)

    def _wait(self, requests: list[Any], peer: int | None, what: str, timeout_s: float) -> None:
        testall = self._mpi.Request.Testall
        try:
            for _ in range(_SPINS):
                if testall(requests):
                    return
            started = time.monotonic()
            while not testall(requests):
                waited_s = time.monotonic() - started
                if waited_s > timeout_s:
                    who = "the other ranks" if peer is None else f"rank {peer}"
                    raise SplatpipeError(f"waited {timeout_s:g} s for {who}: {what}")
                time.sleep(min(max(waited_s * _SLEEP_SHARE, _SLEEP_S[0]), _SLEEP_S[1]))
        except BaseException:
            self._left_behind.append(requests)
            raise

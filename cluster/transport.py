"""Messages between ranks: the only module that imports mpi4py.

Sends do not block; a receive polls and sleeps, because under MPICH a blocked receive spins and takes the core from the
ranks that work (measured: two working ranks of four on two cores lost half their speed). A payload above
``PIECE_BYTES`` goes in pieces: one MPI library fails on a single message above 2 GiB.
"""

from __future__ import annotations

import json
import math
import time
from collections import defaultdict, deque
from typing import Any, NamedTuple

import numpy as np

from ..shared.errors import DeviceError, MessageError, SplatpipeError
from ..shared.messages import HEADER, Kind, Message, encode, header, parse_header

PIECE_BYTES = 1 << 30
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
    """

    def __init__(self, timeout_s: float = 300.0, depth: int = 2, piece_bytes: int = PIECE_BYTES) -> None:
        try:
            from mpi4py import MPI
        except (ImportError, RuntimeError) as error:
            raise DeviceError(f"MPI: {str(error).splitlines()[0]}; install splatpipe[mpi]") from None
        self._mpi = MPI
        self._comm = MPI.COMM_WORLD.Dup()
        self.rank: int = self._comm.Get_rank()
        self.size: int = self._comm.Get_size()
        self.library = MPI.Get_library_version().splitlines()[0].strip("\0 ")
        self.timeout_s = timeout_s
        self._depth = depth
        self._piece_bytes = piece_bytes
        self._under_way: dict[int, deque[tuple[list[Any], Any]]] = defaultdict(deque)
        self._bytes: dict[str, int] = defaultdict(int)
        self._count: dict[str, int] = defaultdict(int)

    def send(self, dest: int, message: Message) -> None:
        """Start sending a message, whose arrays must not change any more. Waits while ``depth`` are under way."""
        self._post(dest, *encode(message))

    def send_note(self, dest: int, kind: Kind, frame: int, note: dict[str, Any] | None = None) -> None:
        """Start sending a small note as JSON: frame finished, statistics at the end."""
        payload = memoryview(json.dumps(note).encode() if note is not None else b"")
        self._post(dest, header(kind, frame, len(payload)), payload)

    def receive(self, source: int, expected: Kind, max_bytes: int, *, patient: bool = False) -> Received:
        """The next message of kind ``expected`` from a rank; polite while it waits.

        patient : wait for it however long it takes, as for a rank that is loading a scene.
        Raises MessageError for a foreign header or a payload above ``max_bytes`` (nothing is allocated for it),
        SplatpipeError after ``timeout_s``.
        """
        head = bytearray(HEADER.size)
        request = self._comm.Irecv([head, self._mpi.BYTE], source, int(expected))
        self._wait([request], source, expected.name, math.inf if patient else self.timeout_s)
        kind, frame, length = parse_header(bytes(head))
        if kind is not expected:
            raise MessageError(f"from rank {source}: found {kind.name}, expected {expected.name}")
        if length > max_bytes:
            raise MessageError(f"{kind.name} from rank {source}: found {length} bytes, expected at most {max_bytes}")
        payload = np.empty(length, np.uint8)
        requests = [self._comm.Irecv([piece, self._mpi.BYTE], source, int(expected)) for piece in self._pieces(payload)]
        self._wait(requests, source, expected.name, self.timeout_s)
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

    def agree(self, status: int) -> list[int]:
        """The status, or another small number, of every rank. Collective."""
        statuses = np.empty(self.size, np.int32)
        self._comm.Allgather(np.array([status], np.int32), statuses)
        return statuses.tolist()

    def join(self, values: np.ndarray) -> np.ndarray:
        """(sum of n,) float64: the (n,) values of every rank, end to end in the order of ranks. Collective."""
        counts = self.agree(len(values))
        joined = np.empty(sum(counts))
        self._comm.Allgatherv(np.ascontiguousarray(values, np.float64), [joined, counts])
        return joined

    def count_here(self, counted: bool) -> int:
        """How many of the ranks that share this rank's host are to be counted. Collective."""
        here = self._comm.Split_type(self._mpi.COMM_TYPE_SHARED)
        n = here.allreduce(int(counted))
        here.Free()
        return n

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

    def traffic(self) -> dict[str, dict[str, int]]:
        """Messages and bytes (headers included) this rank has sent, by kind."""
        return {kind: {"count": self._count[kind], "bytes": n} for kind, n in self._bytes.items()}

    def meet(self) -> None:
        """Wait, however long it takes, until every rank is here: loading a scene has no time limit. Collective."""
        request = self._comm.Ibarrier()
        while not request.Test():
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
        queue = self._under_way[dest]
        while queue and self._mpi.Request.Testall(queue[0][0]):
            queue.popleft()
        while len(queue) > at_most:
            self._wait(queue[0][0], dest, "a message sent to it to be taken", self.timeout_s)
            queue.popleft()

    def _wait(self, requests: list[Any], peer: int, what: str, timeout_s: float) -> None:
        testall = self._mpi.Request.Testall
        for _ in range(_SPINS):
            if testall(requests):
                return
        started = time.monotonic()
        while not testall(requests):
            waited_s = time.monotonic() - started
            if waited_s > timeout_s:
                raise SplatpipeError(f"waited {timeout_s:g} s for rank {peer}: {what}")
            time.sleep(min(max(waited_s * _SLEEP_SHARE, _SLEEP_S[0]), _SLEEP_S[1]))

"""Ranks as threads of this process, for frame loops without MPI: messages are bytes, encoded and decoded as between ranks."""

from __future__ import annotations

import json
import threading
from collections import defaultdict
from queue import Empty, Queue

import numpy as np
from splatpipe.cluster.transport import Received
from splatpipe.shared.errors import MessageError, SplatpipeError
from splatpipe.shared.messages import encode, header, parse_header

WAIT_S = 60.0


class World:
    """``size`` ranks. Messages from one to another of one kind keep their order, as MPI's do."""

    def __init__(self, size: int) -> None:
        self.size = size
        self.queues: dict[tuple[int, int, int], Queue[bytes]] = defaultdict(Queue)
        self.lock = threading.Lock()
        self.barrier = threading.Barrier(size, timeout=WAIT_S)
        self.joined: list[np.ndarray] = [np.empty(0)] * size
        self.sent: dict[str, int] = defaultdict(int)

    def queue(self, source: int, dest: int, kind: int) -> Queue[bytes]:
        with self.lock:
            return self.queues[source, dest, kind]

    def run(self, work) -> list:
        """``work(transport)`` on every rank; what each returns. Raises what the first rank that failed raised."""
        results, errors = [None] * self.size, []

        def one(rank: int) -> None:
            try:
                results[rank] = work(ThreadTransport(self, rank))
            except BaseException as error:
                errors.append(error)
                self.barrier.abort()

        threads = [threading.Thread(target=one, args=(rank,), daemon=True) for rank in range(self.size)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(2 * WAIT_S)
        if errors:
            raise errors[0]
        left = {key: queue.qsize() for key, queue in self.queues.items() if queue.qsize()}
        assert not left, f"messages that nobody took: {left}"
        return results


class ThreadTransport:
    """What a frame loop asks of ``cluster.transport.Transport``."""

    def __init__(self, world: World, rank: int) -> None:
        self._world, self.rank, self.size = world, rank, world.size

    def send(self, dest, message):
        head, payload = encode(message)
        self._post(dest, head, bytes(payload))

    def send_note(self, dest, kind, frame, note=None):
        payload = json.dumps(note).encode() if note is not None else b""
        self._post(dest, header(kind, frame, len(payload)), payload)

    def _post(self, dest, head, payload):
        kind = parse_header(head)[0]
        assert dest != self.rank, "a rank sends itself nothing"
        self._world.sent[kind.name] += 1
        self._world.queue(self.rank, dest, kind).put(head + payload)

    def receive(self, source, expected, max_bytes, *, patient=False):
        try:
            data = self._world.queue(source, self.rank, expected).get(timeout=WAIT_S)
        except Empty:
            raise SplatpipeError(f"waited for rank {source}: {expected.name}") from None
        kind, frame, length = parse_header(data)
        if length > max_bytes:
            raise MessageError(f"{kind.name} from rank {source}: found {length} bytes, expected at most {max_bytes}")
        return Received(frame, memoryview(data)[-length:] if length else memoryview(b""))

    def receive_note(self, source, expected):
        received = self.receive(source, expected, 1 << 26)
        return received.frame, json.loads(bytes(received.payload) or b"{}")

    def has_note(self, source, kind):
        return self._world.queue(source, self.rank, kind).qsize() > 0

    def join(self, values):
        self._world.joined[self.rank] = values
        self.meet()
        joined = np.concatenate(self._world.joined)
        self.meet()
        return joined

    def meet(self):
        self._world.barrier.wait()

    def finish(self):
        self.meet()

    def traffic(self):
        return {}

    def received_bytes(self):
        return {}

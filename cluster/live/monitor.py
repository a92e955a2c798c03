"""``splatpipe monitor``: where the time of a run goes, as it goes, beside what the model expects.

What is watched is a live run (a client of its hub), a recording of one, or a batch run's ``run.json``.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Generator, Iterator, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.live import Live

from ...shared.errors import InputError, MessageError, SplatpipeError
from .board import Board, text
from .connection import Connection, find_connection
from .replay import is_recording, replayed
from .screen import line, screen

REDRAW_S = 0.1
"""Shortest time between two drawings of the screen."""
PATIENCE_S = 30.0
"""Longest wait of ``--once`` for a run's first answer."""
SILENT_S, LOST_S = 3.0, 10.0
"""After so long without a word: a run's connection file is looked for; it is connected to anew."""
RECONNECT_TICKS = 10
"""Of ``REDRAW_S``, before a connection is made anew."""
SNAPSHOT_S = 1.5
"""Longest wait for a prediction that belongs to the first measured values."""
LONGEST_GAP_S = 5.0
"""Of a replay: a run that rested for an hour need not be watched for one."""

Header = dict[str, Any]
Messages = Generator[Header | None]


def monitor_command(
    target: Path | None, shows: Sequence[str] = (), *, once: bool = False, as_json: bool = False,
    speed: float | None = None, at: float = 0.0, console: Console | None = None,
) -> int:  # fmt: skip
    """Show a run until it ends, or the user ends it; the exit status.

    target : connection file, recording or ``run.json``; None: this user's newest live run.
    shows : metrics, or patterns of them, whose course is shown.
    once : print what holds now, of a record at the end or at ``at``, and end.  as_json : messages, a line each.
    speed : of a replay; None: as recorded on a terminal, at once elsewhere.  at : seconds of the run to begin with.
    Raises InputError for a file that is none of these, SplatpipeError where a run does not answer.
    """
    console = console or Console(highlight=False)
    on_terminal = console.is_terminal and not (once or as_json)
    board = Board(shows)
    source: LiveRun | Replay
    if target is not None and is_recording(target):
        source = Replay(target, speed or (1.0 if on_terminal else None), at, once=once)
    else:
        source = LiveRun(target, PATIENCE_S if once else math.inf)
    with suppress(KeyboardInterrupt), closing(source.messages()) as messages:  # which is how one leaves
        if as_json:
            _print_json(messages, board, once=once and isinstance(source, LiveRun))
        elif once:
            _take_snapshot(messages, board, live=isinstance(source, LiveRun))
            _print_screen(console, board, source.state)
        elif on_terminal:
            _show(source, messages, board, console)
        else:
            _print_lines(messages, board, console)
    return 0


# --- where messages come from ----------------------------------------------------------------------------------------


class LiveRun:
    """The messages of a live run, None now and then where none comes; ends with the run.

    patience_s : for the first answer; a run answers once it has loaded its scene.
    state : what to say of the connection.
    Connects anew while the run's process and connection file are there.
    """

    def __init__(self, path: Path | None, patience_s: float = math.inf) -> None:
        self._path, self._patience_s = path, patience_s
        self._connection = find_connection(path)
        self._answered = False
        self._why = "the run has ended"
        self.state = "waiting for the run"

    def messages(self) -> Generator[Header | None]:
        """To be closed."""
        connection: Connection | None = self._connection
        while connection is not None:
            yield from self._until_lost(connection)
            if not self._answered:
                raise SplatpipeError(f"{connection.address}: {self._why}")
            self.state = "reconnecting"
            for _ in range(RECONNECT_TICKS):
                time.sleep(REDRAW_S)
                yield None
            connection = self._again(connection)
        yield {"kind": "bye", "why": self._why}

    def _until_lost(self, connection: Connection) -> Iterator[Header | None]:
        """What comes over one connection. It is lost when the hub says bye, has gone, or is silent for too long."""
        from .sockets import Client

        with Client(connection, metrics=True, name="monitor") as client:
            began = heard = looked = time.monotonic()
            welcomed = False
            while True:
                header, now = self._next(client), time.monotonic()
                if header is None:
                    yield None
                    if welcomed and now - heard > LOST_S:
                        return
                    if not welcomed and now - began > self._patience_s:
                        self._why = f"no answer in {self._patience_s:g} s"
                        return
                    if now - max(heard, looked) > SILENT_S:
                        looked = now
                        if self._again(connection) is None:
                            return
                    continue
                heard = now
                if header["kind"] == "bye":
                    self._why = text(str(header.get("why") or self._why))
                    return
                if header["kind"] == "welcome":
                    welcomed = self._answered = True
                    self.state = "live"
                yield header

    @staticmethod
    def _next(client: Any) -> Header | None:
        try:
            message = client.receive(REDRAW_S)
        except MessageError:
            return None
        return message.header if message is not None else None

    def _again(self, before: Connection) -> Connection | None:
        """The connection of the same run, or of one that has taken over its file; None where it is gone."""
        try:
            found = find_connection(self._path)
        except InputError:
            return None
        same = self._path is not None or found.address == before.address
        return found if same and found.lives else None


class Replay:
    """The messages of a recorded run at the times at which they came, None now and then in between.

    speed : how many times as fast; None: at once.  at : seconds of the run before which all comes at once.
    once : whether only what there is up to ``at``, if it is given, is wanted.
    """

    def __init__(self, path: Path, speed: float | None, at: float, *, once: bool) -> None:
        self._path, self._speed, self._at, self._once = path, speed, at, once
        self.state = "replayed" if speed in (None, 1.0) else f"replayed ×{speed:g}"

    def messages(self) -> Generator[Header | None]:
        """To be closed."""
        shown, due = max(self._at, 0.0), time.monotonic()
        for header in replayed(self._path):
            if header["kind"] == "metrics" and "t" in header:
                t = float(header["t"])
                if self._once and self._at and t > self._at:
                    return
                if self._speed and t > shown:
                    due = max(due, time.monotonic() - REDRAW_S) + min(t - shown, LONGEST_GAP_S) / self._speed
                    while (left := due - time.monotonic()) > 0:
                        time.sleep(min(left, REDRAW_S))
                        yield None
                shown = max(shown, t)
            yield header
        if not self._once:
            yield {"kind": "bye", "why": "end of the recording"}


# --- how they are shown ----------------------------------------------------------------------------------------------


def _hear(board: Board, header: Header) -> bool:
    """Whether there is something new to show. What a live run says wrongly is left out."""
    try:
        return board.hear(header)
    except MessageError:
        return False


def _show(source: LiveRun | Replay, messages: Messages, board: Board, console: Console) -> None:
    """The screen of a terminal, until the run ends; its last state stays on the terminal."""
    drawn_s = 0.0
    with Live(console=console, screen=True, auto_refresh=False) as live:
        for header in messages:
            if header is not None:
                _hear(board, header)
            if time.monotonic() - drawn_s >= REDRAW_S:
                live.update(screen(board, console.width, source.state), refresh=True)
                drawn_s = time.monotonic()
            if board.ended:
                break
    _print_screen(console, board, source.state)


def _take_snapshot(messages: Messages, board: Board, *, live: bool) -> None:
    """Listen until there are measured values, and for a moment for what was predicted of them."""
    until = None
    for header in messages:
        if header is not None:
            _hear(board, header)
        if live and board.heard:
            until = until or time.monotonic() + SNAPSHOT_S
            if time.monotonic() > until or any(of.predicted for of in board.in_order()):
                return


def _print_screen(console: Console, board: Board, state: str) -> None:
    console.print(screen(board, console.width, state))


def _print_lines(messages: Messages, board: Board, console: Console) -> None:
    for header in messages:
        if header is None or not _hear(board, header):
            continue
        if header["kind"] == "metrics":
            console.print(line(board), markup=False, soft_wrap=True)
        elif board.ended:
            console.print(board.ended, markup=False, soft_wrap=True)
            return


def _print_json(messages: Messages, board: Board, *, once: bool) -> None:
    for header in messages:
        if header is not None and header["kind"] in ("welcome", "metrics", "prediction", "bye"):
            print(json.dumps(header), flush=True)
            _hear(board, header)
            if board.ended or (once and board.heard):
                return

"""Progress bars: on a terminal only, on standard error, so that what is piped stays clean."""

from __future__ import annotations

import sys
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


class FrameProgress:
    """One bar whose text says what is going on; a context manager. Silent where standard error is no terminal."""

    def __init__(self, total: int | None, on_terminal: bool = True) -> None:
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=not (on_terminal and sys.stderr.isatty()),
            transient=True,
        )
        self._task = self._progress.add_task("starting", total=total)

    def show(self, doing: str, done: int, total: int | None = None) -> None:
        """What is going on, how much is done and, where it changes, of how much."""
        self._progress.update(self._task, description=doing, completed=done, total=total)

    def __enter__(self) -> FrameProgress:
        self._progress.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._progress.stop()

"""A board as people see it in a terminal: tables for any width, and plain lines where there is no terminal."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.measure import Measurement
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from .board import Board, RankState

OFF = 0.3
"""Share by which measured and predicted may differ before it is shown in colour."""
OFF_MS = 0.5
"""What is off by less is no news: a rank that wakes up takes as long."""
WIDE = 110
"""Columns from which on hosts, and all values of a rank, have room."""
MOST_ROWS = 64
"""Ranks that are shown; the others are counted."""

_SPARKS = "▁▂▃▄▅▆▇█"
_EIGHTHS = " ▏▎▍▌▋▊▉█"
_UNITS = ((1e12, "T"), (1e9, "G"), (1e6, "M"), (1e3, "k"))


def screen(board: Board, width: int, state: str = "") -> RenderableType:
    """The whole screen, ``width`` columns wide. state : how the messages come: live, replayed, reconnecting."""
    parts: list[RenderableType] = [_head(board, width, state), _figures(board, width), ""]
    ranks = board.in_order()
    if any(of.stages for of in ranks):
        parts += [_stage_table(ranks, width), ""]
    if any(of.values for of in ranks):
        parts.append(_rank_table(ranks, width))
    elif not board.ended:
        parts.append(Text("nothing has been measured yet", style="dim"))
    if len(ranks) > MOST_ROWS:
        parts.append(Text(f"and {len(ranks) - MOST_ROWS} more ranks", style="dim"))
    if board.watched:
        parts += ["", _courses(board, width)]
    return Group(*(Padding(part, (0, 1)) for part in parts))


def line(board: Board) -> str:
    """What matters most, in one line without colours."""
    said = [f"{board.t:9.1f} s"]
    rate = board.frames_per_s
    if rate is not None:
        said.append(f"{rate:.1f} frames/s{_expected_rate(board)}")
    for of in board.in_order()[:MOST_ROWS]:
        for stage in of.stages:
            measured, expected = of.values[f"{stage}.work_ms"], of.predicted.get(f"{stage}.work_ms")
            ratio = f" (×{measured / expected:.2f} of predicted)" if expected else ""
            said.append(f"{of.rank} {stage} {amount('work_ms', measured)}{ratio}")
    said += [f"{name} {value}" for name, value in _summary(board)]
    said += [f"{of_rank} {name} {amount(name, values[-1])}" for (name, of_rank), values in sorted(board.series.items())]
    return ", ".join(said)


def amount(name: str, value: float) -> str:
    """A value as people read it, with the unit that the end of its name says."""
    if name.endswith("_ms"):
        return f"{_digits(value)} ms"
    if name.endswith("bytes_per_s"):
        return f"{_scaled(value)}B/s"
    if name.endswith("_bytes"):
        return f"{_scaled(value)}B"
    if name in ("missing", "cache_hits"):
        return f"{100 * value:.1f} %"
    if name.endswith("_per_s"):
        return f"{_digits(value)}/s"
    return _scaled(value).strip()


def sparkline(values: Sequence[float], width: int) -> str:
    """The latest ``width`` values as bars, from the least to the most of them; a flat one is low."""
    latest = list(values)[-width:] if width > 0 else []
    if not latest:
        return ""
    least, most = min(latest), max(latest)
    extent = most - least
    if not extent or not math.isfinite(extent):
        return _SPARKS[0] * len(latest)
    return "".join(_SPARKS[round((value - least) / extent * (len(_SPARKS) - 1))] for value in latest)


class Bar:
    """Work as blocks, then waiting as a line; as wide as there is room, which ``most`` fills."""

    def __init__(self, work: float, wait: float, most: float, style: str) -> None:
        self.work, self.wait, self.most, self.style = work, wait, most, style

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """As of rich."""
        width, out = options.max_width, Text(no_wrap=True)
        if self.most > 0:
            eighths = round(8 * width * min(max(self.work / self.most, 0), 1))
            out.append("█" * (eighths // 8) + _EIGHTHS[eighths % 8].strip(), style=self.style)
            end = round(width * min(max((self.work + self.wait) / self.most, 0), 1))
            out.append("─" * (end - out.cell_len), style="bright_black")
        out.truncate(width)
        yield out

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        """As of rich."""
        return Measurement(min(6, options.max_width), options.max_width)


class Course:
    """Values over time; the latest that there is room for."""

    def __init__(self, values: Sequence[float]) -> None:
        self.values = values

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """As of rich."""
        yield Text(sparkline(self.values, options.max_width), style="cyan", no_wrap=True)

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        """As of rich."""
        return Measurement(min(10, options.max_width), options.max_width)


# --- parts of the screen ---------------------------------------------------------------------------------------------


def _head(board: Board, width: int, state: str) -> RenderableType:
    run = board.run
    said = [str(run[name]) for name in ("scene", "topology", "rasterizer") if run.get(name)]
    title = Text.assemble(("splatpipe", "bold"), *((" · " + part, "") for part in said))
    style = "bold red" if board.ended else "green" if state == "live" else "yellow"
    right = Text.assemble((_time(board.t), "bold"), "  ", (board.ended or state, style))
    room = width - 2
    right.truncate(max(room // 2, 16), overflow="ellipsis")
    title.truncate(max(room - right.cell_len - 2, 8), overflow="ellipsis")
    return Text.assemble(title, " " * max(room - title.cell_len - right.cell_len, 1), right, no_wrap=True)


def _figures(board: Board, width: int) -> RenderableType:
    """Frame rate with its course, and what else holds for the whole run."""
    out = Text()
    rate = board.frames_per_s
    if rate is not None:
        out.append(f"{rate:.1f}" if rate else "at rest", style="bold")
        out.append(f" frames/s{_expected_rate(board)} " if rate else " ")
        out.append(sparkline(board.rate, min(24, width // 4)), style="cyan")
    for name, value in _summary(board):
        out.append("   " if out else "")
        out.append(f"{name} ", style="dim")
        out.append(value.replace(" ", "\N{NO-BREAK SPACE}"))
    return out


def _stage_table(ranks: Sequence[RankState], width: int) -> Table:
    """Work and waiting of each stage of each rank, beside what was predicted."""
    wide = width >= WIDE
    table = _table()
    table.add_column("rank", justify="right")
    table.add_column("role", max_width=24 if wide else 12, no_wrap=True, overflow="ellipsis")
    table.add_column("stage", max_width=16 if wide else 11, no_wrap=True, overflow="ellipsis")
    for name in ("work", "wait", "predicted", "ratio"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("work and wait", ratio=1)
    rows = [(of, stage) for of in ranks[:MOST_ROWS] for stage in of.stages]
    most = max(of.values[f"{s}.work_ms"] + of.values.get(f"{s}.wait_ms", 0.0) for of, s in rows)
    before = None
    for of, stage in rows:
        work, wait = of.values[f"{stage}.work_ms"], of.values.get(f"{stage}.wait_ms", 0.0)
        predicted = of.predicted.get(f"{stage}.work_ms")
        first = of is not before
        table.add_row(
            str(of.rank) if first else "",
            Text(of.role if first else ""),
            Text(stage),
            amount("_ms", work),
            Text(amount("_ms", wait), style="dim"),
            amount("_ms", predicted) if predicted is not None else "–",
            _ratio(work, predicted),
            Bar(work, wait, most, _style(work, predicted, OFF_MS) or "cyan"),
        )
        before = of
    return table


_COLUMNS = (
    ("frames_per_s", "frames/s", False),
    ("queue", "queue", True),
    ("cpu", "cores", False),
    ("memory_bytes", "memory", False),
    ("sent_bytes_per_s", "sent", False),
    ("received_bytes_per_s", "received", False),
    ("points", "points", False),
    ("entries", "entries", True),
    ("cells", "cells", True),
    ("pixels", "pixels", True),
    ("threads", "threads", True),
    ("cache_hits", "hits", True),
    ("missing", "missing", True),
    ("loaded_bytes_per_s", "read", True),
)
"""Metric, what its column is called, and whether it takes a wide terminal."""


def _rank_table(ranks: Sequence[RankState], width: int) -> Table:
    """What each rank does and holds. Columns that no rank has a value for are left out."""
    wide = width >= WIDE
    shown = ranks[:MOST_ROWS]
    columns = [(n, title) for n, title, only in _COLUMNS if (wide or not only) and any(n in of.values for of in shown)]
    table = _table()
    table.add_column("rank", justify="right", no_wrap=True)
    table.add_column("host" if wide else "role", ratio=1, min_width=6, no_wrap=True, overflow="ellipsis")
    for _, title in columns:
        table.add_column(title, justify="right", no_wrap=True)
    for of in shown:
        values = [_cell(name, of) for name, _ in columns]
        table.add_row(str(of.rank), Text(of.host if wide else of.role), *values)
    return table


def _courses(board: Board, width: int) -> RenderableType:
    """The watched parameters over time."""
    table = _table()
    table.add_column("rank", justify="right")
    table.add_column("parameter", max_width=max(width // 4, 18), no_wrap=True, overflow="ellipsis")
    for name in ("now", "least", "most"):
        table.add_column(name, justify="right", no_wrap=True)
    table.add_column("over time", ratio=1)
    for (name, rank), values in sorted(board.series.items()):
        ends = [amount(name, value) for value in (values[-1], min(values), max(values))]
        who = "hub" if rank < 0 else str(rank)
        table.add_row(who, Text(name), *ends, Course(values))
    if not board.series:
        return Text(f"no metric is called {', '.join(board.watched)} so far", style="dim")
    return table


def _table() -> Table:
    return Table(box=None, expand=True, pad_edge=False, padding=(0, 2, 0, 0), header_style="dim", border_style="dim")


def _summary(board: Board) -> list[tuple[str, str]]:
    """What holds for the whole run, as far as it is known."""
    found: list[tuple[str, float | None, str]] = [
        ("queue", board.of_first("queue"), "queue"),
        ("points", board.total("points"), "points"),
        ("memory", board.total("memory_bytes"), "memory_bytes"),
        ("sent", board.total("sent_bytes_per_s"), "sent_bytes_per_s"),
        ("hits", board.of_first("cache_hits"), "cache_hits"),
        ("missing", board.of_first("missing"), "missing"),
        ("viewers", board.hub.get("viewers"), "viewers"),
        ("pictures", board.hub.get("pictures_per_s"), "pictures_per_s"),
        ("to viewers", board.hub.get("sent_bytes_per_s"), "sent_bytes_per_s"),
        ("latency", board.hub.get("latency_ms"), "latency_ms"),
    ]
    return [(title, amount(name, value)) for title, value, name in found if value is not None]


def _expected_rate(board: Board) -> str:
    expected = board.of_first("frames_per_s", "predicted")
    return f" of {expected:.1f} predicted" if expected is not None else ""


def _ratio(measured: float, predicted: float | None) -> Text:
    if not predicted or predicted <= 0:
        return Text("–", style="dim")
    return Text(f"{min(measured / predicted, 999.99):.2f}", style=_style(measured, predicted, OFF_MS))


def _style(measured: float, predicted: float | None, least: float = 0.0) -> str:
    """Colour of a value that is further off than ``OFF``, and than ``least``."""
    if not predicted or predicted <= 0 or abs(measured - predicted) <= least:
        return ""
    if measured > predicted * (1 + OFF):
        return "bold red"
    return "yellow" if measured < predicted * (1 - OFF) else ""


def _cell(name: str, of: RankState) -> Text:
    """A value of a rank, in colour where bytes are other than predicted; a rate that could be reached is no such."""
    value = of.values.get(name)
    if value is None:
        return Text()
    said = f"{value:.1f}" if name == "frames_per_s" else f"{value:.2f}" if name == "cpu" else amount(name, value)
    return Text(said, style=_style(value, of.predicted.get(name)) if "bytes" in name else "")


def _digits(value: float) -> str:
    """Three significant digits, or whole."""
    size = abs(value)
    if size >= 1e6:
        return _scaled(value).strip()
    return f"{value:,.0f}" if size >= 99.95 else f"{value:.1f}" if size >= 9.995 else f"{value:.2f}"


def _scaled(value: float) -> str:
    """With a prefix of thousands and a space: ``1.23 M``; ``12 `` without."""
    unit, prefix = next(((unit, prefix) for unit, prefix in _UNITS if abs(value) >= 0.9995 * unit), (1.0, ""))
    if abs(value) >= 1e18:
        return f"{value:.2g} "
    return f"{value:.0f} " if unit == 1 and value == int(value) else f"{_digits(value / unit)} {prefix}"


def _time(seconds: float) -> str:
    if not 0 <= seconds < 1e9:
        return "–"
    minutes, rest = divmod(seconds, 60)
    if minutes < 1:
        return f"{rest:.1f} s"
    hours, minutes = divmod(int(minutes), 60)
    return f"{hours}:{minutes:02d}:{int(rest):02d}" if hours else f"{minutes}:{int(rest):02d}"

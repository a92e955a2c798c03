"""Reports: one self-contained HTML file and a Markdown twin, readable without the program.

A report is a list of parts in order: text, tables, plots. Both files say the same; the HTML file holds its plots
within itself, the Markdown file has them beside it. Both end with the machine, the versions and what was run.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..shared.files import write_whole
from .record import machine_record


@dataclass(frozen=True)
class Text:
    """A paragraph, or a heading where ``level`` is 2 or 3."""

    text: str
    level: int = 0


@dataclass(frozen=True)
class Table:
    """A table; cells are shown as they are if they are text, numbers with four significant digits."""

    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""

    @property
    def texts(self) -> list[list[str]]:
        """The rows as people read them."""
        return [[as_text(cell) for cell in row] for row in self.rows]


@dataclass(frozen=True)
class Plot:
    """A picture: PNG bytes and what it shows."""

    png: bytes
    caption: str

    @property
    def data_uri(self) -> str:
        """The picture as a link that holds it."""
        return "data:image/png;base64," + base64.b64encode(self.png).decode()


@dataclass
class Report:
    """Title and parts; ``write`` makes the two files.

    command : what was run, as a person would type it.
    """

    title: str
    command: str
    parts: list[Text | Table | Plot] = field(default_factory=list)

    def heading(self, text: str, level: int = 2) -> None:
        """Start a section (level 2) or a subsection (level 3)."""
        self.parts.append(Text(text, level))

    def text(self, text: str) -> None:
        """Add a paragraph."""
        self.parts.append(Text(text))

    def table(self, columns: Sequence[str], rows: Sequence[Sequence[Any]], caption: str = "") -> None:
        """Add a table."""
        self.parts.append(Table(columns, rows, caption))

    def plot(self, figure: Any, caption: str) -> None:
        """Add a matplotlib figure."""
        data = io.BytesIO()
        figure.savefig(data, format="png", dpi=120, bbox_inches="tight")
        self.parts.append(Plot(data.getvalue(), caption))

    def write(self, stem: Path) -> list[Path]:
        """Write ``STEM.html`` and ``STEM.md`` (with ``STEM-1.png`` …), each whole or not at all; the two paths.

        Raises InputError when they cannot be written.
        """
        import jinja2

        environment = jinja2.Environment(
            loader=jinja2.FileSystemLoader(Path(__file__).parent / "templates"),
            autoescape=jinja2.select_autoescape(["html"]),
            trim_blocks=True,
            lstrip_blocks=True,
            undefined=jinja2.StrictUndefined,
        )
        stem.parent.mkdir(parents=True, exist_ok=True)
        parts = [(type(part).__name__, part) for part in self.parts]
        pictures = {}
        for part in self.parts:
            if isinstance(part, Plot):
                path = stem.with_name(f"{stem.name}-{len(pictures) + 1}.png")
                write_whole(path, lambda out, png=part.png: out.write_bytes(png))
                pictures[part] = path.name
        written = []
        for suffix in ("html", "md"):
            text = environment.get_template(f"report.{suffix}").render(
                report=self, parts=parts, pictures=pictures, machine=machine_record()
            )
            path = stem.with_name(f"{stem.name}.{suffix}")
            write_whole(path, lambda out, text=text: out.write_text(text, encoding="utf-8"))
            written.append(path)
        return written


def as_text(cell: Any) -> str:
    """A cell as people read it: whole numbers with separators, others with four significant digits, None as a dash."""
    if cell is None:
        return "–"
    if isinstance(cell, bool | str):
        return str(cell)
    if isinstance(cell, int):
        return f"{cell:,}"
    return f"{cell:.4g}"

"""Settings as the text of a TOML file: what ``tomllib`` reads gives them back, every number to its last bit."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from typing import Any

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def toml_value(value: Any) -> str:
    """A value as TOML: text, numbers, booleans, and lists and tables of them, in one line."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(key)} = {toml_value(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml_value, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_document(tables: Mapping[str, Any]) -> str:
    """Tables, and lists of tables, by name. A list of tables within one of them has a line for each."""
    parts = []
    for name, content in tables.items():
        for table in content if isinstance(content, list) else [content]:
            head = f"[[{_key(name)}]]" if isinstance(content, list) else f"[{_key(name)}]"
            parts.append("\n".join([head, *(f"{_key(key)} = {_lines(value)}" for key, value in table.items())]))
    return "\n\n".join(parts) + "\n"


def _lines(value: Any) -> str:
    if isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
        return "[\n" + "".join(f"    {toml_value(item)},\n" for item in value) + "]"
    return toml_value(value)


def _key(name: str) -> str:
    return name if _BARE_KEY.fullmatch(name) else toml_value(name)

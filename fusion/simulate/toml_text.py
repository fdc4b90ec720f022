"""Write nested dictionaries as TOML text."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


def to_toml(table: Mapping[str, Any], path: str = "") -> str:
    """Return TOML text: plain keys first, then sub-tables, then arrays of tables (lists of dictionaries)."""
    lines = [f"{key} = {_value(value)}" for key, value in table.items() if not _is_table(value)]
    for key, value in table.items():
        name = f"{path}.{key}" if path else key
        if isinstance(value, Mapping):
            header = "" if all(isinstance(v, Mapping) for v in value.values()) else f"\n[{name}]\n"
            lines.append(header + to_toml(value, name).rstrip("\n"))
        elif _is_table(value):
            lines += [f"\n[[{name}]]\n" + to_toml(item, name).rstrip("\n") for item in value]
    return "\n".join(lines) + "\n"


def _is_table(value: Any) -> bool:
    """Say whether a value needs a header of its own."""
    return isinstance(value, Mapping) or (isinstance(value, list) and bool(value) and isinstance(value[0], Mapping))


def _value(value: Any) -> str:
    """Return a plain value in TOML's syntax."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return repr(value)

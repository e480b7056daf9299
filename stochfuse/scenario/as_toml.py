"""A scenario's mapping as the text of a file, which reads back as the same mapping.

Tables are opened up one below the other as far as [table.table]; what lies deeper is written in one line.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any


def to_toml(mapping: Mapping[str, Any]) -> str:
    """Return a scenario's mapping as TOML; what is None is left out."""
    plain = [key for key in mapping if not _is_table(mapping[key])]
    lines = [f"{_key(key)} = {_value(mapping[key])}" for key in plain if mapping[key] is not None]
    for key, value in mapping.items():
        if isinstance(value, Mapping):
            lines += _table(_key(key), value)
        elif key not in plain:
            for each in value:
                lines += [
                    "",
                    f"[[{_key(key)}]]",
                    *(f"{_key(k)} = {_value(v)}" for k, v in each.items() if v is not None),
                ]
    return "\n".join(lines).lstrip("\n") + "\n"


def _table(name: str, table: Mapping[str, Any]) -> list[str]:
    inner = [key for key, value in table.items() if isinstance(value, Mapping)]
    own = {key: value for key, value in table.items() if key not in inner and value is not None}
    lines = ["", f"[{name}]", *(f"{_key(key)} = {_value(value)}" for key, value in own.items())]
    for key in inner:
        lines += (
            _table(f"{name}.{_key(key)}", table[key])
            if name.count(".") < 1
            else [f"{_key(key)} = {_value(table[key])}"]
        )
    return lines


def _is_table(value: Any) -> bool:
    return isinstance(value, Mapping) or (
        isinstance(value, list) and bool(value) and all(isinstance(each, Mapping) for each in value)
    )


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _value(key)


def _value(value: Any) -> str:
    """A value in one line."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items() if v is not None) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(value)

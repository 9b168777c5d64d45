"""Settings as the text of a TOML file, from which they are read back without loss."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from anatomy.base.settings import to_mapping


def settings_toml(values: object) -> str:
    """Return settings as TOML, from which `anatomy.base.settings.parse` restores them without loss.

    What is None is left out, as TOML has no such value; it must be the default of its field.
    """
    return "\n".join(_lines(to_mapping(values), ())).strip() + "\n"


def _lines(mapping: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    """Return the plain values of a mapping, then its tables."""
    lines, tables = [], []
    for key, value in mapping.items():
        if value is None:
            continue
        name = ".".join((*path, key))
        if isinstance(value, Mapping):
            tables += ["", f"[{name}]", *_lines(value, (*path, key))]
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            for each in value:
                tables += ["", f"[[{name}]]", *_lines(each, (*path, key))]
        else:
            lines.append(f"{key} = {_text(value)}")
    return lines + tables


def _text(value: Any) -> str:
    """Return a value as TOML writes it: JSON's strings and numbers are TOML's, too."""
    if isinstance(value, list):
        return f"[{', '.join(_text(each) for each in value)}]"
    return json.dumps(value, ensure_ascii=True, allow_nan=False).replace("\x7f", "\\u007f")

"""The devices that a search may try, by points of the unit cube with one coordinate a number."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from anatomy.base.settings import override, to_mapping
from lungaccess.problem.system import System
from lungaccess.running.design.settings import Number

DIGITS = 4
"""Significant digits of a number in a range: a maker keeps no more, and equal devices are tried once."""


def near(system: System, numbers: Sequence[Number], even: Sequence[float], radius: float) -> list[float]:
    """Return the point of the cube at most `radius` beside a system's, by a point of the whole cube.

    What is one of several values changes for a share `radius` of the cube alone.
    """
    point = []
    for number, x in zip(numbers, even, strict=True):
        value = value_at(system, number.key)
        if number.range is None:
            known = number.one_of.index(value) if value in number.one_of else 0
            point.append(x / radius if x < radius else (known + 0.5) / len(number.one_of))
        else:
            low, high = number.range
            at = (value - low) / (high - low) if isinstance(value, int | float) else 0.5
            at = min(max(at, 0.0), 1.0) + radius * (2.0 * x - 1.0)
            point.append(1.0 - abs(1.0 - abs(at)))
    return point


def device(base: System, numbers: Sequence[Number], point: Sequence[float]) -> System:
    """Return the system at a point of the cube, named by what it changes, which its sources call assumed.

    Raises
    ------
    SettingsError
        If the validator of devices refuses it.
    """
    changes: dict[str, Any] = {}
    for number, x in zip(numbers, point, strict=True):
        if number.range is None:
            value = number.one_of[min(int(x * len(number.one_of)), len(number.one_of) - 1)]
        else:
            low, high = number.range
            value = min(max(float(f"{low + x * (high - low):.{DIGITS}g}"), low), high)
        changes |= dict.fromkeys(number.keys, value)
    changed = override(base, changes, "the device")
    found = [
        f"{key} = {json.dumps(value)}: assumption, found by `lungaccess design`; `{base.name}` has "
        f"{json.dumps(value_at(base, key))}"
        for key, value in changes.items()
    ]
    names = {key.rpartition(".")[2] for key in changes}
    kept = [f"`{base.name}`: {line}" if any(n in line for n in names) else line for line in base.sources]
    return replace(
        changed,
        name=f"{base.name}-{hashlib.sha256(json.dumps(changes, sort_keys=True).encode()).hexdigest()[:8]}",
        description=f"`{base.name}` with other numbers, found by a search over devices.",
        sources=(*found, *kept),
    )


def value_at(system: System, path: str) -> Any:
    """Return what the file of a system has at a dotted path; None for nothing."""
    values: Any = to_mapping(system)
    for part in path.split("."):
        if isinstance(values, list):
            values = values[int(part)] if part.isdigit() and int(part) < len(values) else None
        else:
            values = values.get(part) if isinstance(values, Mapping) else None
    return values

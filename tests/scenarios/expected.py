"""The stored expectations: targets, queries, and what was found for them; written by `record`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from anatomy.base.files import atomic_write

FILE = Path(__file__).with_name("expected.json")


def load() -> dict[str, Any]:
    """Return the expectations: targets, queries, plans, needles and shared, each by name."""
    empty: dict[str, Any] = {"targets": {}, "queries": {}, "plans": {}, "needles": {}, "shared": {}}
    return json.loads(FILE.read_text(encoding="ascii")) if FILE.exists() else empty


def save(content: dict[str, Any]) -> None:
    """Write the expectations, one entry a line."""
    parts = []
    for kind, entries in content.items():
        lines = ",\n  ".join(f"{json.dumps(name)}: {json.dumps(entries[name])}" for name in sorted(entries))
        parts.append(f' "{kind}": {{\n  {lines}\n }}')
    with atomic_write(FILE) as temporary:
        temporary.write_text("{\n" + ",\n".join(parts) + "\n}\n", encoding="ascii")

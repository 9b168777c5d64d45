"""Write the tables of the reference that are made from the code: `python -m docs.write_tables`.

They are made when the pages are built, so that no page can state another key, range or size than the program.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lungaccess.plans.file import schema_of
from lungaccess.problem.error_files import error_preset_names, load_errors
from lungaccess.problem.errors import UNITS, BreathingError, ErrorModel
from lungaccess.problem.system import System
from stages.scope import WallContact

FOLDER = Path(__file__).resolve().parent / "reference" / "tables"
"""Git ignores the folder, because its files follow from the code."""
DEVICE_TABLES = {
    "System": "the whole file",
    "Bronchoscope": "`[scope]`, the bronchoscope",
    "ConcentricTubes": "`[tubes]`, limits of the deployment",
    "Tube": "`[tubes.outer]`, `[tubes.middle]` and `[tubes.inner]`",
    "BentPiece": "an entry of `bent_pieces`",
    "SlottedSegment": "an entry of `slotted_segments`",
    "Needle": "`[needle]`",
    "Tool": "`[tool]`, what is done at the target",
    "Margins": "`[margins]`",
}
"""The tables of a device file, by the settings that hold their keys."""
NOT_STATED = {"needle_shaft"}
"""Keys that a file does not hold, because they follow from others."""


def device_keys() -> str:
    """Return a table of every key of a device file for each of its parts, as Markdown."""
    schema = schema_of(System)
    parts = {"System": schema, **schema["$defs"]}
    captions = {name: f"**{each[0].upper()}{each[1:]}**" for name, each in DEVICE_TABLES.items()}
    return "\n".join(f"{caption}\n\n{key_table(parts[name])}" for name, caption in captions.items())


def key_table(part: Mapping[str, Any]) -> str:
    """Return a table of the keys of a part of a file, from its JSON Schema, as Markdown."""
    lines = ["| key | meaning | allowed | default |", "|---|---|---|---|"]
    required = part.get("required", ())
    for key, of in part["properties"].items():
        if key not in NOT_STATED:
            default = "required" if key in required else _default(of.get("default"))
            lines.append(f"| `{key}` | {of.get('description', '')} | {_allowed(of)} | {default} |")
    return "\n".join(lines) + "\n"


def _default(value: object) -> str:
    if value is None or isinstance(value, Mapping) or value in ([], ""):
        return ""
    return str(value).lower() if isinstance(value, bool) else f"{value}"


def _allowed(of: Mapping[str, Any]) -> str:
    """Return the range or the choices of a key in words."""
    if "enum" in of:
        return ", ".join(f"`{each}`" for each in of["enum"])
    for each in of.get("anyOf", ()):
        if "$ref" in each or "maximum" in each:
            return _allowed(each)
    if "$ref" in of:
        return "a table, below"
    least = f"at least {of['minimum']:g}" if "minimum" in of else ""
    above = f"above {of['exclusiveMinimum']:g}" if "exclusiveMinimum" in of else ""
    most = f"at most {of['maximum']:g}" if "maximum" in of else ""
    below = f"below {of['exclusiveMaximum']:g}" if "exclusiveMaximum" in of else ""
    return ", ".join(each for each in (least, above, most, below) if each)


def entries_of(model: ErrorModel) -> list[tuple[str, str, str, str, str]]:
    """Return kind, distribution, size by patient and by attempt, and source of each error of a model."""
    found = []
    for kind, unit in UNITS.items():
        term = model.term(kind)
        if isinstance(term, BreathingError):
            patient = f"{term.median_mm:g} mm, ln {term.patient_ln:g}" if term.size else "0"
            attempt = "phase" if term.size else "0"
        else:
            patient, attempt = (f"{size:g} {unit}" if size else "0" for size in (term.patient, term.attempt))
        found.append((f"`{kind}`", term.distribution, patient, attempt, term.source))
    return found


def error_presets() -> str:
    """Return one table of all error presets, each entry once with the presets that have it, as Markdown."""
    names = error_preset_names()
    presets: dict[tuple[str, str, str, str, str], list[str]] = {}
    for name in names:
        for entry in entries_of(load_errors(name)):
            presets.setdefault(entry, []).append(f"`{name}`")
    kinds = [f"`{kind}`" for kind in UNITS]
    lines = [
        "| error | presets | distribution | by patient | by attempt | source |",
        "|---|---|---|---|---|---|",
    ]
    for shown in sorted(presets, key=lambda each: kinds.index(each[0])):
        held = "all" if len(presets[shown]) == len(names) else ", ".join(presets[shown])
        lines.append(f"| {' | '.join((shown[0], held, *shown[1:]))} |")
    return "\n".join(lines) + "\n"


def write_tables() -> None:
    """Write the tables where the pages include them."""
    FOLDER.mkdir(exist_ok=True)
    wall = key_table(schema_of(WallContact))
    for name, text in (
        ("device_keys", device_keys()),
        ("error_presets", error_presets()),
        ("wall_keys", wall),
    ):
        (FOLDER / f"{name}.txt").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    write_tables()

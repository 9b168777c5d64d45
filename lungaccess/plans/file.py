"""Plans as JSON: nothing lost, nothing unknown accepted, protected by a digest."""

import json
import math
import os
import re
import types
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from anatomy.base.checksums import canonical_sha256
from anatomy.base.errors import PlanFileError, SettingsError
from anatomy.base.files import DAMAGE, reason, write_text
from anatomy.base.records import LEFT_OUT_IF_EMPTY
from anatomy.base.settings import parse, to_mapping
from lungaccess.plans.record import Record
from lungaccess.problem.system import System

SCHEMA = "lungaccess-plan-3"
"""Name and version of the file format; a reader takes SHAPELESS, too, and refuses any other."""
SHAPELESS = "lungaccess-plan-2"
"""The format whose plans state no shape of tubes that bend in one plane, which follows from their insertions,
and one share of strain for the whole shaft of the needle."""
LINES = "lungaccess-plan-1"
"""The format whose plans state a line for the scope."""

WRITTEN = "a plan.json as `lungaccess plan` writes it"
ARRAY_TYPES = (np.ndarray, NDArray)
"""What `anatomy.base.typed` is made of: numpy resolves its name of arrays before 2.5, and keeps it since."""

P = TypeVar("P", bound=Record)


def digest(plan: Record) -> str:
    """Return the SHA-256 (hex) of the canonical JSON of `plan` without `timing`."""
    return _digest(_encode(plan, "plan"))


def _digest(content: Mapping[str, Any]) -> str:
    return canonical_sha256({key: value for key, value in content.items() if key not in ("timing", "digest")})


def to_json(plan: Record) -> str:
    """Return the plan as JSON text, one list of numbers a line, ending with its digest."""
    content = _encode(plan, "plan")
    content["digest"] = _digest(content)
    text = json.dumps(content, indent=1, ensure_ascii=True, allow_nan=False)
    return re.sub(r"\[[^][{}]*\]", lambda match: re.sub(r"\n\s*", "", match.group()), text) + "\n"


def from_json(cls: type[P], text: str) -> P:
    """Return the plan that `to_json` wrote; see `Plan.from_json`."""
    try:
        content = json.loads(text, object_pairs_hook=_unique, parse_constant=_not_finite)
    except DAMAGE as error:
        raise PlanFileError(f"The plan is not JSON ({reason(error)})", expected=WRITTEN) from error
    if not isinstance(content, dict):
        raise PlanFileError("The plan is not a JSON object", expected=WRITTEN)
    schema = content.get("schema")
    if schema not in (SCHEMA, SHAPELESS):
        why = ", in which the scope has a line but no motion: it does not say how the scope gets there"
        raise PlanFileError(
            f"The plan has the schema {schema!r}{why if schema == LINES else ''}", expected=SCHEMA
        )
    stated = content.pop("digest", None)
    try:
        plan = _decode(cls, _in_schema(content), "plan")
        found = digest(plan) if content["schema"] == SCHEMA else _digest(content)
    except DAMAGE as error:
        found = f"The plan holds values that no plan has ({reason(error)})"
        raise PlanFileError(found, expected=WRITTEN) from error
    if stated != found:
        raise PlanFileError(
            "The plan does not match its own digest: it was edited or damaged", expected=str(stated)
        )
    return typing.cast(P, plan)


def _in_schema(content: dict[str, Any]) -> dict[str, Any]:
    """Return a plan of either format as one of SCHEMA; plans of SHAPELESS were made with this closed form."""
    tube, needle = content["tube"], content["system"].get("needle")
    if content["schema"] == SCHEMA:
        return content
    if needle is not None and "strain_factor" in needle:
        needle = {**needle}
        factor = needle.pop("strain_factor")
        if factor != 1.0:
            segment = {"length_mm": 2000.0, "stiffness_factor": 1.0, "strain_factor": factor}
            needle["slotted_segments"] = [segment]
        content = {**content, "system": {**content["system"], "needle": needle}}
    if "shape" in tube:
        return {**content, "schema": SCHEMA}
    tubes = _system(content["system"], "plan.system").tubes
    outer, inner = float(tube["outer_insertion_mm"]), float(tube["inner_insertion_mm"])
    straight = max(inner - tubes.inner.curved_length_mm, 0.0)
    ends = [min(straight, outer), outer, max(straight, outer), inner]
    curvatures = [0.0, tubes.overlap_curvature_per_mm, 0.0, tubes.free_curvature_per_mm]
    radii = [tubes.outermost.radius_mm] * 2 + [tubes.inner.radius_mm] * 2
    lengths = np.diff(ends, prepend=0.0).tolist()
    shape = {
        "relative_rotations_rad": {name: 0.0 for name, _tube in tubes.named},
        "arcs": [
            [arc[0], 0.0, *arc[1:]] for arc in zip(lengths, curvatures, radii, strict=True) if arc[0] > 0
        ],
        "arc_error_mm": 0.0,
        "least_determinant": 1.0,
    }
    return {**content, "schema": SCHEMA, "tube": {**tube, "shape": shape}}


def plain(part: Record) -> Any:
    """Return a part of a plan as plain JSON types."""
    return _encode(part, "part")


def save(plan: Record, path: str | os.PathLike[str]) -> None:
    """Write `plan` beside `path` under a temporary name, then put it in place."""
    write_text(os.fspath(path), to_json(plan))


def load(cls: type[P], path: str | os.PathLike[str]) -> P:
    """Read a plan; see `Plan.load`."""
    try:
        text = Path(path).read_bytes().decode("utf-8")
    except OSError as error:
        raise PlanFileError(
            f"The plan {os.fspath(path)} cannot be read ({error.strerror})",
            expected="a plan.json file",
            remedy="Check the name; `lungaccess plan` writes plan.json into its folder",
        ) from error
    except UnicodeDecodeError as error:
        raise PlanFileError(f"The plan {os.fspath(path)} is not text", expected=WRITTEN) from error
    return from_json(cls, text)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise PlanFileError("The plan states a value twice", expected="each value once")
    return content


def _not_finite(constant: str) -> float:
    raise PlanFileError(f"The plan holds the number {constant}", expected="finite numbers")


def _encode(value: Any, where: str) -> Any:
    """Return plain JSON types; floats are written by `repr`, so that none changes."""
    if isinstance(value, System):
        return to_mapping(value)
    if is_dataclass(value):
        return {
            item.name: _encode(_as_declared(item.type, getattr(value, item.name)), f"{where}.{item.name}")
            for item in fields(value)
            if not item.metadata.get(LEFT_OUT_IF_EMPTY) or getattr(value, item.name)
        }
    if isinstance(value, Mapping):
        return {str(key): _encode(inner, f"{where}.{key}") for key, inner in value.items()}
    if isinstance(value, np.ndarray):
        return _encode(value.tolist(), where)
    if isinstance(value, tuple | list):
        return [_encode(inner, f"{where}[{n}]") for n, inner in enumerate(value)]
    if isinstance(value, float | np.floating) and not math.isfinite(value):
        raise PlanFileError(f"{where} is {value}", expected="a finite number")
    return value.item() if isinstance(value, np.generic) else value


def _as_declared(annotation: object, value: Any) -> Any:
    """Write an integer given for a float as a float, so that a stored plan is stored the same again."""
    if annotation in (float, "float"):
        return float(value)
    if annotation in (Mapping[str, float], "Mapping[str, float]"):
        return {key: float(inner) for key, inner in value.items()}
    if annotation in (Mapping[str, Mapping[str, float]], "Mapping[str, Mapping[str, float]]"):
        return {key: {k: float(v) for k, v in inner.items()} for key, inner in value.items()}
    return value


def _decode(wanted: Any, value: Any, where: str) -> Any:
    """Build `wanted` (a type annotation) from plain JSON types, or raise."""
    if wanted is System:
        return _system(value, where)
    if is_dataclass(wanted):
        return _record(typing.cast(type, wanted), value, where)
    origin, arguments = typing.get_origin(wanted), typing.get_args(wanted)
    if origin in ARRAY_TYPES:
        return _numbers(value, where)
    if origin is tuple:
        return tuple(_decode(arguments[0], v, f"{where}[{n}]") for n, v in enumerate(_is(list, value, where)))
    if origin is Mapping or isinstance(origin, type) and issubclass(origin, Mapping):
        return {k: _decode(arguments[1], v, f"{where}.{k}") for k, v in _is(dict, value, where).items()}
    if origin in (typing.Union, types.UnionType):
        return None if value is None else _decode(arguments[0], value, where)
    return _is(wanted, value, where)


def _record(cls: type, value: Any, where: str) -> Any:
    content = _is(dict, value, where)
    hints = typing.get_type_hints(cls)
    names = {item.name for item in fields(cls)}
    optional = {item.name for item in fields(cls) if item.metadata.get(LEFT_OUT_IF_EMPTY)}
    lacks, unknown = names - optional - content.keys(), content.keys() - names
    for problem, keys in (("lacks", lacks), ("has the unknown key", unknown)):
        if keys:
            raise PlanFileError(
                f"{where} {problem} {', '.join(sorted(keys))}",
                expected="the keys that `lungaccess plan` writes",
            )
    present = names & content.keys()
    return cls(**{name: _decode(hints[name], content[name], f"{where}.{name}") for name in present})


def _system(value: Any, where: str) -> System:
    try:
        return parse(System, _is(dict, value, where), where)
    except SettingsError as error:
        raise PlanFileError(
            f"The plan's system is not valid: {error}", expected="a system that can be built"
        ) from error


def _numbers(value: Any, where: str) -> Any:
    """Return nested lists of finite numbers unchanged."""
    if isinstance(value, list):
        return [_numbers(inner, f"{where}[{n}]") for n, inner in enumerate(value)]
    return _is(int, value, where) if isinstance(value, int) else _is(float, value, where)


def _is(wanted: type, value: Any, where: str) -> Any:
    fits = isinstance(value, wanted) and (wanted is bool or not isinstance(value, bool))
    if not fits or isinstance(value, float) and not math.isfinite(value):
        raise PlanFileError(f"{where} is {value!r:.60}", expected=f"a value of type {wanted.__name__}")
    return value


DIALECT = "https://json-schema.org/draft/2020-12/schema"
_PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean"}


def schema_of(kind: type) -> dict[str, Any]:
    """Return the JSON Schema of a class of settings, whose keys are those of a TOML file, or of plans.

    It says which keys there are, their types and ranges; what several keys say together is judged when the
    file is read.
    """
    parts: dict[str, Any] = {}
    made = _schema(kind, parts)
    return {"$schema": DIALECT, "title": kind.__name__, **made, **({"$defs": parts} if parts else {})}


def _schema(kind: Any, parts: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of a type; schemas that others point at are added to `parts`."""
    if is_dataclass(kind):
        return _of_class(typing.cast(type, kind), parts)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in ARRAY_TYPES:
        return {"type": "array"}
    if origin is tuple:
        return {"type": "array", "items": _schema(arguments[0], parts)}
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return {"type": "object", "additionalProperties": _schema(arguments[1], parts)}
    if origin in (typing.Union, types.UnionType):
        return {"anyOf": [_schema(arguments[0], parts), {"type": "null"}]}
    return {"type": _PLAIN[kind]}


def _of_class(kind: type, parts: dict[str, Any]) -> dict[str, Any]:
    if not issubclass(kind, Record):
        found = TypeAdapter(kind).json_schema()
        parts |= found.pop("$defs", {})
        return found
    hints, keys = typing.get_type_hints(kind), fields(typing.cast(Any, kind))
    return {
        "type": "object",
        "properties": {
            each.name: _array(each.metadata["shape"])
            if "shape" in each.metadata
            else _schema(hints[each.name], parts)
            for each in keys
        },
        "required": [each.name for each in keys if not each.metadata.get(LEFT_OUT_IF_EMPTY)],
        "additionalProperties": False,
    }


def _array(shape: tuple[int | None, ...]) -> dict[str, Any]:
    """Return the schema of an array of numbers, row in row; None stands for any length."""
    if not shape:
        return {"type": "number"}
    length = {} if shape[0] is None else {"minItems": shape[0], "maxItems": shape[0]}
    return {"type": "array", "items": _array(shape[1:]), **length}

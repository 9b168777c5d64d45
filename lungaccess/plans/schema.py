"""JSON Schemas of the files that users write and plans that are stored, for other programs."""

import types
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from pydantic import TypeAdapter

from anatomy.base.records import LEFT_OUT_IF_EMPTY
from lungaccess.plans.file import ARRAY_TYPES
from lungaccess.plans.record import Record

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

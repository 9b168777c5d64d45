"""Frozen classes of keyword-only fields: what functions return, and what they are given as one thing."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from types import UnionType
from typing import Any, TypeVar, dataclass_transform, get_args, get_origin, get_type_hints

import numpy as np

T = TypeVar("T")
LEFT_OUT_IF_EMPTY = "left out if empty"
"""Metadata of a field that a file lacks where it is empty, as do files from before the field was there."""


@dataclass_transform(frozen_default=True, kw_only_default=True, eq_default=False)
def frozen_record(cls: type[T]) -> type[T]:
    """Make a class of annotated fields a frozen dataclass that may hold arrays; it equals itself alone."""
    return dataclass(frozen=True, kw_only=True, eq=False)(cls)


@dataclass_transform(frozen_default=True, kw_only_default=True)
def frozen_value(cls: type[T]) -> type[T]:
    """Make a class of annotated fields a frozen dataclass of plain values, compared by its fields."""
    return dataclass(frozen=True, kw_only=True)(cls)


def plain_values(value: Any, name: str, arrays: dict[str, Any]) -> Any:
    """Return a record as values that can be written as JSON; an array is its key in `arrays`.

    Args:
        name: Begins the keys of the arrays, which are those of the fields joined by points, such as
            `tree.points_lps`; it may be empty.
        arrays: The arrays of the record are added to it.
    """
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return name
    if is_dataclass(value):
        value = {each.name: getattr(value, each.name) for each in fields(value) if each.init}
    elif isinstance(value, tuple | list):
        return [plain_values(each, f"{name}.{n}", arrays) for n, each in enumerate(value)]
    if isinstance(value, Mapping):
        return {key: plain_values(each, f"{name}.{key}".lstrip("."), arrays) for key, each in value.items()}
    return value


def record_from(kind: Any, value: Any, arrays: Mapping[str, Any]) -> Any:
    """Return the record that `plain_values` made plain; `kind` is its class, or the type of a field."""
    if get_origin(kind) is UnionType and value is not None:
        kind = next(each for each in get_args(kind) if each is not type(None))
    if is_dataclass(kind):
        cls: Any = kind
        hints = get_type_hints(cls)
        return cls(**{name: record_from(hints[name], each, arrays) for name, each in value.items()})
    if get_origin(kind) is np.ndarray:
        return arrays[value]
    if isinstance(value, list):
        kinds = get_args(kind)
        kinds = kinds[:1] * len(value) if kinds[1:] == (...,) else kinds
        return tuple(record_from(each, one, arrays) for each, one in zip(kinds, value, strict=True))
    if isinstance(value, dict):
        return {key: record_from(get_args(kind)[1], each, arrays) for key, each in value.items()}
    return value

"""Frozen classes of keyword-only fields: what functions return, and what they are given as one thing."""

from dataclasses import dataclass
from typing import TypeVar, dataclass_transform

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

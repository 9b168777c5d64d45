"""Records: immutable values of a plan, whose arrays have the declared shape and whose mappings are sorted."""

from collections.abc import Mapping
from dataclasses import fields
from types import MappingProxyType
from typing import Any, get_type_hints

import numpy as np
from pydantic import GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

from anatomy.base.errors import PlanFileError
from anatomy.base.records import LEFT_OUT_IF_EMPTY
from anatomy.base.typed import Array
from anatomy.grid import read_only


def picked(of: object, names: str) -> dict[str, Any]:
    """Return some fields of a record, whose names stand between spaces, as JSON takes them."""
    return {name: getattr(of, name) for name in names.split()}


def shaped(*shape: int | None, dtype: type = np.float64) -> dict[str, Any]:
    """Return the metadata that make a field of a `Record` an array; None stands for any length."""
    return {"shape": shape, "dtype": dtype}


class Record:
    """Makes arrays read-only float64 (or int64) of the declared shape, and mappings read-only and sorted.

    Pydantic reads one from JSON: all its keys but those left out if empty, no others, and finite numbers.
    """

    @classmethod
    def __get_pydantic_core_schema__(cls, _source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        hints = get_type_hints(cls)
        keys = {
            each.name: core_schema.typed_dict_field(
                _numbers(*each.metadata["shape"])
                if "shape" in each.metadata
                else handler.generate_schema(hints[each.name]),
                required=not each.metadata.get(LEFT_OUT_IF_EMPTY),
            )
            for each in fields(cls)  # type: ignore[arg-type]
        }
        return core_schema.no_info_after_validator_function(
            lambda stated: cls(**stated),
            core_schema.typed_dict_schema(
                keys, strict=True, extra_behavior="forbid", config=core_schema.CoreConfig(allow_inf_nan=False)
            ),
        )

    def __post_init__(self) -> None:
        for item in fields(self):  # type: ignore[arg-type]
            value = getattr(self, item.name)
            if "shape" in item.metadata:
                value = _frozen_array(value, item.metadata["shape"], item.metadata["dtype"], item.name)
            elif isinstance(value, Mapping):
                value = _frozen_mapping(value)
            else:
                continue
            object.__setattr__(self, item.name, value)


def _numbers(*shape: int | None) -> CoreSchema:
    """Return the schema of an array of numbers, row in row; its records judge whether they are whole."""
    if not shape:
        return core_schema.float_schema(strict=True, allow_inf_nan=False)
    return core_schema.list_schema(
        _numbers(*shape[1:]), strict=True, min_length=shape[0], max_length=shape[0]
    )


def _frozen_array(value: Any, shape: tuple[int | None, ...], dtype: type, name: str) -> Array:
    try:
        array: Array = np.array(value, dtype=dtype)
    except (TypeError, ValueError) as error:
        raise PlanFileError(
            f"{name} of a plan is not an array of numbers ({error})", expected="an array of numbers"
        ) from error
    if array.ndim == 1 and array.size == 0:
        array = array.reshape(tuple(n or 0 for n in shape))
    wanted = tuple(n if m is None else m for n, m in zip(array.shape, shape, strict=False))
    if array.ndim != len(shape) or array.shape != wanted:
        raise PlanFileError(
            f"{name} of a plan has the shape {array.shape}",
            expected="(" + ", ".join("N" if n is None else str(n) for n in shape) + ")",
        )
    return read_only(array)


def _frozen_mapping(value: Mapping[str, Any]) -> Mapping[str, Any]:
    return MappingProxyType(
        {key: _frozen_mapping(v) if isinstance(v, Mapping) else v for key, v in sorted(value.items())}
    )

"""Kinds of arguments of kernels as plain JSON values, and back."""

from functools import reduce
from importlib import import_module
from typing import Any

from numba import types


def encoded(kind: Any) -> Any:
    """Return one of numba's types as plain values.

    Raises
    ------
    TypeError
        If it is a type that no kernel is called with from Python.
    """
    match kind:
        case types.Array():
            return ["array", encoded(kind.dtype), kind.ndim, kind.layout, kind.mutable]
        case types.NamedTuple() | types.NamedUniTuple():
            record = f"{kind.instance_class.__module__}:{kind.instance_class.__qualname__}"
            return ["named", record, [encoded(each) for each in kind.types]]
        case types.Tuple() | types.UniTuple():
            return ["tuple", [encoded(each) for each in kind.types]]
        case types.Literal():
            return ["literal", kind.literal_value]
        case types.Omitted():
            return ["omitted", kind.value]
        case types.Optional():
            return ["optional", encoded(kind.type)]
        case types.Number() | types.Boolean() | types.NoneType():
            return str(kind)
    raise TypeError(f"Arguments of the kind {kind} cannot be written down")


def decoded(plain: Any) -> Any:
    """Return the type that `encoded` returned as these values.

    Raises
    ------
    ImportError, AttributeError, LookupError, TypeError, ValueError
        If there is none.
    """
    if isinstance(plain, str):
        return {"none": types.none, "bool": types.boolean}.get(plain) or getattr(types, plain)
    word, *rest = plain
    if word == "array":
        dtype, dimensions, layout, mutable = rest
        return types.Array(decoded(dtype), dimensions, layout, readonly=not mutable)
    if word == "named":
        module, _, name = rest[0].partition(":")
        record = reduce(getattr, name.split("."), import_module(module))
        return types.BaseTuple.from_types([decoded(each) for each in rest[1]], record)
    if word == "tuple":
        return types.BaseTuple.from_types([decoded(each) for each in rest[0]])
    if word == "optional":
        return types.Optional(decoded(rest[0]))
    made: Any = {"literal": types.literal, "omitted": types.Omitted}[word]
    return made(rest[0])

"""Validated settings: one frozen class serves the TOML file, the command line and the stored record."""

import dataclasses
import difflib
import functools
import json
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar, cast, dataclass_transform

import annotated_types
from pydantic import AfterValidator, ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass as pydantic_dataclass
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails, PydanticCustomError

from anatomy.base.errors import SettingsError
from anatomy.base.records import LEFT_OUT_IF_EMPTY

T = TypeVar("T")
_CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False)
MOST, LEAST = 10**15, 1e-15
"""Ends of every number that states no others, and its least size if it is not 0: no quantity of a device or a
patient lies beyond, in whatever unit, and what does is no number to divide or to count by."""
MOST_SHOWN = 200
"""Letters of a value that a message shows: a list can have a million."""
_REMEDY = "Correct what is named; keys that are left out take their defaults"


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(Field,))
def settings(cls: type[T]) -> type[T]:
    """Make a class of annotated fields an immutable settings class that cannot hold a wrong value.

    The class is a frozen, keyword-only dataclass. Whatever creates an instance (the constructor,
    `dataclasses.replace`, `parse`) checks it, and every fault becomes a `SettingsError`.  Its fields are
    annotated with `quantity` or `text`, and its `__post_init__`, if any, raises what `impossible` returns
    when two fields contradict each other.
    """
    made = pydantic_dataclass(frozen=True, kw_only=True, config=_CONFIG)(cls)
    validated_init = made.__init__

    @functools.wraps(validated_init)
    def checked_init(self: Any, *args: Any, **values: Any) -> None:
        try:
            validated_init(self, *args, **values)
        except ValidationError as error:
            raise _settings_error(made, error, made.__name__) from None

    setattr(made, "__init__", checked_init)  # noqa: B010 -- mypy forbids the plain assignment
    return cast(type[T], made)


End = float | None
"""End of a range, exclusive (`above`, `below`) or inclusive; None where the range is open."""


def quantity(
    description: str, *, above: End = None, at_least: End = None, below: End = None, at_most: End = None
) -> Any:
    """Annotate a finite number with its meaning and the range outside which it is absurd.

    The ends of the range are those of `MOST` where none is given.  For use in `Annotated[float,
    quantity(...)]`: an integer is accepted, text and booleans are not.
    """
    at_least = -MOST if above is None and at_least is None else at_least
    at_most = MOST if below is None and at_most is None else at_most
    made = Field(
        description=description, strict=True, allow_inf_nan=False, gt=above, ge=at_least, lt=below, le=at_most
    )
    made.metadata.append(AfterValidator(_require_not_tiny))
    return made


def _require_not_tiny(value: float | None) -> float | None:
    if value is not None and 0.0 < abs(value) < LEAST:
        raise PydanticCustomError("tiny", "0, or a size of at least {least}", {"least": LEAST})
    return value


def text(description: str, *, may_be_empty: bool = False) -> Any:
    """Annotate a text with its meaning, for use in `Annotated[str, text(...)]`."""
    return Field(description=description, strict=True, min_length=0 if may_be_empty else 1)


def switch(description: str) -> Any:
    """Annotate a truth value with its meaning, for use in `Annotated[bool, switch(...)]`."""
    return Field(description=description, strict=True)


def impossible(key: str, value: object, allowed: str) -> PydanticCustomError:
    """Return the error to raise from `__post_init__` when fields contradict each other.

    `key` is the dotted path of the field from the class that raises, and `allowed` says what it may hold,
    with the numbers that follow from the other fields.  It becomes a `SettingsError` with the whole path.
    """
    return PydanticCustomError(
        "impossible", "{key} = {value}: {allowed}", {"key": key, "value": _shown(value), "allowed": allowed}
    )


def parse(cls: type[T], mapping: Mapping[str, object], where: str, remedy: str = _REMEDY) -> T:
    """Build settings, of a class made by `settings`, from plain values, as read from TOML or JSON.

    `where` says where the values come from, such as a file name, and `remedy` what the user can do about a
    wrong one.  Raises SettingsError for a missing or unknown key, a wrong type, a number that is not finite
    or outside its range, or values that contradict each other. The message names the key path, the value and
    what is allowed.
    """
    try:
        return TypeAdapter(cls).validate_python(mapping)
    except ValidationError as error:
        raise _settings_error(cls, error, where, remedy) from None


def to_mapping(values: object) -> dict[str, Any]:
    """Return settings as plain JSON types, from which `parse` restores them without loss.

    Fields with LEFT_OUT_IF_EMPTY in their metadata are left out where they are empty, and those that no
    constructor takes always.
    """
    held = {
        field: getattr(values, field.name) for field in dataclasses.fields(cast(Any, values)) if field.init
    }
    return {
        field.name: _plain(value)
        for field, value in held.items()
        if value or not field.metadata.get(LEFT_OUT_IF_EMPTY)
    }


def override(values: T, changes: Mapping[str, object], where: str = "overrides") -> T:
    """Return settings with some values replaced, all checked together; errors as `parse`.

    The new values stand by dotted key path, e.g. ``{"needle.diameter_mm": 0.8}``, entries of arrays by their
    number from 0.  `where` says for the message where they come from.
    """
    mapping = to_mapping(values)
    for path, value in changes.items():
        *parents, key = path.split(".")
        inner: Any = mapping
        for parent in parents:
            if isinstance(inner, list):
                inner = inner[int(parent)] if parent.isdigit() and int(parent) < len(inner) else None
            else:
                inner = inner.setdefault(parent, {}) if isinstance(inner, dict) else None
        if not isinstance(inner, dict):
            raise SettingsError(
                f"{where}: {path} is not a setting", remedy=_REMEDY, expected="a key of the file"
            )
        inner[key] = value
    return parse(type(values), mapping, where)


def _plain(value: object) -> object:
    if dataclasses.is_dataclass(value):
        return to_mapping(value)
    if isinstance(value, tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float):
        return value + 0.0  # -0.0 and 0.0 are equal settings, so they must be written alike
    return value


def _settings_error(cls: type, error: ValidationError, where: str, remedy: str = _REMEDY) -> SettingsError:
    faults = [_explain(cls, detail) for detail in error.errors(include_url=False)]
    return SettingsError(
        f"{where}: " + "; ".join(found for found, _ in faults),
        expected="; ".join(dict.fromkeys(allowed for _, allowed in faults)),
        remedy=remedy,
    )


def _explain(cls: type, detail: ErrorDetails) -> tuple[str, str]:
    """Return what was found and what is allowed for one fault."""
    kind, path = detail["type"], ".".join(str(part) for part in detail["loc"])
    if kind == "impossible":
        context = detail["ctx"]
        path = ".".join(filter(None, (path, context["key"])))
        return f"{path} = {context['value']}", f"{path}: {context['allowed']}"
    if kind == "unexpected_keyword_argument":
        return f"{path} is not a setting", _known_keys(cls, detail["loc"])
    stated = "" if kind == "tiny" else _allowed(cls, detail["loc"])
    allowed = f"{path}: {stated or detail['msg']}"
    return (f"{path} is missing" if kind == "missing" else f"{path} = {_shown(detail['input'])}"), allowed


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}..."


def _known_keys(cls: type, loc: Sequence[int | str]) -> str:
    owner, unknown = _class_at(cls, loc[:-1]), str(loc[-1])
    names = [name for name, field in _fields(owner).items() if field.init is not False]
    close = difflib.get_close_matches(unknown, names, n=1)
    hint = f" (did you mean {close[0]}?)" if close else ""
    return f"one of {', '.join(names)}{hint}"


def _allowed(cls: type, loc: Sequence[int | str]) -> str:
    """Describe what the field at `loc` may hold, from its annotation."""
    keys = [part for part in loc if isinstance(part, str)]
    field = _fields(_class_at(cls, keys[:-1])).get(keys[-1]) if keys else None
    if field is None:
        return ""
    said: Sequence[object] = field.metadata
    kind, meaning = _without_none(field.annotation), field.description
    items = typing.get_args(kind)
    if isinstance(loc[-1], int) and items and kind not in _NOUNS:
        # Of an item of a list its own bounds are what was not kept.
        item = FieldInfo.from_annotation(items[0])
        said, kind, meaning = item.metadata, item.annotation, item.description or meaning
    bounds = [
        f"{word} {getattr(item, attribute):g}"
        for bound, attribute, word in _BOUND_WORDS
        for item in said
        if isinstance(item, bound)
    ]
    of = typing.get_origin(kind)
    choice = f"one of {', '.join(map(repr, items))}" if of is typing.Literal else "a table"
    noun = _NOUNS.get(kind) or ("a list" if of is tuple else choice)
    return f"{noun} {' and '.join(bounds)}".strip() + (f" ({meaning})" if meaning else "")


_BOUND_WORDS: tuple[tuple[type, str, str], ...] = (
    (annotated_types.Gt, "gt", "above"), (annotated_types.Ge, "ge", "at least"),
    (annotated_types.Lt, "lt", "below"), (annotated_types.Le, "le", "at most"),
)  # fmt: skip


_NOUNS: dict[object, str] = {
    float: "a finite number", int: "a whole number", str: "a text that is not empty", bool: "true or false",
    tuple[str, ...]: "a list of texts", tuple[float, float]: "a list of two finite numbers",
}  # fmt: skip


def _class_at(cls: type, keys: Sequence[int | str]) -> type | None:
    """Return the settings class that owns the keys below `keys`."""
    owner: Any = cls
    for key in keys:
        field = _fields(owner).get(str(key))
        owner = None if field is None else _without_none(field.annotation)
    return cast(type | None, owner)


def _without_none(annotation: object) -> object:
    """Return the class of a field that may be left out, any other annotation as it is."""
    kinds = [kind for kind in typing.get_args(annotation) if kind is not type(None)]
    return kinds[0] if len(kinds) == 1 and isinstance(annotation, types.UnionType) else annotation


def _fields(cls: type | None) -> Mapping[str, FieldInfo]:
    return getattr(cls, "__pydantic_fields__", {})


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

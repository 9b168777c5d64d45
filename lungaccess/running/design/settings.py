"""What a search over devices is: a study's cases, ranges of the numbers of their system, and criteria.

A point of the unit cube, with one coordinate a number, stands for a device that the search may try; each
criterion is a line of a table.
"""

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean, median
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from anatomy.base.errors import SettingsError
from anatomy.base.files import read_toml
from anatomy.base.records import frozen_value
from anatomy.base.settings import impossible, override, parse, settings, text, to_mapping
from lungaccess.problem.system import System
from lungaccess.running.study.settings import Study, study_of

DIGITS = 4
"""Significant digits of a number in a range: a maker keeps no more, and equal devices are tried once."""

_REMEDY = "`lungaccess template design` prints a complete file to start from"
_OF_ONE_NUMBER = frozenset({"range", "one_of", "also"})
"""The keys of a table that says what a number may be; any other table holds numbers."""


@settings
class Number:
    """A number, or another value, of the device that may change.

    Args:
        key: Dotted path in the system's file; entries of arrays by their number from 0, such as
            "tubes.inner.slotted_segments.0.stiffness_factor".
        one_of: The values to choose from, instead of a range: numbers, texts, arrays or whole tables.
        also: Further keys that always have the same value.
    """

    key: Annotated[str, text("key of the system's file")]
    range: Annotated[tuple[float, float] | None, Field(description="least and largest value")] = None
    one_of: Annotated[tuple[Any, ...], Field(description="values to choose from")] = ()
    also: Annotated[tuple[str, ...], Field(description="keys with the same value")] = ()

    @property
    def keys(self) -> tuple[str, ...]:
        """All keys that have the value."""
        return (self.key, *self.also)

    def __post_init__(self) -> None:
        low, high = self.range or (0.0, 1.0)
        if (self.range is None) == (not self.one_of) or low >= high:
            raise impossible(self.key, self.range, "a range [least, larger], or else one_of = [...]")
        if not _is_finite(self.one_of):
            raise impossible(self.key, self.one_of, "finite numbers")


@settings
class Design:
    """A search over devices.

    Args:
        study: The cohort: cases with one system, one planner, one seed, and a budget of iterations.
        make_large: One or two of `CRITERIA`: the best device has most of the first, and of two the front is
            searched.
        designs: How many devices a round begins with.
        rounds: The first covers the ranges evenly; each further one lies closer around the best so far.
        reduction: One of so many devices goes on to so many times the targets, until all are counted.
    """

    study: Study
    vary: Annotated[tuple[Number, ...], Field(min_length=1, description="at least one number")]
    make_large: Annotated[tuple[str, ...], Field(min_length=1, max_length=2, description="one or two")]
    designs: Annotated[int, Field(strict=True, ge=1, description="devices a round")] = 16
    rounds: Annotated[int, Field(strict=True, ge=1, description="rounds")] = 3
    reduction: Annotated[int, Field(strict=True, ge=2, description="one of so many goes on")] = 3
    seed: Annotated[int, Field(strict=True, ge=0, description="seed of the devices")] = 0

    def __post_init__(self) -> None:
        study = self.study
        keys = [key for number in self.vary for key in number.keys]
        for key, names in (("make_large", self.make_large), ("vary", keys)):
            if len(set(names)) < len(names):
                raise impossible(key, names, "each only once")
        for name in self.make_large:
            if name not in CRITERIA:
                raise impossible("make_large", name, f"one of {', '.join(CRITERIA)}")
            if CRITERIA[name].needs_errors and not all(case.errors for case in study.case):
                raise impossible("case.errors", "", f"errors in every case, for {name}")
        for key, found in (
            ("case.system", {case.system for case in study.case}),
            ("planner", [each.name for each in study.planner if each.kind == "plan"]),
            ("seeds", study.seeds),
        ):
            if len(found) != 1:
                raise impossible(key, sorted(found), "one alone, for plans of all stages")
        if study.budget.time_s is not None:
            raise impossible(
                "budget.time_s", study.budget.time_s, "iterations, which can be repeated exactly"
            )


def read_design(path: str | os.PathLike[str]) -> Design:
    """Read a search over devices from a TOML file.

    Raises:
        SettingsError: If the file is not TOML, or a key is unknown, missing or wrong.
        FileError: If the file cannot be read.
    """
    path = Path(path)
    return design_of(read_toml(path, remedy=_REMEDY), path.name, str(path.parent))


def design_of(content: Mapping[str, Any], where: str = "design", folder: str = ".") -> Design:
    """Return the search of plain values: a study and a table `design`; SettingsError if a key is wrong."""
    values = {"planner": [{"name": "atlas"}], **content}
    own = values.pop("design", None)
    if not isinstance(own, Mapping) or not isinstance(own.get("vary"), Mapping):
        raise SettingsError(
            f"{where} has no [design.vary]", expected="numbers that may change", remedy=_REMEDY
        )
    study = study_of(values, where, folder)
    # What else would reach a target is the search's own answer.
    planners = tuple(replace(each, without_counterfactuals=True) for each in study.planner)
    numbers = tuple(
        parse(Number, each, f"{where}, design.vary.{each['key']}", _REMEDY) for each in _numbers(own["vary"])
    )
    return parse(Design, {**own, "vary": numbers, "study": replace(study, planner=planners)}, where, _REMEDY)


def _numbers(table: Mapping[str, Any], before: str = "") -> Iterator[dict[str, Any]]:
    """Yield what each number of nested tables may be: a dotted key may be quoted or not."""
    for name, value in table.items():
        if not isinstance(value, Mapping):
            yield {"key": before + name, "range": value}
        elif value.keys() <= _OF_ONE_NUMBER:
            yield {"key": before + name, **value}
        else:
            yield from _numbers(value, f"{before}{name}.")


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
    """Return the system at a point of the cube, named by what it changes; SettingsError if it is refused."""
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


@frozen_value
class Contender:
    """A device, for each target whether the check accepts a plan, and the criteria of the search.

    The chance of success of a plan is 0 without one, or where no errors are stated.
    """

    system: System
    reached: tuple[bool, ...] = ()
    chances: tuple[float, ...] = ()
    values: tuple[float, ...] = ()


class Criterion(NamedTuple):
    """A finite number that is the better the larger it is: its title with unit, and how it is counted."""

    title: str
    value: Callable[[Contender], float]
    needs_errors: bool = False


def _strain_left(device: Contender) -> float:
    """Return the share of the largest strain, %, that no tube has when it is held straight."""
    tubes = device.system.tubes
    return 100.0 * (1.0 - max(tube.rest_strain for tube in tubes.nested) / tubes.max_strain)


CRITERIA = {
    "reach": Criterion("targets reached, %", lambda device: 100.0 * fmean(device.reached)),
    "chance": Criterion("mean chance of success, %", lambda device: 100.0 * fmean(device.chances), True),
    "median-chance": Criterion("median chance, %", lambda device: 100.0 * median(device.chances), True),
    "needle-radius": Criterion(
        "needle's tightest radius, mm",
        lambda device: device.system.require_needle("The criterion").min_radius_of_curvature_mm,
    ),
    "strain-left": Criterion("strain left when straight, %", _strain_left),
}
"""The criteria by the names that a file gives them: a new one is one more line."""


def _is_finite(value: Any) -> bool:
    """Tell whether all numbers of a value, an array or a table are finite."""
    if isinstance(value, Mapping):
        value = tuple(value.values())
    if isinstance(value, Sequence) and not isinstance(value, str):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)

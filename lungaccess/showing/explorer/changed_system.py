"""Systems with what is changed of them, places to go through, and the command that plans with them."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from lungaccess.planning import TIP_WITHIN_MM
from lungaccess.planning.coupled.exits import PLACE_MM
from lungaccess.problem import System, load_system, shipped_names
from lungaccess.problem.goals import SUCCESS
from lungaccess.problem.request import StatedPlace
from lungaccess.showing.explorer.questions import PlanQuestion, WhatIf


def system_of(what_if: WhatIf, own: Mapping[str, System]) -> System:
    """Return the system of a question.

    Raises SettingsError if there is no such system, it cannot have the change, or one device then does not
    fit the other.

    Args:
        own: Systems by name that are no presets.
    """
    system = own.get(what_if.system)
    if system is None:
        if what_if.system not in shipped_names():
            raise SettingsError(
                f"There is no system {what_if.system!r}",
                expected=f"one of {', '.join([*own, *shipped_names()])}",
            )
        system = load_system(what_if.system)
    changes = _changes(system, what_if)
    allowed = what_if.fissures_allowed
    if changes:
        words = ", ".join(changes.values())
        system = replace(system, **_parts(system, what_if), name=f"{system.name} with {words}")
    elif allowed is not None and allowed != system.fissures_allowed and what_if.system not in own:
        return load_system(what_if.system, fissures_allowed=allowed)
    if allowed is not None and allowed != system.fissures_allowed:
        rule = "may be crossed" if allowed else "are obstacles"
        system = replace(system, name=f"{system.name}, fissures {rule}", fissures_allowed=allowed)
    return system


def _changes(system: System, what_if: WhatIf) -> dict[str, str]:
    """Return what differs from the system, in words, by the name of the value."""
    needle = system.needle
    if needle is None and (what_if.needle_radius_mm or what_if.needle_length_mm):
        system.require_needle("A change of the needle")
    present = {
        "scope_diameter_mm": (system.scope.outer_diameter_mm, "scope {:g} mm"),
        "needle_radius_mm": (needle and needle.min_radius_of_curvature_mm, "needle radius {:g} mm"),
        "needle_length_mm": (needle and needle.max_length_mm, "needle length {:g} mm"),
        "margin_mm": (system.margins.segmentation_margin_mm, "margin {:g} mm"),
    }
    return {
        name: words.format(getattr(what_if, name))
        for name, (value, words) in present.items()
        if getattr(what_if, name) not in (None, value)
    }


def _parts(system: System, what_if: WhatIf) -> dict[str, Any]:
    """Return the devices with their changes."""
    parts: dict[str, Any] = {}
    if what_if.scope_diameter_mm is not None:
        parts["scope"] = replace(system.scope, outer_diameter_mm=what_if.scope_diameter_mm)
    if system.needle is not None:
        needle = system.needle
        if what_if.needle_radius_mm not in (None, needle.min_radius_of_curvature_mm):
            needle = replace(needle, max_curvature_per_mm=1.0 / what_if.needle_radius_mm)
        if what_if.needle_length_mm is not None:
            needle = replace(needle, max_length_mm=what_if.needle_length_mm)
        parts["needle"] = needle
    if what_if.margin_mm is not None:
        parts["margins"] = replace(system.margins, segmentation_margin_mm=what_if.margin_mm)
    return parts


def plan_command(
    patient: Path,
    question: PlanQuestion,
    system: System,
    own: Mapping[str, Path],
    cache: Path | None,
    place: ChosenPlace | None = None,
) -> str:
    """Return the line that makes the same plan, byte for byte.

    Args:
        own: Files of the systems that are no presets, by name.
        place: That the plan goes through.
    """
    what_if = question.what_if
    if system.name in own:
        device = [str(own[system.name])]
    elif system.name in shipped_names():
        device = [system.name]
    elif what_if.system in shipped_names() and system == load_system(
        what_if.system, fissures_allowed=what_if.fissures_allowed
    ):
        device = [what_if.system, "--allow-fissures" if what_if.fissures_allowed else "--no-allow-fissures"]
    else:
        # The name under which a changed system is saved for the command line.
        device = ["system.toml"]
    kind, _, number = question.target.partition(" ")
    target = ["--nodule", number] if kind == "nodule" else ["--target", question.target]
    through = [] if place is None else place.words
    words = ["lungaccess", "plan", str(patient), *target, *through, "--system", *device]
    if question.goal != SUCCESS.name:
        words += ["--goal", question.goal]
    words += ["--iterations", str(question.iterations), "--seed", str(question.seed)]
    if cache is not None:
        words += ["--cache", str(cache)]
    return shlex.join([*words, "--out", "plan"])


DIGITS = 3
"""The command states the point in mm with so many digits; the search takes the same number."""


@frozen_value
class ChosenPlace:
    """A place, LPS mm, with the words of the command for it.

    Args:
        kind: "exit" or "scope tip".
        lps_mm ((3,) floats): As the command states them.
    """

    kind: Literal["exit", "scope tip"]
    lps_mm: tuple[float, float, float]

    @classmethod
    def of(cls, kind: Literal["exit", "scope tip"], point: ArrayLike) -> ChosenPlace:
        """Return the place of a point `(3,)`."""
        x, y, z = np.round(np.asarray(point, dtype=np.float64), DIGITS).tolist()
        return cls(kind=kind, lps_mm=(x, y, z))

    @property
    def within_mm(self) -> float:
        """How far from the place a plan may be."""
        return PLACE_MM if self.kind == "exit" else TIP_WITHIN_MM

    @property
    def stated(self) -> StatedPlace:
        """The place as a request states it."""
        return StatedPlace(kind=self.kind, lps_mm=np.array(self.lps_mm), within_mm=self.within_mm)

    @property
    def words(self) -> list[str]:
        """Options of the command that makes the same search."""
        option = "--" + self.kind.replace(" ", "-")
        point = "lps:" + ",".join(str(value) for value in self.lps_mm)
        return [option, point, f"{option}-within", str(self.within_mm)]

"""Which design of tubes reaches most of the periphery: 25 designs in one bronchoscope.

    python -m experiments.tube_designs [--quick] [--results FOLDER] [--patients NAME ...]

A target is reached if a single arc of the needle, proved clear, leads to it from a deployment of the atlas.
What is finished is kept in a file beside the result, and a run that was stopped goes on from there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.base.settings import override
from experiments.support.reached import run_study
from lungaccess.problem.system import System

BASE = "ultrathin"
PLAIN = {"outer.slotted_segments": (), "inner.slotted_segments": (), "max_channel_curvature_per_mm": None}
"""Tubes without slots; the channel is as bent as their strain allows."""
PAIRS: Mapping[str, Mapping[str, Any]] = {
    "straight outer tube (the preset)": {},
    "inner tube curved by 1/80 mm": {"inner.precurvature_per_mm": 0.0125},
    "inner tube curved by 1/57 mm": {"inner.precurvature_per_mm": 0.0175},
    "inner tube curved by 1/29 mm": {"inner.precurvature_per_mm": 0.035},
    "inner tube curved by 1/22 mm (`lung-default`)": {"inner.precurvature_per_mm": 0.045},
    "curve of 20 mm": {"inner.curved_length_mm": 20.0},
    "curve of 30 mm": {"inner.curved_length_mm": 30.0},
    "curve of 50 mm": {"inner.curved_length_mm": 50.0},
    "curve of 60 mm": {"inner.curved_length_mm": 60.0},
    "curve of 20 mm by 1/22 mm": {"inner.curved_length_mm": 20.0, "inner.precurvature_per_mm": 0.045},
    "curve of 60 mm by 1/80 mm": {"inner.curved_length_mm": 60.0, "inner.precurvature_per_mm": 0.0125},
    "without slots": PLAIN,
    "without slots, strain of 4 %": {**PLAIN, "max_strain": 0.04},
    "outer tube with a thicker wall": {"outer.inner_diameter_mm": 1.27},
    "thinner inner tube": {"inner.outer_diameter_mm": 1.1, "inner.inner_diameter_mm": 0.92},
}
"""Designs of two tubes: what differs from the preset, by key.  All are assumptions, as its own sizes."""
ALONE: Mapping[str, Mapping[str, Any]] = {
    "one straight tube, 30 mm": {
        "curved_length_mm": 0.0,
        "precurvature_per_mm": 0.0,
        "max_extension_mm": 30.0,
    },
    "one straight tube, 60 mm": {"curved_length_mm": 0.0, "precurvature_per_mm": 0.0},
    "one tube curved by 1/80 mm": {"precurvature_per_mm": 0.0125},
    "one tube curved by 1/40 mm": {},
    "one tube curved by 1/22 mm": {"precurvature_per_mm": 0.045},
}
"""Designs in which the preset's inner tube is the only one, with what differs."""
TURNED_BASE = "curved-outer"
TURNED: Mapping[str, Mapping[str, Any]] = {
    "two curved tubes turned each by itself (the preset)": {},
    "the same, outer tube straight": {"outer.curved_length_mm": 0.0, "outer.precurvature_per_mm": 0.0},
    "the same, outer tube curved by 1/100 mm": {"outer.precurvature_per_mm": 0.01},
    "the same, outer tube curved over 40 mm": {"outer.curved_length_mm": 40.0},
    "the same, tubes of 400 and 440 mm": {"outer.length_mm": 400.0, "inner.length_mm": 440.0},
}
"""Designs with a curved outer tube in the same bronchoscope: what differs from their preset, by key."""


def designs() -> Iterator[tuple[str, System | None]]:
    """Yield the name of each design and its system, None if it breaks its own limits."""
    base = la.load_system(BASE, fissures_allowed=True)
    alone = replace(base, tubes=replace(base.tubes, outer=None))
    for name, changes in PAIRS.items():
        yield name, _changed(base, {f"tubes.{key}": value for key, value in changes.items()})
    for name, changes in ALONE.items():
        where = {key: "tubes." if key == "max_extension_mm" else "tubes.inner." for key in changes}
        yield name, _changed(alone, {where[key] + key: value for key, value in changes.items()})
    turned = la.load_system(TURNED_BASE, fissures_allowed=True)
    for name, changes in TURNED.items():
        yield name, _changed(turned, {f"tubes.{key}": value for key, value in changes.items()})


def _changed(system: System, changes: Mapping[str, Any]) -> System | None:
    try:
        return override(system, changes)
    except SettingsError:
        return None


def main() -> None:
    """Run the study and store its result."""
    conditions = {"system": f"{BASE}, with other tubes", "fissures": "may be crossed"}
    title = "Peripheral targets within reach, by design of the tubes"
    run_study(__doc__, "tube_designs", title, conditions, designs)


if __name__ == "__main__":
    main()

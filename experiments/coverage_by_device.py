"""How many peripheral targets each device reaches that obeys all rules: strain, slots, needle, fissures.

    python -m experiments.coverage_by_device [--quick] [--results FOLDER] [--patients NAME ...]

A target is reached if a single arc of the needle, proved clear, leads to it from a deployment of the atlas.
What is finished is kept in a file beside the result, and a run that was stopped goes on from there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import lungaccess as la
from anatomy.base.settings import override
from experiments.support.reached import run_study
from lungaccess.problem.system import System

RADII_MM = (121.0, 50.0)
"""Of the needle: those of [Kuntz2015] and of `flexure-needle`."""
PLAIN = {
    "tubes.outer.slotted_segments": (),
    "tubes.inner.slotted_segments": (),
    "tubes.max_channel_curvature_per_mm": None,
}
"""Tubes without slots; the channel is as bent as their strain allows."""
COUNTED: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "lung-default": ("lung-default", {}),
    "ultrathin": ("ultrathin", {}),
    "stylet-needle": ("stylet-needle", {}),
    "thin-scope": ("thin-scope", {}),
    "therapeutic-scope": ("therapeutic-scope", {}),
    "thin-scope, strain of 4 %": (
        "thin-scope",
        {"tubes.max_strain": 0.04, "tubes.max_channel_curvature_per_mm": None},
    ),
    "thin-scope without slots": ("thin-scope", PLAIN),
    "thin-scope without slots, strain of 4 %": ("thin-scope", {**PLAIN, "tubes.max_strain": 0.04}),
}
"""Presets, and what differs from them.  `flexure-needle` is `thin-scope` with the needle of 50 mm."""
DEVICES: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    **COUNTED,
    **{
        f"{device}, needle's stiffness neglected": (preset, {**changes, "needle_preloaded": False})
        for device, (preset, changes) in COUNTED.items()
    },
}
"""All of them with the needle in the equilibrium of the tubes, and without: what its stiffness costs."""


def systems(device: str) -> Iterator[tuple[str, System]]:
    """Yield the settings of a device in words and its systems: fissures and radius of the needle."""
    preset, changes = DEVICES[device]
    for crossed in (True, False):
        system = override(la.load_system(preset, fissures_allowed=crossed), dict(changes))
        for radius in RADII_MM:
            words = f"R = {radius:g} mm, fissures {'crossed' if crossed else 'not crossed'}"
            yield words, replace(system, needle=replace(system.needle, max_curvature_per_mm=1.0 / radius))


def all_systems() -> Iterator[tuple[str, System]]:
    """Yield every device with every setting, in words, and its system."""
    for device in DEVICES:
        for words, system in systems(device):
            yield f"{device}, {words}", system


def main() -> None:
    """Run the study and store its result."""
    run_study(__doc__, "coverage_by_device", "Peripheral targets within reach, by device", {}, all_systems)


if __name__ == "__main__":
    main()

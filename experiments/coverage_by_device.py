"""How many peripheral targets each device reaches that obeys all rules: strain, slots, needle, fissures.

    python -m experiments.coverage_by_device [--quick] [--results FOLDER] [--patients NAME ...]

A target is reached if a single arc of the needle, proved clear, leads to it from a deployment of the atlas.
What is finished is kept in a file beside the result, and a run that was stopped goes on from there.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import lungaccess as la
from anatomy.settings import override
from experiments.support.anatomies import anatomy, default_anatomies
from experiments.support.reached import FinishedCounts
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.problem.system import System

TARGETS_A_LUNG, QUICK_TARGETS_A_LUNG = 50, 3
RADII_MM = (121.0, 50.0)
"""Of the needle: those of [Kuntz2015] and of `flexure-needle`."""
PLAIN = {
    "tubes.outer.slotted_segments": (),
    "tubes.inner.slotted_segments": (),
    "tubes.max_channel_curvature_per_mm": None,
}
"""Tubes without slots; the channel is as bent as their strain allows."""
DEVICES: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "ultrathin": ("ultrathin", {}),
    "stylet-needle": ("stylet-needle", {}),
    "lung-default": ("lung-default", {}),
    "therapeutic-scope": ("therapeutic-scope", {}),
    "lung-default, strain of 4 %": (
        "lung-default",
        {"tubes.max_strain": 0.04, "tubes.max_channel_curvature_per_mm": None},
    ),
    "lung-default without slots": ("lung-default", PLAIN),
    "lung-default without slots, strain of 4 %": ("lung-default", {**PLAIN, "tubes.max_strain": 0.04}),
}
"""Presets, and what differs from them.  `flexure-needle` is `lung-default` with the needle of 50 mm."""


def systems(device: str) -> Iterator[tuple[str, System]]:
    """Yield the settings of a device in words and its systems: fissures and radius of the needle."""
    preset, changes = DEVICES[device]
    for crossed in (True, False):
        system = override(la.load_system(preset, fissures_allowed=crossed), dict(changes))
        for radius in RADII_MM:
            words = f"R = {radius:g} mm, fissures {'crossed' if crossed else 'not crossed'}"
            yield words, replace(system, needle=replace(system.needle, max_curvature_per_mm=1.0 / radius))


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--patients", nargs="+", default=default_anatomies())
    options = parser.parse_args()
    per_lung = QUICK_TARGETS_A_LUNG if options.quick else TARGETS_A_LUNG
    patients = options.patients[:1] if options.quick else options.patients
    setting = setting_of(options)
    result = Result(
        name="coverage_by_device", title="Peripheral targets within reach, by device",
        setting=setting, seeds=[options.seed],
        conditions={
            "targets": f"{2 * per_lung} random peripheral points a patient",
            "reached": "by a single arc that is proved clear, from a deployment of the atlas",
        },
    )  # fmt: skip
    finished = FinishedCounts(Path(options.results) / setting / "coverage_by_device_finished" / "counts.json")
    for name in patients:
        lung = anatomy(name)
        for device in DEVICES:
            for words, system in systems(device):
                count = finished.count(lung, system, per_lung, options.seed)
                result.add(f"{lung.name}: {device}, {words}", 100.0 * count / (2 * per_lung), unit="%")
    write_result(result, options.results)


if __name__ == "__main__":
    main()

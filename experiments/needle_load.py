"""What a needle does to tubes that are deployed without it: presets with a solid wire, and other needles.

    python -m experiments.needle_load

For each device it prints how many times as stiff as its inner tube the needle is; over all deployments that
its limits allow, how far the tip of the tubes moves and by how much it turns when the needle arrives, how far
it moves after that, and what share of the motion tissue leaves; what the handle must set for one degree of
bend, without and with the needle; and how far the scope's tip turns if the handle stays where it was.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

import lungaccess as la
from anatomy.base.settings import override
from experiments.support.needle_load.arrivals import needle_arrivals
from experiments.support.needle_load.tissue import LUNG_N_MM2, held_shape
from lungaccess.problem.channel import stiffness_ratio
from lungaccess.problem.system import System
from stages.tube import BEND_RAD, ShapeLimits, TubeShapes, straightening, tube_shapes
from stages.tube.mechanics import TubeMechanics

PRESETS = ("thin-scope", "flexure-needle", "ultrathin", "lung-default", "therapeutic-scope", "stylet-needle")
BASE = "lung-default"
SLOTS = {"length_mm": 230.0, "stiffness_factor": 0.04, "strain_factor": 0.75}
PLAIN = {
    "tubes.inner.slotted_segments": (),
    "tubes.outer.slotted_segments": (),
    "tubes.max_channel_curvature_per_mm": None,
}
SOLID = {"needle_preloaded": False, "needle.inner_diameter_mm": 0.0, "needle.slotted_segments": ()}
"""A needle that is a solid wire and comes when the tubes stand."""
CHANGES: Mapping[str, Mapping[str, Any]] = {
    "solid wire of 0.8 mm": {},
    "needle with a bore of 0.6 mm": {"needle.inner_diameter_mm": 0.6},
    "the same, its last 60 mm slotted": {
        "needle.inner_diameter_mm": 0.6,
        "needle.slotted_segments": ({**SLOTS, "length_mm": 60.0},),
    },
    "the same, its last 230 mm slotted": {
        "needle.inner_diameter_mm": 0.6,
        "needle.slotted_segments": (SLOTS,),
    },
    "slotted needle of 0.6 mm, bore 0.45 mm": {
        "needle.diameter_mm": 0.6,
        "needle.inner_diameter_mm": 0.45,
        "needle.slotted_segments": (SLOTS,),
    },
    "solid wire of 0.4 mm": {"needle.diameter_mm": 0.4},
    "plastic shaft of 0.8 mm, 3.6 GPa": {"needle.youngs_modulus_gpa": 3.6},
    "tubes without slots": PLAIN,
    "the same, slotted needle of 0.8 mm, bore 0.6 mm": {
        **PLAIN,
        "needle.inner_diameter_mm": 0.6,
        "needle.slotted_segments": (SLOTS,),
    },
}
"""What differs from the base with a solid wire; sizes are assumptions, slots those of the presets' tubes."""
SAMPLE = 12
"""Deployments looked at in tissue, evenly among all."""
EXIT_MM = 5.0
"""Arc length at which tissue begins to hold the tubes: an assumption, as a wall met obliquely is so thick."""
HEADINGS = (
    "device", "needle / inner tube", "tip moves, mm", "turns, deg", "later, mm", "keeps sweep", "in tissue",
    "handle", "scope turns, deg",
)  # fmt: skip
"""Of the table; three numbers are the median, nine tenths and the largest."""
BEND_DEG = 60.0
"""Bend of the section with tubes in it, for the scope's tip that turns."""


@dataclass(frozen=True)
class Row:
    """What the needle does to one device; medians, nine tenths and largest, mm and degrees."""

    ratio: float
    shift_mm: tuple[float, float, float]
    turn_deg: tuple[float, float, float]
    later_mm: tuple[float, float, float]
    swept: float
    held_mm: tuple[float, ...]
    handle: tuple[float, float]
    scope_deg: float


def with_changes(system: System, changes: Mapping[str, Any]) -> System:
    """Return a device of its own name that has a solid wire and differs by some keys."""
    return override(system, {"name": "changed", **SOLID, **changes})


def shapes_without_needle(system: System) -> TubeShapes:
    """Return all deployments within the device's limits."""
    tubes = system.tubes
    limits = ShapeLimits(
        max_extension_mm=tubes.max_extension_mm,
        max_lateral_sweep_mm=tubes.max_lateral_sweep_mm,
        max_strain=tubes.max_strain,
    )
    return tube_shapes(tubes.nested, limits)


def measured(system: System) -> Row:
    """Return what the needle does to a device."""
    needle, shaft = system.require_needle("The load"), system.needle_tube
    if shaft is None:
        raise ValueError(f"the needle of {system.name} has no stiffness")
    shapes = shapes_without_needle(system)
    mechanics = TubeMechanics(system.tubes.nested, needle=shaft)
    base, beta = shapes.rotations_rad + BEND_RAD, shapes.insertions_mm - mechanics.lengths_mm
    free = needle_arrivals(mechanics, base, beta, needle.max_length_mm, tip_angles_rad=shapes.tip_angles_rad)
    some = np.unique(np.linspace(0, shapes.count - 1, SAMPLE).astype(int))
    held = []
    for tissue in LUNG_N_MM2:
        tips = [
            held_shape(
                mechanics, base[m], beta[m], needle_mm=float(shapes.insertions_mm[m, 0]), tissue_n_mm2=tissue,
                tissue_from_mm=min(EXIT_MM, float(shapes.insertions_mm[m, 0])), element_mm=1.0,
            ).base_from_tip[:3, 3]
            for m in some.tolist()
        ]  # fmt: skip
        moved = np.linalg.norm(np.array(tips) - free.before[some, :3, 3], axis=1)
        held.append(float(np.median(moved / np.maximum(free.shift_mm[some], 1e-9))))
    scope = system.scope
    section = scope.bending_length_mm, scope.bending_stiffness_n_mm2
    tubes_alone = straightening(system.tubes, (10.0, 30.0), *section)
    loaded = straightening(
        system.tubes, (10.0, 30.0), *section, needle=shaft, needle_out_mm=needle.max_length_mm
    )
    sweep = np.maximum(free.sweep_mm, free.sweep_after_mm)
    return Row(
        ratio=stiffness_ratio(system),
        shift_mm=spread(free.shift_mm),
        turn_deg=spread(np.degrees(free.turn_rad)),
        later_mm=spread(np.linalg.norm((free.after - free.arrived)[:, :3, 3], axis=1)),
        swept=float((sweep <= system.tubes.max_lateral_sweep_mm).mean()),
        held_mm=tuple(held),
        handle=(1.0 + tubes_alone, 1.0 + loaded),
        scope_deg=BEND_DEG * (1.0 - (1.0 + tubes_alone) / (1.0 + loaded)),
    )


def spread(values: Any) -> tuple[float, float, float]:
    """Return median, nine tenths and largest."""
    return tuple(float(each) for each in np.percentile(values, [50.0, 90.0, 100.0]))  # type: ignore[return-value]


def lines(devices: Mapping[str, System]) -> Iterator[str]:
    """Yield a table."""
    yield f"| {' | '.join(HEADINGS)} |"
    yield "|" + "---|" * len(HEADINGS)
    for name, system in devices.items():
        row = measured(system)
        moved = " / ".join(f"{each:.1f}" for each in row.shift_mm)
        turned = " / ".join(f"{each:.0f}" for each in row.turn_deg)
        later = " / ".join(f"{each:.1f}" for each in row.later_mm)
        held = " to ".join(f"{each:.2f}" for each in reversed(row.held_mm))
        handle = " to ".join(f"{each:.2f}" for each in row.handle)
        yield (
            f"| {name} | {row.ratio:.2g} | {moved} | {turned} | {later} | {100 * row.swept:.0f} % | {held} | "
            f"{handle} | {row.scope_deg:.0f} |"
        )


def main() -> None:
    """Print both tables."""
    for table in (
        {f"`{name}`": with_changes(la.load_system(name), {}) for name in PRESETS},
        {name: with_changes(la.load_system(BASE), changes) for name, changes in CHANGES.items()},
    ):
        for line in lines(table):
            print(line, flush=True)
        print()


if __name__ == "__main__":
    main()

"""Nested tubes and a needle as Cosserat rods of PyElastica, tied at their nodes, free to turn, at rest.

The library knows neither concentric tubes nor their torsional equation: each rod has its stiffness and its
curvature at rest, springs keep the nodes of all together, and damping takes the energy out.  What it finds
differs by its discretisation, whose error falls with the square of the spacing of its nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import elastica
import numpy as np

from anatomy.base.typed import Float
from anatomy.shafts import SlottedSegment
from stages.tube.device import Tube
from stages.tube.mechanics import TubeMechanics

MODULUS = 55e3
"""In N/mm^2: with it as the density a wave runs a mm in a unit of time; the shape at rest is the same."""
DAMPING = 1.2e-3
"""Rate at which velocities fall, per unit of time."""
DURATION = 12_000.0
"""The slowest motion of a tube of 32 mm has died away by then."""
AT_REST = 2e-5
"""Speed, mm in a unit of time, below which rods are at rest: the slowest turn by 1e-3 rad in it, and are then
within a fiftieth of a millimetre."""
SPACING = 2.0
"""Spacing of nodes, mm: errors of tips are a few hundredths of a millimetre."""


class Nodes(elastica.FreeJoint.__base__):  # type: ignore[misc]
    """A connection of PyElastica that ties the nodes of two rods, as many as the shorter has."""

    def __init__(self, stiffness: float, damping: float) -> None:
        self.stiffness, self.damping = stiffness, damping

    def apply_forces(
        self, system_one: Any, index_one: Any, system_two: Any, index_two: Any, time: Any = 0.0
    ) -> None:
        n = min(system_one.n_elems, system_two.n_elems) + 1
        force = self.stiffness * (system_two.position_collection - system_one.position_collection[:, :n])
        force += self.damping * (system_two.velocity_collection - system_one.velocity_collection[:, :n])
        system_one.external_forces[:, :n] += force
        system_two.external_forces -= force

    def apply_torques(
        self, system_one: Any, index_one: Any, system_two: Any, index_two: Any, time: Any = 0.0
    ) -> None:
        return


def rod_of(tube: Tube, end_mm: float, angle: float, spacing: float) -> Any:
    """Return a straight rod with what a tube has ahead of the front plate, held by its first element.

    It has a node in the middle of each stretch of the spacing, and half an element more at either end.
    """
    count = round(end_mm / spacing)
    rod = elastica.CosseratRod.straight_rod(
        n_elements=count + 1,
        start=np.array([0.0, 0.0, -0.5 * spacing]),
        direction=np.array([0.0, 0.0, 1.0]),
        normal=np.array([np.cos(angle), np.sin(angle), 0.0]),
        base_length=(count + 1) * spacing,
        base_radius=0.5,
        density=MODULUS,
        youngs_modulus=MODULUS,
    )
    parts = tube.parts
    part = np.searchsorted(parts.end_mm, end_mm - spacing * (np.arange(count) + 0.5))
    rod.bend_matrix[:] = 0.0
    rod.bend_matrix[0, 0] = rod.bend_matrix[1, 1] = parts.stiffness_n_mm2[part]
    rod.bend_matrix[2, 2] = tube.torsional_stiffness_n_mm2
    rod.mass_second_moment_of_inertia *= 10.0  # No stiffness, so that steps may be longer.
    rod.inv_mass_second_moment_of_inertia /= 10.0
    rod.rest_kappa[0] = parts.curvature_per_mm[part]
    return rod


def at_rest(
    systems: Sequence[tuple[Sequence[Tube], Sequence[float], Sequence[float]]],
    spacing: float,
    duration: float,
) -> list[list[Any]]:
    """Return the rods of systems, each by itself, at rest: all in one world, where a step of many is cheap.

    A system is bodies, the longest first; where they end, mm, at multiples of the spacing; and their angles.
    """
    parts = (elastica.BaseSystemCollection, elastica.Constraints, elastica.Connections, elastica.Damping)
    world: Any = type("World", parts, {})()
    step, made = 0.4 * spacing, []
    for system in systems:
        made.append([rod_of(*body, spacing) for body in zip(*system, strict=True)])
        for rod in made[-1]:
            world.append(rod)
    for first, *others in made:
        for rod in (first, *others):
            world.constrain(rod).using(
                elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
            )
            world.dampen(rod).using(
                elastica.AnalyticalLinearDamper, uniform_damping_constant=DAMPING, time_step=step
            )
        mass = float(first.mass.mean())
        for rod in others:
            world.connect(first, rod).using(Nodes, mass / spacing**2, 0.02 * mass / spacing)
    world.finalize()
    elastica.integrate(elastica.PositionVerlet(), world, duration, int(duration / step), progress_bar=False)
    speed = max(float(np.abs(rod.velocity_collection).max()) for rods in made for rod in rods)
    if speed > AT_REST:
        raise RuntimeError(f"rods still move by {speed:.2g} mm in a unit of time")
    return made


def tip_of(rod: Any) -> tuple[Any, Any]:
    """Return point and direction of a rod half an element before its end."""
    return rod.position_collection[:, -2:].mean(axis=1), rod.director_collection[2, :, -1]


def random_system(number: int) -> tuple[list[Tube], list[float], list[float], Tube, float]:
    """Return two tubes, their ends and angles, and a needle with a soft end, all borders between nodes."""
    rng = np.random.default_rng(number)
    modulus = 1e-3 * MODULUS
    out = [int(rng.integers(10, 17)), 0]
    out[1] = int(rng.integers(4, out[0] + 1))
    tubes = []
    for size, end in enumerate(out):
        curved = int(rng.integers(3, end + 1))
        diameter = 1.1 + 0.4 * size
        tubes.append(
            Tube(
                outer_diameter_mm=diameter,
                inner_diameter_mm=diameter - rng.uniform(0.12, 0.25),
                length_mm=SPACING * (end + 20 - 10 * size),
                curved_length_mm=SPACING * curved,
                precurvature_per_mm=float(rng.uniform(0.01, 0.04) / (1 + size)),
                youngs_modulus_gpa=modulus,
            )
        )
    soft = SlottedSegment(
        length_mm=SPACING * int(rng.integers(2, 12)),
        stiffness_factor=float(rng.uniform(0.3, 0.8)),
        strain_factor=1.0,
    )
    needle = Tube(
        outer_diameter_mm=float(rng.uniform(0.65, 0.84)),
        inner_diameter_mm=0.3,
        length_mm=SPACING * 100,
        slotted_segments=(soft,),
        youngs_modulus_gpa=modulus,
    )
    needle_mm = SPACING * int(rng.integers(out[0] // 2, out[0] + 1))
    angles = [0.0, float(rng.uniform(-1.2, 1.2))]
    return tubes, [SPACING * end for end in out], angles, needle, needle_mm


class Apart(NamedTuple):
    """How far the tip of rods is from that of the mechanics, in mm and degrees, and what the needle moves."""

    mm: float
    degrees: float
    moved_mm: float


def apart(numbers: Iterable[int]) -> list[Apart]:
    """Return how far apart rods and mechanics of random systems are, with the needle in the tubes."""
    systems, wanted, unloaded = [], [], []
    for tubes, ends, angles, needle, needle_mm in map(random_system, numbers):
        beta: Float = np.array(ends) - [tube.length_mm for tube in tubes]
        mechanics = TubeMechanics(tubes, needle=needle)
        # The rods begin at the front plate, where the tubes are turned by less than at their rear ends.
        found = mechanics.given_base_angles(angles, beta, needle_mm=needle_mm)
        at_plate = found.angles([0.0])[0].tolist()
        systems.append(([*tubes, needle], [*ends, needle_mm], [*at_plate, 0.0]))
        wanted.append(found.base_from_tip)
        unloaded.append(mechanics.given_base_angles(angles, beta, needle_mm=0.0).base_from_tip)
    all_apart = []
    for rods, tip, before in zip(at_rest(systems, SPACING, DURATION), wanted, unloaded, strict=True):
        point, ahead = tip_of(rods[0])
        all_apart.append(
            Apart(
                mm=float(np.linalg.norm(point - tip[:3, 3])),
                degrees=float(np.degrees(np.arcsin(np.linalg.norm(np.cross(ahead, tip[:3, 2]))))),
                moved_mm=float(np.linalg.norm(before[:3, 3] - tip[:3, 3])),
            )
        )
    return all_apart

"""Two tubes beside PyElastica: two Cosserat rods, tied at their nodes, free to turn in each other, at rest.

The library knows neither concentric tubes nor their torsional equation: each rod has its stiffness and its
curvature at rest, springs keep the nodes of both together, and damping takes the energy out.  What it finds
differs by its discretisation, whose error falls with the number of elements.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stages.tube.device import Tube
from stages.tube.mechanics import TubeMechanics

elastica: Any = pytest.importorskip("elastica", reason="PyElastica (the extra 'test') is not installed")

pytestmark = pytest.mark.slow

LENGTH_MM = 60.0
YOUNGS_MODULUS_GPA = 55.0
DURATION, DAMPING = 60_000.0, 4e-4
"""In units of time in which a wave runs a mm in the material."""


class Nodes(elastica.FreeJoint.__base__):  # type: ignore[misc]
    """A connection of PyElastica that ties all nodes of two rods by springs with dampers."""

    def __init__(self, stiffness: float, damping: float) -> None:
        self.stiffness, self.damping = stiffness, damping

    def apply_forces(
        self, system_one: Any, index_one: Any, system_two: Any, index_two: Any, time: Any = 0.0
    ) -> None:
        force = self.stiffness * (system_two.position_collection - system_one.position_collection)
        force += self.damping * (system_two.velocity_collection - system_one.velocity_collection)
        system_one.external_forces += force
        system_two.external_forces -= force

    def apply_torques(
        self, system_one: Any, index_one: Any, system_two: Any, index_two: Any, time: Any = 0.0
    ) -> None:
        return


def rod_of(tube: Tube, base_angle: float, elements: int) -> Any:
    """Return a straight rod with the stiffness of a tube, held by its first element."""
    element = LENGTH_MM / (elements - 0.5)
    modulus = 1e3 * YOUNGS_MODULUS_GPA
    rod = elastica.CosseratRod.straight_rod(
        n_elements=elements,
        start=np.array([0.0, 0.0, -0.5 * element]),
        direction=np.array([0.0, 0.0, 1.0]),
        normal=np.array([np.cos(base_angle), np.sin(base_angle), 0.0]),
        base_length=LENGTH_MM + 0.5 * element,
        base_radius=0.5,
        density=modulus,  # A wave runs a mm in a unit of time; the shape at rest is the same.
        youngs_modulus=modulus,
    )
    bending, torsion = tube.bending_stiffness_n_mm2, tube.torsional_stiffness_n_mm2
    rod.bend_matrix[:] = np.diag([bending, bending, torsion])[..., None]
    rod.mass_second_moment_of_inertia *= 10.0  # No stiffness, so that steps may be longer.
    rod.inv_mass_second_moment_of_inertia /= 10.0
    rod.rest_kappa[0] = tube.precurvature_per_mm
    return rod


def at_rest(tubes: list[Tube], base_angles: list[float], elements: int) -> tuple[np.ndarray, float]:
    """Return the nodes of the tubes (mm), and by what angle (rad) the ends are turned against each other."""

    parts = (elastica.BaseSystemCollection, elastica.Constraints, elastica.Connections, elastica.Damping)
    world: Any = type("World", parts, {})()

    step = 0.4 * LENGTH_MM / elements
    rods = [rod_of(tube, angle, elements) for tube, angle in zip(tubes, base_angles, strict=True)]
    for rod in rods:
        world.append(rod)
        world.constrain(rod).using(
            elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
        )
        world.dampen(rod).using(
            elastica.AnalyticalLinearDamper, uniform_damping_constant=DAMPING, time_step=step
        )
    mass = float(rods[0].mass.mean())
    world.connect(rods[0], rods[1]).using(Nodes, 0.02 * mass, 0.02 * mass)
    world.finalize()
    elastica.integrate(elastica.PositionVerlet(), world, DURATION, int(DURATION / step), progress_bar=False)
    assert max(float(np.abs(rod.velocity_collection).max()) for rod in rods) < 1e-6  # At rest.
    inner, outer = (rod.director_collection[..., -1] for rod in rods)
    turn = outer @ inner.T
    angle = float(np.arctan2(turn[0, 1] - turn[1, 0], turn[0, 0] + turn[1, 1]))
    return 0.5 * (rods[0].position_collection + rods[1].position_collection).T, angle


@pytest.mark.parametrize("degrees", [0.0, 60.0, 120.0])
def test_two_rods_come_to_rest_in_the_shape_of_the_tubes(degrees: float) -> None:
    tubes = [
        Tube(
            outer_diameter_mm=1.0 + 0.3 * size,
            inner_diameter_mm=0.85 + 0.3 * size,
            length_mm=LENGTH_MM,
            curved_length_mm=LENGTH_MM,
            precurvature_per_mm=curvature,
            youngs_modulus_gpa=YOUNGS_MODULUS_GPA,
        )
        for size, curvature in ((0, 0.02), (1, 0.012))
    ]
    angles = [0.0, np.radians(degrees)]
    wanted = TubeMechanics(tubes).given_base_angles(angles, [0.0, 0.0])
    twisted = float(wanted.tip_angles_rad[1] - wanted.tip_angles_rad[0])
    apart_mm, turned_rad = [], []
    for elements in (20, 40):
        nodes, turn = at_rest(tubes, angles, elements)
        ours = wanted.backbone(LENGTH_MM * (np.arange(1, elements + 1) - 0.5) / (elements - 0.5))
        apart_mm.append(float(np.linalg.norm(nodes[1:] - ours, axis=1).max()))
        turned_rad.append(abs(turn - twisted))
    assert apart_mm[1] < 0.75 * apart_mm[0] < 0.1  # Of 60 mm; half the elements, about twice the error.
    assert turned_rad[1] < 0.025
    assert turned_rad[1] <= 0.75 * turned_rad[0]

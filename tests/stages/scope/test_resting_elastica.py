"""The shaft at rest beside PyElastica: a Cosserat rod in the same bent tube, pushed out of its wall, at rest.

The library knows neither scopes nor lumens: a force on every node presses it out of a wall of analytic shape,
the rod's last part has a curvature at rest, and damping takes the energy out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from stages.scope.resting import RestingShaft, WallContact
from tests.stages.scope.lumens import Depth, motion_of, s_bend, sampled, scope_of, torus

elastica: Any = pytest.importorskip("elastica", reason="PyElastica (the extra 'test') is not installed")

pytestmark = pytest.mark.slow

BENDING_N_MM2 = 420.0
TORSION_N_MM2 = 20.0 * BENDING_N_MM2
"""Our shaft does not twist; this rod hardly does."""
STRETCH_N = 500.0
MASS_PER_MM = 1.0
"""With these units of mass and time, only the shape at rest has a meaning."""
DURATION = 400.0
CONTACT = WallContact(wall_stiffness_n_per_mm2=0.3)
LOW, HIGH = (-12.0, -8.0, -5.0), (60.0, 8.0, 90.0)
SECTION_MM = 12.0
BEND, S_BEND = [(20.0, 0.0), (60.0, 1.0 / 40.0)], [(30.0, 1.0 / 50.0), (50.0, -1.0 / 50.0)]
"""Lengths in mm and curvatures in 1/mm of the axes of both tubes."""


class Wall(elastica.NoForces):  # type: ignore[misc]
    """Presses the nodes of a rod out of a wall, by the law of `WallContact`."""

    def __init__(self, depth: Depth, radius_mm: float, length_mm: np.ndarray) -> None:
        self._depth, self._radius = depth, radius_mm
        self._stiff = CONTACT.wall_stiffness_n_per_mm2 * length_mm

    def apply_forces(self, system: Any, time: Any = 0.0) -> None:
        points, step = system.position_collection.T, 1e-4
        over = np.maximum(self._radius - self._depth(points), 0.0)
        touching = np.flatnonzero(over > 0.0)
        if not len(touching):
            return
        shifted = points[touching, None] + step * np.concatenate([np.eye(3), -np.eye(3)])
        values = self._depth(shifted.reshape(-1, 3)).reshape(-1, 2, 3)
        slope = (values[:, 0] - values[:, 1]) / (2.0 * step)
        harder = 1.0 + (over / CONTACT.max_wall_give_mm) ** 2
        system.external_forces[:, touching] += ((self._stiff * over * harder)[touching, None] * slope).T


def at_rest(
    depth: Depth, axis: list[tuple[float, float]], length_mm: float, twist: float, bend: float, elements: int
) -> np.ndarray:
    """Return the place of the tip of a rod from the origin along +z, and where its last element looks.

    It begins on the axis of the tube, of which lengths and curvatures towards +x are given.
    """
    world: Any = type("World", (elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing,
                                elastica.Damping), {})()  # fmt: skip
    element = length_mm / elements
    rod = elastica.CosseratRod.straight_rod(
        n_elements=elements, start=np.zeros(3), direction=np.array([0.0, 0.0, 1.0]),
        normal=np.array([1.0, 0.0, 0.0]), base_length=length_mm, base_radius=1.5,
        density=MASS_PER_MM / (np.pi * 1.5**2), youngs_modulus=1e3, shear_modulus=1e3,
    )  # fmt: skip
    rod.bend_matrix[:] = np.diag([BENDING_N_MM2, BENDING_N_MM2, TORSION_N_MM2])[..., None]
    rod.shear_matrix[:] = np.diag([STRETCH_N, STRETCH_N, STRETCH_N])[..., None]
    rod.mass_second_moment_of_inertia *= 20.0  # No stiffness, so that steps may be longer.
    rod.inv_mass_second_moment_of_inertia /= 20.0
    from_section = element * np.arange(1, elements) - (length_mm - SECTION_MM)
    share = np.clip(0.5 + from_section / element, 0.0, 1.0)  # Half of the element where the section begins.
    # A rod bends about its axes: towards x about y, and towards y about -x.
    rod.rest_kappa[0] = -bend / SECTION_MM * np.sin(twist) * share
    rod.rest_kappa[1] = bend / SECTION_MM * np.cos(twist) * share
    ends = np.cumsum([0.0, *(length for length, _ in axis)])
    angles = np.cumsum([0.0, *(length * curvature for length, curvature in axis)])
    sine, cosine = (
        share(np.interp(element * (np.arange(elements) + 0.5), ends, angles)) for share in (np.sin, np.cos)
    )
    rod.position_collection[0, 1:] = element * np.cumsum(sine)
    rod.position_collection[2, 1:] = element * np.cumsum(cosine)
    rod.director_collection[0] = cosine, 0.0 * sine, -sine
    rod.director_collection[2] = sine, 0.0 * sine, cosine
    world.append(rod)
    world.constrain(rod).using(
        elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    step = 0.3 * element / np.sqrt(STRETCH_N / MASS_PER_MM)
    shares = np.full(elements + 1, element)
    shares[[0, -1]] *= 0.5
    world.add_forcing_to(rod).using(Wall, depth, 1.5, shares)
    world.dampen(rod).using(elastica.AnalyticalLinearDamper, uniform_damping_constant=0.3, time_step=step)
    world.finalize()
    elastica.integrate(elastica.PositionVerlet(), world, DURATION, int(DURATION / step), progress_bar=False)
    assert float(np.abs(rod.velocity_collection).max()) < 1e-4  # At rest.
    ahead = rod.director_collection[2, :, -1]
    return np.concatenate([rod.position_collection[:, -1], ahead])


@pytest.mark.parametrize(
    ("depth", "axis", "twist", "bend"),
    [
        (torus(40.0, 4.0, 20.0), BEND, 0.0, 0.0),
        (torus(40.0, 4.0, 20.0), BEND, 1.2, 0.6),
        (s_bend(50.0, 4.0, 0.6), S_BEND, 0.4, 0.5),
    ],
)
def test_a_rod_of_pyelastica_comes_to_rest_in_the_same_shape(
    depth: Depth, axis: list[tuple[float, float]], twist: float, bend: float
) -> None:
    laid = [(0.0, 0.0, 0.2), (66.0, 0.0, 0.2), (66.0, 0.0, 0.0), (66.0, twist, 0.0), (66.0, twist, bend)]
    shaft = RestingShaft(sampled(depth, LOW, HIGH, 0.5), scope_of(SECTION_MM), CONTACT)
    ours = shaft.rest(motion_of(laid, SECTION_MM), as_advanced=True)
    theirs = at_rest(depth, axis, 66.0 + SECTION_MM, twist, bend, 78)
    ahead = ours.frames[-2:, 6:9].mean(
        axis=0
    )  # The middle of the last element, which is as long as our last arc.
    assert ours.settled
    assert ours.most_give_mm > 0.05  # It leans on the wall.
    assert np.linalg.norm(theirs[:3] - ours.frames[-1, 9:]) < 0.5
    assert np.degrees(np.arccos(min(1.0, float(theirs[3:] @ ahead / np.linalg.norm(ahead))))) < 1.0

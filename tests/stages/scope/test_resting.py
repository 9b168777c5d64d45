"""The shaft at rest: closed forms, the wall's law, two starts, and what the shape states of itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from anatomy.grid import Grid
from stages.scope.kernels import resting as kernel
from stages.scope.resting import Circumstances, RestingShaft, RestingShape, WallContact, signed_depth
from tests.stages.scope.lumens import Depth, motion_of, s_bend, sampled, scope_of, torus

STIFF = WallContact(wall_stiffness_n_per_mm2=100.0)
WIDE = (-40.0, -40.0, -10.0), (40.0, 40.0, 90.0)


BENT = (-12.0, -8.0, -5.0), (60.0, 8.0, 90.0)
NARROW = (-6.0, -4.0, -5.0), (6.0, 4.0, 80.0)
Corner = tuple[float, float, float]


def shaft_in(
    depth: Depth, contact: WallContact = STIFF, box: tuple[Corner, Corner] = WIDE, step_mm: float = 4.0
) -> RestingShaft:
    return RestingShaft(sampled(depth, *box, step_mm), scope_of(), contact)


def free(points: np.ndarray) -> np.ndarray:
    return np.full(len(points), 50.0)


def test_a_straight_shaft_in_a_straight_tube_stays_as_it_is() -> None:
    motion = motion_of([(0.0, 0.0, 0.0), (60.0, 0.0, 0.0)])
    shape = shaft_in(lambda p: 3.0 - np.hypot(p[:, 0], p[:, 1]), STIFF, NARROW, 0.5).rest(motion)
    assert np.abs(shape.lps_from_scope_tip - motion.lps_from_tip).max() < 1e-9
    assert shape.settled
    assert shape.energy_n_mm == shape.wall_force_n == shape.farther_mm == 0.0


def test_a_free_shaft_straightens_and_its_section_is_bent_as_commanded() -> None:
    motion = motion_of([(0.0, 0.0, 0.3), (40.0, 0.0, 0.3), (40.0, 0.7, 1.2)])
    straight = motion_of([(0.0, 0.0, 0.0), (40.0, 0.0, 0.0), (40.0, 0.7, 0.0), (40.0, 0.7, 1.2)])
    shape = shaft_in(free).rest(motion, as_advanced=True)
    assert np.abs(shape.lps_from_scope_tip - straight.lps_from_tip).max() < 1e-4
    assert shape.settled


def test_the_hand_brings_the_tip_to_its_planned_depth() -> None:
    motion = motion_of([(0.0, 0.0, 0.3), (40.0, 0.0, 0.3), (40.0, 0.0, -0.2)])
    shape, planned = shaft_in(free).rest(motion), motion.lps_from_tip
    beyond = (shape.lps_from_scope_tip[:3, 3] - planned[:3, 3]) @ planned[:3, 2]
    assert abs(beyond) < 0.02
    assert abs(shape.farther_mm) > 0.5


def test_a_wall_bends_a_shaft_as_it_bends_a_cantilever() -> None:
    # The wall x <= 1 - 0.04 (z - 36) - radius leaves no room for the tip at 72 mm: F = 3 E I d / L^3.
    slope, radius = 0.04, 1.5
    norm = np.hypot(1.0, slope)

    def depth(points: np.ndarray) -> np.ndarray:
        return np.asarray((radius - slope * (points[:, 2] - 36.0) - points[:, 0]) / norm)

    shape = shaft_in(depth).rest(motion_of([(0.0, 0.0, 0.0), (60.0, 0.0, 0.0)]), as_advanced=True)
    aside = -float(shape.frames[-1, 9])
    assert aside == pytest.approx(slope * 36.0, rel=0.01)
    assert shape.wall_force_n == pytest.approx(3.0 * 420.0 * aside / 72.0**3, rel=0.02)


def test_three_points_hold_a_shaft_between_the_walls_of_a_bend() -> None:
    # An edge presses the shaft down at 36 mm, and a floor holds its tip up at 72 mm: with the clamp three
    # points, whose forces follow from the deflection of a cantilever under two loads.
    places, edge_mm, floor_mm = np.array([36.0, 72.0]), -0.6, -0.3
    radius, round_mm = 1.5, 0.5

    def depth(points: np.ndarray) -> np.ndarray:
        over_edge = (
            np.hypot(points[:, 0] - (edge_mm + radius + round_mm), points[:, 2] - places[0]) - round_mm
        )
        floor = points[:, 0] - (floor_mm - radius) + 0.05 * (places[1] - points[:, 2])
        return np.asarray(np.minimum(over_edge, floor))

    shape = shaft_in(depth, STIFF, NARROW, 0.25).rest(
        motion_of([(0.0, 0.0, 0.0), (60.0, 0.0, 0.0)]), as_advanced=True
    )
    far, near = np.maximum.outer(places, places), np.minimum.outer(places, places)
    loads = np.linalg.solve(near**2 * (3.0 * far - near) / (6.0 * 420.0), [edge_mm, floor_mm])
    at = np.cumsum(shape.lengths_mm)
    found = [shape.force_n[np.abs(at - place) < 6.0].sum() for place in places]
    assert found == pytest.approx(np.abs(loads), rel=0.03)


@pytest.mark.parametrize("depth", [torus(40.0, 4.0, 20.0), s_bend(50.0, 4.0, 0.6)])
def test_two_starts_end_in_one_shape(depth: Depth) -> None:
    shaft = shaft_in(depth, WallContact(), BENT, 0.5)
    laid = motion_of(
        [(0.0, 0.0, 0.2), (65.0, 0.0, 0.2), (65.0, 0.0, 0.0), (65.0, 1.0, 0.0), (65.0, 1.0, 0.5)]
    )
    first = shaft.rest(laid, as_advanced=True)
    relaxed = shaft.rest(motion_of([*map(tuple, laid.states[:-1])]), as_advanced=True)
    second = shaft.rest(laid, as_advanced=True, start=relaxed)
    assert first.settled
    assert second.settled
    assert first.most_give_mm > 0.05
    assert np.abs(first.lps_from_scope_tip - second.lps_from_scope_tip).max() < 0.01


def test_friction_holds_the_shaft_within_its_cone() -> None:
    shaft = shaft_in(torus(40.0, 4.0, 20.0), WallContact(), BENT, 0.5)
    motion = motion_of([(0.0, 0.0, 0.2), (65.0, 0.0, 0.2), (65.0, 1.0, 0.2)])
    smooth = shaft.rest(motion)
    tips = [
        shaft.rest(motion, Circumstances(friction=0.2, slid_rad=slid), start=smooth).lps_from_scope_tip[:3, 3]
        for slid in (0.5 * np.pi, -0.5 * np.pi)
    ]
    off = np.array(tips) - smooth.lps_from_scope_tip[:3, 3]
    # Slid to either side, the tip stays behind on the other one.
    assert off[0] @ off[1] < 0.0
    assert np.linalg.norm(off, axis=1).min() > 0.01


def test_a_camera_head_does_not_bend() -> None:
    motion = motion_of([(0.0, 0.0, 0.0), (40.0, 0.0, 0.0), (40.0, 0.0, 0.9)])
    shape = RestingShaft(
        sampled(free, *WIDE, 4.0), replace(scope_of(), rigid_head_mm=4.0), WallContact()
    ).rest(motion, as_advanced=True)
    assert np.abs(shape.curvature[-4:]).max() < 1e-9
    assert np.arccos(shape.lps_from_scope_tip[2, 2]) == pytest.approx(0.9)


def test_a_load_at_the_tip_bends_a_free_shaft_as_it_bends_a_cantilever() -> None:
    shaft, laid = shaft_in(free)._shaft(motion_of([(0.0, 0.0, 0.0), (40.0, 0.0, 0.0)]), Circumstances())
    count, lumen = len(laid), sampled(free, *WIDE, 4.0)
    frames, pull = np.zeros((count + 1, 12)), np.zeros((count, 3))
    pull[-1] = (0.0004, 0.0003, 0.0)
    entry = np.concatenate([np.eye(3).ravel(), np.zeros(3)])
    energy, expected, _steps = kernel.bring_to_rest(lumen, shaft, entry, laid, pull, frames, 1e-12, 50)
    aside = np.array([0.0004, 0.0003]) * 52.0**3 / (3.0 * 420.0)
    assert frames[-1, 9:11] == pytest.approx(aside, rel=1e-3)
    assert energy == pytest.approx(-0.5 * 0.0005 * np.linalg.norm(aside), rel=1e-3)
    assert 0.0 <= expected <= 1e-12


def test_an_airway_at_the_border_of_the_image_goes_on_beyond_it() -> None:
    inside = np.zeros((21, 21, 60), dtype=bool)
    inside[6:15, 6:15] = True
    grid = Grid.from_spacing(inside.shape, [1.0, 1.0, 1.0], [-10.0, -10.0, 2.0])
    motion = motion_of([(0.0, 0.0, 0.0), (30.0, 0.0, 0.0)])
    shape = RestingShaft(signed_depth(inside, grid), scope_of(), WallContact()).rest(motion)
    assert shape.most_give_mm == 0.0
    assert np.abs(shape.lps_from_scope_tip - motion.lps_from_tip).max() < 1e-9


def test_force_is_that_on_ten_millimetres() -> None:
    count = 30
    shape = RestingShape(
        lps_from_scope_tip=np.eye(4), frames=np.zeros((count + 1, 12)), lengths_mm=np.full(count, 2.0),
        curvature=np.zeros((count, 2)), force_n=np.full(count, 0.1), give_mm=np.zeros(count), farther_mm=0.0,
        energy_n_mm=0.0, settled=True,
    )  # fmt: skip
    assert shape.wall_force_n == pytest.approx(0.5)

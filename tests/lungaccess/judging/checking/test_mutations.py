"""Plans in the wrong place, or in an anatomy with something in the way, are refused."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy import structures
from lungaccess.plans.plan import Plan
from tests.lungaccess.judging.checking.verdict import refusals


def test_an_exit_through_the_trachea_is_refused(plan: Plan, lung: Any, tools: Any) -> None:
    wrong = tools.changed(plan, tube__exit__branch=0, exemption__branch=0)
    assert "tube.exit.not_mediastinal" in refusals(wrong, lung)


def moved(plan: Plan, tools: Any, move: Any, pose: Any, turn: float = 1.0) -> Plan:
    """Apply a map to every point and pose; `turn` multiplies rotations and rolls."""
    arcs = tuple(dataclasses.replace(a, roll_rad=turn * a.roll_rad) for a in plan.needle.arcs)
    return tools.changed(
        plan,
        scope__lps_from_entry=pose(plan.scope.lps_from_entry),
        scope__states=plan.scope.states * [1.0, turn, 1.0],
        scope__lps_from_scope_tip=pose(plan.scope.lps_from_scope_tip),
        tube__lps_from_tip=pose(plan.tube.lps_from_tip),
        tube__exit__point_lps=move(plan.tube.exit.point_lps),
        tube__rotation_rad=turn * plan.tube.rotation_rad,
        needle__lps_from_start=pose(plan.needle.lps_from_start),
        needle__end_lps=move(plan.needle.end_lps),
        needle__arcs=arcs,
        exemption__exit_point_lps=move(plan.exemption.exit_point_lps),
    )


@pytest.mark.parametrize("with_target", [False, True])
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
def test_shifted_by_a_voxel(
    plan: Plan, lung: Any, tools: Any, axis: int, sign: int, with_target: bool
) -> None:
    shift = sign * lung.grid.lps_from_ijk[:3, axis]

    def pose(matrix: np.ndarray) -> np.ndarray:
        out = matrix.copy()
        out[:3, 3] += shift
        return out

    wrong = moved(plan, tools, lambda p: p + shift, pose)
    if with_target:
        wrong = tools.changed(wrong, target_lps=plan.target_lps + shift)
    found = refusals(wrong, lung)
    assert "scope.start" in found
    assert ("target.reached" in found) == (not with_target)


@pytest.mark.parametrize("with_target", [False, True])
def test_mirrored_left_right(plan: Plan, lung: Any, tools: Any, with_target: bool) -> None:
    flip, keep_handed = np.diag([-1.0, 1, 1, 1]), np.diag([1.0, -1, 1, 1])
    wrong = moved(plan, tools, lambda p: p * [-1, 1, 1], lambda m: flip @ m @ keep_handed, turn=-1.0)
    if with_target:
        wrong = tools.changed(wrong, target_lps=plan.target_lps * [-1, 1, 1])
    found = refusals(wrong, lung)
    assert not {"tube.tip.position", "needle.end"} & found  # the mirrored kinematics are consistent
    assert "scope.branch" in found


@settings(max_examples=8)
@given(
    share=st.floats(0.0, 1.0), phi=st.floats(0.0, 6.3), offset=st.floats(0.0, 0.9), radius=st.floats(1.5, 4.0)
)
def test_vessel_put_across_the_needle(
    plan: Plan, lung: Any, tools: Any, share: float, phi: float, offset: float, radius: float
) -> None:
    frames, at = tools.follow(plan.needle.lps_from_start, [_as_tuple(a) for a in plan.needle.arcs], 0.1)
    frame = frames[int(share * (len(at) - 1))]
    across = np.cos(phi) * frame[:3, 0] + np.sin(phi) * frame[:3, 1]
    beside = np.cross(across, frame[:3, 2])
    centre = frame[:3, 3] + offset * radius * beside

    def edit(labels: np.ndarray, points: np.ndarray) -> None:
        inside = tools.capsule(points, centre - 12 * across, centre + 12 * across, radius)
        labels[inside & ((labels & structures.AIRWAY) == 0)] |= structures.VESSEL

    found = refusals(plan, tools.relabelled(lung, edit))
    assert "needle.clearance.vessel" in found


def _as_tuple(arc: Any) -> tuple[float, float, float]:
    return arc.length_mm, arc.roll_rad, arc.curvature_per_mm


def blob(tools: Any, lung: Any, a: np.ndarray, b: np.ndarray, radius: float, bit: int) -> Any:
    def edit(labels: np.ndarray, points: np.ndarray) -> None:
        labels[tools.capsule(points, a, b, radius)] |= bit

    return tools.relabelled(lung, edit)


def test_start_inside_a_vessel(plan: Plan, lung: Any, tools: Any) -> None:
    start = plan.needle.lps_from_start[:3, 3]
    found = refusals(plan, blob(tools, lung, start, start + [0, 0, 1e-3], 2.0, structures.VESSEL))
    assert {
        "needle.containment",
        "tube.containment",
        "tube.clearance.vessel",
        "needle.clearance.vessel",
    } <= found


@pytest.mark.parametrize("beyond_exit_mm", [0.0, 1.0, 3.0, 6.0])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_vessel_put_across_the_tube(
    plan: Plan, lung: Any, tools: Any, beyond_exit_mm: float, side: float
) -> None:
    tip = plan.tube.lps_from_tip
    back = min(plan.tube.inner_insertion_mm - plan.tube.exit.arc_length_mm - beyond_exit_mm, 7.0)
    centre = tip[:3, 3] - back * tip[:3, 2] + side * 2.0 * tip[:3, 1]
    crossed = blob(tools, lung, centre - 9 * tip[:3, 0], centre + 9 * tip[:3, 0], 1.5, structures.VESSEL)
    assert "tube.clearance.vessel" in refusals(plan, crossed)


def test_tip_that_looks_back(plan: Plan, lung: Any, tools: Any) -> None:
    pose = plan.scope.lps_from_scope_tip @ np.diag([1.0, -1.0, -1.0, 1.0])
    found = refusals(tools.changed(plan, scope__lps_from_scope_tip=pose), lung)
    assert "scope.tip.direction" in found


def test_needle_wholly_inside_a_vessel(plan: Plan, lung: Any, tools: Any) -> None:
    """Nothing is near: the surface of the vessel is more than 5 mm away everywhere."""
    a, b = plan.needle.lps_from_start[:3, 3], plan.needle.end_lps
    big = blob(tools, lung, a, b, 9.0, structures.VESSEL)
    found = refusals(plan, big)
    assert {"needle.containment", "needle.clearance.vessel", "target.free"} <= found


def test_needle_wholly_outside_the_lung(plan: Plan, lung: Any, tools: Any) -> None:
    a, b = plan.needle.lps_from_start[:3, 3], plan.needle.end_lps
    found = refusals(plan, blob(tools, lung, a, b, 9.0, structures.OUTSIDE))
    assert {"needle.in_lung", "needle.clearance.outside", "target.in_lung"} <= found


def test_one_voxel_of_vessel_beside_tube_or_needle(plan: Plan, lung: Any, tools: Any) -> None:
    """The nearest voxel that violates the margin by little is found; the next one outwards is allowed."""
    frames, _ = tools.follow(plan.needle.lps_from_start, [_as_tuple(a) for a in plan.needle.arcs], 0.02)
    middle = frames[len(frames) // 2]
    verdicts = set()
    for aside in np.arange(0.0, 6.0, 0.5):
        voxel = np.rint(lung.grid.ijk(middle[:3, 3] + aside * middle[:3, 0])).astype(int)
        mask = np.zeros(lung.labels.shape, dtype=bool)
        mask[tuple(voxel)] = True
        distance = float(tools.brute_distance(lung, mask, frames[:, :3, 3]).min())
        near = tools.relabelled(
            lung, lambda labels, _, at=tuple(voxel): labels.__setitem__(at, structures.VESSEL)
        )
        refused = "needle.clearance.vessel" in refusals(plan, near)
        assert refused == (distance < plan.required_clearance_mm["needle"] - 1e-3)
        verdicts.add(refused)
    assert verdicts == {True, False}


def test_fissure_put_across_the_path(plan: Plan, lung: Any, tools: Any) -> None:
    middle = 0.5 * (plan.needle.lps_from_start[:3, 3] + plan.needle.end_lps)
    crossed = blob(tools, lung, middle - [0, 12, 0], middle + [0, 12, 0], 1.5, structures.FISSURE)
    assert {"needle.containment", "needle.clearance.fissure"} <= refusals(plan, crossed)
    ignoring = tools.changed(plan, fissures_are_obstacles=False)
    assert "patient.fissures" in refusals(ignoring, crossed)


def test_vessel_on_the_exempt_wall_is_not_exempt(plan: Plan, lung: Any, tools: Any) -> None:
    out = plan.tube.exit.point_lps
    found = refusals(plan, blob(tools, lung, out - [0, 2, 0], out + [0, 2, 0], 1.2, structures.VESSEL))
    assert "tube.clearance.vessel" in found


def test_wall_that_belongs_to_another_branch(plan: Plan, lung: Any, tools: Any) -> None:
    out = plan.tube.exit.point_lps

    def edit(labels: np.ndarray, points: np.ndarray) -> None:
        near = tools.capsule(points, out, out + [0, 0, 1e-3], 3.0)
        wall = near & ((labels & structures.AIRWAY) != 0) & ((labels & structures.LUMEN) == 0)
        labels[wall] = structures.AIRWAY | (3 << structures.BRANCH_SHIFT)

    assert {"tube.clearance.airway", "tube.containment"} & refusals(plan, tools.relabelled(lung, edit))


def test_tube_that_enters_another_lumen(plan: Plan, lung: Any, tools: Any) -> None:
    tip = plan.tube.lps_from_tip[:3, 3] - 0.8 * plan.tube.lps_from_tip[:3, 2]
    bits = structures.AIRWAY | structures.LUMEN | (2 << structures.BRANCH_SHIFT)
    found = refusals(plan, blob(tools, lung, tip, tip + [0, 0, 1e-3], 1.2, bits))
    assert {"tube.one_exit", "needle.not_in_lumen", "needle.clearance.lumen"} & found


def test_a_turn_in_place_that_touches_the_wall_and_comes_back(plan: Plan, lung: Any, tools: Any) -> None:
    """Before and behind it all is as it was, and so is the body at the end."""
    states = plan.scope.states
    n = len(states) // 2
    away = states[n] + [0.0, 0.0, -1.2]
    wrong = tools.changed(plan, scope__states=np.insert(states, n + 1, [away, states[n]], axis=0))
    assert refusals(wrong, lung) == {"scope.fits", "scope.margin"}


def test_a_scope_that_advances_and_turns_at_once(plan: Plan, lung: Any, tools: Any) -> None:
    states = plan.scope.states
    both = states.copy()
    both[1:, 2] += np.where(states[1:, 0] > 0.0, 1e-4, 0.0)
    assert "scope.states.one_at_a_time" in refusals(tools.changed(plan, scope__states=both), lung)


def test_a_scope_that_draws_back(plan: Plan, lung: Any, tools: Any) -> None:
    states = plan.scope.states
    n = len(states) // 2
    back = states[n] - [0.5, 0.0, 0.0]
    wrong = tools.changed(plan, scope__states=np.insert(states, n + 1, [back, states[n]], axis=0))
    assert refusals(wrong, lung) == {"scope.states.forward"}


def test_a_motion_that_begins_far_down_the_airway(plan: Plan, lung: Any, tools: Any) -> None:
    scope = plan.scope
    base = scope.lps_from_entry @ np.array(
        [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 40.0], [0, 0, 0, 1]], dtype=float
    )
    found = refusals(tools.changed(plan, scope__lps_from_entry=base), lung)
    assert {"scope.start", "scope.tip.position"} <= found


def test_airway_too_narrow_for_the_scope(plan: Plan, lung: Any, tools: Any) -> None:
    point = plan.curves().scope.points_lps[-6] + [0.0, 2.4, 0.0]

    def edit(labels: np.ndarray, _: np.ndarray) -> None:
        at = tuple(np.rint(lung.grid.ijk(point)).astype(int))
        labels[at] &= ~np.uint16(structures.LUMEN)

    assert "scope.fits" in refusals(plan, tools.relabelled(lung, edit))

"""What stands in the way of a needle, on scenes whose answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.grid import Grid
from anatomy.kernels.arcs import any_normal
from anatomy.structures import AIRWAY, BRANCH_SHIFT, LUMEN, VESSEL
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, begun_at_wall, environment_of_labels
from stages.needle.infeasibility.certificate import NoPathProof
from stages.needle.kernels.proof import WALL_ZONE_MM, blocker_on_arc, exact_gap
from stages.needle.obstruction import blocked_end, easiest_obstruction, find_obstruction
from stages.needle.path import Query

GRID = Grid.from_spacing((61, 61, 61), (0.5, 0.5, 0.5), (-15.0, -15.0, -15.0))
NEEDLE = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 20)
X = GRID.lps(np.stack(np.meshgrid(*[np.arange(61)] * 3, indexing="ij"), axis=-1).astype(float))
AIR = np.uint16(AIRWAY | LUMEN)


def scene(**parts: np.ndarray) -> np.ndarray:
    """Return labels with an airway along z, radius 2 mm about x = -6: branch 0 below z = 0, 1 above."""
    labels = np.zeros(GRID.shape, dtype=np.uint16, order="F")
    lumen = (X[..., 0] + 6.0) ** 2 + X[..., 1] ** 2 <= 4.0
    labels[lumen & (X[..., 2] < 0.0)] = AIR | np.uint16(1 << BRANCH_SHIFT)
    labels[lumen & (X[..., 2] >= 0.0)] = AIR | np.uint16(2 << BRANCH_SHIFT)
    for where in parts.values():
        labels[where] |= np.uint16(VESSEL)
    return labels


def at_wall(labels: np.ndarray, branches: tuple[int, ...] = (0,), **needle: float) -> NeedleEnvironment:
    environment = environment_of_labels(
        labels, GRID, Needle(diameter_mm=1.0, **({"max_curvature_per_mm": 1 / 20} | needle)),
        required_clearance_mm=1.0,
    )  # fmt: skip
    return begun_at_wall(environment, (-4.0, 0.0, -8.0), branches)


def start(angle_deg: float, z: float = -8.0, x: float = -3.7) -> np.ndarray:
    """Return a pose just outside the wall, at an angle to it."""
    frame = np.eye(4)
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    frame[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
    frame[:3, 3] = x, 0.0, z
    return frame


def straight_blocker(
    environment: NeedleEnvironment, frame: np.ndarray, length: float, branch: int = 0
) -> int:
    pose = tuple(float(v) for v in (*frame[:3, 3], *frame[:3, 2]))
    bend = (0.0, *any_normal(*pose[3:]))
    return int(blocker_on_arc(environment.obstacles, environment.limits, pose, bend, length, 0.0, branch))


@pytest.mark.parametrize(("angle_deg", "leaves"), [(60.0, True), (30.0, True), (3.0, False), (-20.0, False)])
def test_a_needle_that_begins_at_the_wall_has_to_leave_it(angle_deg: float, leaves: bool) -> None:
    environment = at_wall(scene())
    label = straight_blocker(environment, start(angle_deg), 8.0)
    assert (label == 0) == leaves
    assert leaves or label & LUMEN


def test_from_a_tube_the_rule_is_the_radius() -> None:
    from_tube = environment_of_labels(scene(), GRID, NEEDLE, required_clearance_mm=1.0)
    assert straight_blocker(from_tube, start(60.0), 8.0) & LUMEN
    assert straight_blocker(from_tube, start(60.0, x=-2.8), 8.0) == 0


def test_the_rule_at_the_wall_in_numbers() -> None:
    environment = at_wall(scene())
    for inserted, kept in ((0.0, None), (WALL_ZONE_MM, 0.0), (2.0, math.sin(math.radians(10.0))), (4.5, 0.5)):
        _gap, label, distance, needed = exact_gap(
            environment.obstacles, environment.limits, inserted, -3.9, 0.0, -8.0, 0
        )
        if kept is None:
            assert label == 0
        else:
            assert needed == pytest.approx(kept) and distance < 0.5 and label & LUMEN
    assert exact_gap(environment.obstacles, environment.limits, 5.0, -3.9, 0.0, -8.0, 0)[3] == 1.0


def test_another_branch_counts_unless_it_is_pierced_too() -> None:
    frame = start(60.0, z=-0.3)
    alone = at_wall(scene())
    assert straight_blocker(alone, frame, 8.0) >> BRANCH_SHIFT == 2
    joined = begun_at_wall(alone, (-3.7, 0.0, -0.3), (0, 1))
    assert straight_blocker(joined, frame, 8.0) == 0
    assert straight_blocker(joined, start(3.0, z=-0.3), 8.0) & LUMEN
    assert (alone.obstacles.labels >> BRANCH_SHIFT == 2).any(), "the environment before is as it was"


def test_the_proof_knows_what_is_kept_from_the_lumen_of_the_pierced_branch() -> None:
    """Its wall is exempt in the exit; a path through its lumen is none."""
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 60, exit_exemption_mm=20.0)
    from_tube = environment_of_labels(scene(), GRID, needle, required_clearance_mm=1.0)
    back = start(-90.0, x=4.0)
    for aim, outcome in (((-12.0, 0.0, -8.0), "no path"), ((-3.2, 0.0, -8.0), "undecided")):
        query = Query(lps_from_start=back, target=np.array(aim), branch=0)
        assert blocked_end(from_tube, query) is None
        assert NoPathProof(from_tube, query).run() == outcome
        assert (straight_blocker(from_tube, back, 4.0 - aim[0]) == 0) == (outcome == "undecided")


def test_a_path_keeps_clear_of_what_lies_beyond_the_grid() -> None:
    """The outermost voxels count as outside, whatever they hold."""
    environment = environment_of_labels(scene(), GRID, NEEDLE, required_clearance_mm=1.0)
    for aside, free in ((1.6, True), (1.2, False)):
        frame = start(0.0, x=15.25 - aside)
        assert (straight_blocker(environment, frame, 10.0, -1) == 0) == free


def test_start_target_and_path_are_told_apart() -> None:
    aim = np.array([4.0, 0.0, 8.0])
    ball = np.linalg.norm(X - aim, axis=-1) <= 1.0
    beside = (np.abs(X[..., 0] + 2.2) < 0.3) & (np.abs(X[..., 1]) < 9.0) & (np.abs(X[..., 2] + 7.0) < 1.0)
    wall = np.abs(X[..., 2] - 2.0) < 0.3
    for expected, labels in (
        ("start", scene(block=beside)), ("target", scene(block=ball)), ("path", scene(block=wall)),
        ("", scene()),
    ):  # fmt: skip
        environment = at_wall(labels)
        query = Query(lps_from_start=start(40.0), target=aim, branch=0)
        found = find_obstruction(environment, query)
        proof = NoPathProof(environment, query)
        if expected in ("start", "target"):
            assert found is not None and found.place == expected and found.proved
            assert found.label & VESSEL
            assert found.distance_mm is not None and found.needed_mm == 1.0 > found.distance_mm
            assert found.obstacle_lps is not None
            measured = np.linalg.norm(found.obstacle_lps - found.point_lps)
            assert measured == pytest.approx(found.distance_mm, abs=1e-6)
            proof.run()
            assert proof.outcome == "no path" and expected in proof.reason
            continue
        assert found is None
        tightest = easiest_obstruction(environment, query)
        if expected == "path":
            assert tightest is not None and tightest.label & VESSEL and not tightest.proved
            assert tightest.distance_mm == 0.0
            assert tightest.point_lps[2] == pytest.approx(2.0, abs=0.6)


@pytest.mark.parametrize("tolerance", [0.0, 1.0])
def test_reach_names_limit_and_radius(tolerance: float) -> None:
    environment = environment_of_labels(
        np.zeros_like(scene()), GRID, NEEDLE, required_clearance_mm=1.0, goal_tolerance_mm=tolerance
    )
    frame = np.eye(4)
    found = find_obstruction(environment, Query(lps_from_start=frame, target=np.array([6.0, 0.0, 8.0])))
    assert found is not None and (found.place, found.limit, found.proved) == ("reach", "radius", True)
    # The circle through the start, and through the nearest point of the tolerance's ball, bends most.
    expected = (36.0 + 64.0 - tolerance**2) / (2.0 * (6.0 - tolerance))
    assert found.radius_mm == pytest.approx(expected, rel=1e-4)
    behind = find_obstruction(environment, Query(lps_from_start=frame, target=np.array([6.0, 0.0, -2.0])))
    assert behind is not None and (behind.limit, behind.radius_mm) == ("angle", None)
    assert behind.proved


@pytest.mark.slow
def test_a_start_that_is_blocked_has_no_path_for_any_search() -> None:
    """Of the places that are called blocked, none is passed by random arcs from there."""
    rng = np.random.default_rng(0)
    blocked = 0
    for _ in range(60):
        balls = rng.uniform((-5.0, -5.0, -9.0), (5.0, 5.0, 2.0), (12, 3))
        where = (np.linalg.norm(X[..., None, :] - balls, axis=-1) <= 1.0).any(axis=-1)
        environment = at_wall(scene(block=where))
        frame = start(float(rng.uniform(20.0, 70.0)))
        query = Query(lps_from_start=frame, target=np.array([6.0, 0.0, 4.0]), branch=0)
        found = find_obstruction(environment, query)
        if found is None or found.place != "start" or found.inserted_mm is None:
            continue
        blocked += 1
        pose = tuple(float(v) for v in (*frame[:3, 3], *frame[:3, 2]))
        for kappa, phi in rng.uniform((0.0, 0.0), (1 / 20, 2 * math.pi), (40, 2)):
            normal = math.cos(phi) * frame[:3, 0] + math.sin(phi) * frame[:3, 1]
            bend = (float(kappa), *(float(v) for v in normal))
            length = found.inserted_mm + 0.1
            arc = blocker_on_arc(environment.obstacles, environment.limits, pose, bend, length, 0.0, 0)
            assert arc != 0
    assert blocked > 5

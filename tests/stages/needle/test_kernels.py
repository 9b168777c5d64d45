"""The needle's workspace, the proof of clearance, the direct arc and the RRT against brute force."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.structures import AIRWAY, BRANCH_SHIFT, LUMEN, OBSTACLES, OUTSIDE, VESSEL
from anatomy.typed import Float
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, direct_arcs, needle_environment, workspace_lengths
from stages.needle.kernels import connections, proof, rrt, tree
from stages.needle.kernels import cost as cost_kernels
from stages.needle.kernels.limits import Limits
from stages.needle.objective import SHORTEST
from stages.needle.path import ArcPath, blocker_on_path, path_from_tree
from tests.stages.scenes import Canvas, brute_clearance, line_tree, lung_of

RADIUS = 50.0


def limits_of(**values: float) -> Limits:
    """Limits of a needle of 50 mm radius, 90 and 180 degrees, 150 mm."""
    needle = {
        "kappa": 1 / RADIUS,
        "max_length_mm": 150.0,
        "max_angle_rad": math.pi / 2,
        "max_turn_rad": math.pi,
    }
    return Limits(**dict.fromkeys(Limits._fields, 0.0) | needle | values)


class TestWorkspace:
    """The set of points that the needle reaches in free space."""

    def test_straight_ahead(self) -> None:
        assert connections.workspace_length(0.0, 40.0, limits_of()) == 40.0
        assert connections.workspace_length(0.0, 0.0, limits_of()) == 0.0

    def test_quarter_circle(self) -> None:
        assert connections.workspace_length(RADIUS, RADIUS, limits_of()) == pytest.approx(
            math.pi * RADIUS / 2
        )

    @pytest.mark.parametrize("limit", ["max_angle_rad", "max_turn_rad"])
    def test_either_turning_limit_cuts_the_quarter_circle_off(self, limit: str) -> None:
        assert (
            connections.workspace_length(RADIUS, RADIUS, limits_of(**{limit: math.radians(89.9)})) == math.inf
        )

    def test_length_limit(self) -> None:
        quarter = math.pi * RADIUS / 2
        within, beyond = limits_of(max_length_mm=quarter + 1e-6), limits_of(max_length_mm=quarter - 1e-6)
        assert connections.workspace_length(RADIUS, RADIUS, within) < math.inf
        assert connections.workspace_length(RADIUS, RADIUS, beyond) == math.inf
        assert connections.workspace_length(0.0, 40.0, limits_of(max_length_mm=39.9)) == math.inf

    def test_quarter_circle_then_straight(self) -> None:
        found = connections.workspace_length(RADIUS + 30.0, RADIUS, limits_of())
        assert found == pytest.approx(math.pi * RADIUS / 2 + 30.0)

    @pytest.mark.parametrize("rho", [0.0, 1e-6, 5.0, 60.0, 120.0])
    def test_behind_is_out_of_reach(self, rho: float) -> None:
        assert connections.workspace_length(rho, -1.0, limits_of()) == math.inf

    def test_inside_the_tightest_circle_only_a_path_of_more_than_half_a_turn_leads(self) -> None:
        assert connections.workspace_length(RADIUS, 10.0, limits_of(max_length_mm=500.0)) == math.inf
        wide = limits_of(max_angle_rad=math.pi, max_turn_rad=3 * math.pi, max_length_mm=500.0)
        assert math.pi * RADIUS < connections.workspace_length(RADIUS, 10.0, wide) < 2.5 * math.pi * RADIUS

    @given(angle=st.floats(1e-3, math.pi / 2), share=st.floats(0.05, 1.0))
    def test_ends_of_arcs_within_the_limits_are_in(self, angle: float, share: float) -> None:
        """Also those of the tightest arc, where rounding decides."""
        radius = RADIUS / share
        length = radius * angle
        found = connections.workspace_length(
            radius * (1 - math.cos(angle)), radius * math.sin(angle), limits_of(max_length_mm=length + 1e-9)
        )
        assert found <= length + 1e-9

    def test_is_the_shortest_of_all_arcs_followed_by_straight_lines(self) -> None:
        """Against a dense family of them, for points all over the half plane."""
        rng = np.random.default_rng(1)
        limits = limits_of(max_angle_rad=math.radians(70.0), max_length_mm=120.0)
        angle = np.linspace(0.0, math.radians(70.0), 20001)
        for rho, h in rng.uniform([0.0, -20.0], [110.0, 120.0], (400, 2)):
            found = connections.workspace_length(rho, h, limits)
            x, z = RADIUS * (1 - np.cos(angle)), RADIUS * np.sin(angle)
            ahead = (rho - x) * np.sin(angle) + (h - z) * np.cos(angle)
            miss = np.abs((rho - x) * np.cos(angle) - (h - z) * np.sin(angle))
            hit = (ahead >= -0.005) & (miss < 0.01)
            length = float(np.min((RADIUS * angle + ahead)[hit], initial=math.inf))
            if math.isfinite(found):
                assert length == pytest.approx(found, abs=0.5), (rho, h)
            else:
                assert length > 120.0 - 0.5, (rho, h)

    def test_no_curve_leads_out_of_it(self) -> None:
        """Ends of random curves within the limits lie inside, and the shortest path is no longer."""
        rng = np.random.default_rng(2)
        max_angle, max_turn = math.radians(80.0), math.radians(150.0)
        limits = limits_of(max_angle_rad=max_angle, max_turn_rad=max_turn)
        tested = 0
        for _ in range(3000):
            curvature = rng.choice([0.0, 1.0, rng.uniform()], 5) / RADIUS
            length = rng.uniform(0.5, 28.0, 5)
            # Half of the curves keep to one plane, where they get farthest aside.
            roll = rng.uniform(-np.pi, np.pi, 5) if rng.uniform() < 0.5 else np.array([0.3, 0, 0, 0, 0])
            path = ArcPath(lps_from_start=np.eye(4), arcs=np.column_stack([length, roll, curvature]))
            if path.max_angle_from_start_rad() > max_angle or path.accumulated_turn_rad > max_turn:
                continue
            tested += 1
            x, y, z = path.frames()[-1][:3, 3]
            assert connections.workspace_length(math.hypot(x, y), z, limits) <= path.length_mm + 1e-6, (
                path.arcs
            )
        assert tested > 1000

    @given(
        forward=st.floats(-1.0, 1.0),
        phase=st.floats(0.0, 2 * math.pi),
        turn=st.floats(0.0, 2 * math.pi - 1e-3),
    )
    def test_largest_angle_along_an_arc(self, forward: float, phase: float, turn: float) -> None:
        aside = math.sqrt(1 - forward**2) * math.cos(phase)
        a = np.linspace(0.0, turn, 4001)
        dense = float((forward * np.cos(a) + aside * np.sin(a)).min())
        assert dense - 1e-5 <= connections.least_cosine(forward, aside, turn) <= dense + 1e-12


SPACINGS = st.tuples(*[st.sampled_from([0.5, 0.6, 0.8, 1.1])] * 3)
N = 22


@st.composite
def crowded_environments(draw: Any) -> tuple[Lung, Limits, tuple[float, ...], tuple[float, ...], float]:
    """A small volume with obstacles strewn about, limits, and an arc that begins near its middle."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    spacing = np.array(draw(SPACINGS))
    canvas = Canvas.empty(-0.5 * N * spacing, 0.5 * N * spacing, spacing)
    kinds = [VESSEL, OUTSIDE, AIRWAY | (1 << BRANCH_SHIFT), AIRWAY | (2 << BRANCH_SHIFT)]
    kinds += [k | LUMEN for k in kinds[2:]] + [kinds[2] | VESSEL]
    for _ in range(draw(st.integers(0, 12))):
        corner = rng.integers(0, N - 1, 3)
        size = rng.integers(1, 3, 3)
        canvas.labels[tuple(slice(a, a + b) for a, b in zip(corner, size, strict=True))] = rng.choice(kinds)
    canvas.labels[tuple(rng.integers(8, 14, 3))] = 0
    lung = lung_of(canvas.labels, canvas.grid, line_tree([0, 0, 0], [0, 0, 1], 1.0))
    radius = draw(st.sampled_from([0.1, 0.3, 0.5]))
    required = radius + draw(st.sampled_from([0.0, 0.3, 0.6]))
    exempt = draw(st.sampled_from([0.0, 1.0, 3.3]))
    limits = limits_of(required_mm=required, radius_mm=radius, exempt_mm=exempt)
    start = np.concatenate([rng.uniform(-2.0, 2.0, 3), np.zeros(3)])
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    start[3:] = frame[0]
    bend = (float(rng.choice([0.0, 0.01, 0.1])), *(float(v) for v in frame[1]))
    return lung, limits, tuple(float(v) for v in start), bend, float(rng.uniform(0.0, 6.0))


def points_of_arc(pose: Any, bend: Any, length: float, step: float) -> tuple[Float, Float]:
    """Points along an arc and their arc lengths, from the plane geometry of a circle."""
    s = np.linspace(0.0, length, max(2, math.ceil(length / step) + 1))
    kappa = bend[0]
    ahead = np.sin(kappa * s) / kappa if kappa else s
    aside = (1 - np.cos(kappa * s)) / kappa if kappa else 0.0 * s
    return (np.array(pose[:3]) + ahead[:, None] * np.array(pose[3:]) + aside[:, None] * np.array(bend[1:]), s)


def spare_clearance(lung: Lung, limits: Limits, points: Float, s: Float, branch: int) -> float:
    """The least clearance beyond what is required at the points, voxels as solid boxes, by the rules."""
    required = limits.required_mm
    cap = required + 1.0
    in_exit = (s < limits.exempt_mm) & (branch >= 0)

    def distance(where: Any, bits: int, exempt: int = -1) -> Float:
        return brute_clearance(lung.labels, lung.grid, points[where], bits, cap, exempt)

    spare = [distance(~in_exit, OBSTACLES) - required] if (~in_exit).any() else []
    if in_exit.any():
        spare.append(distance(in_exit, OBSTACLES, branch) - required)
        spare.append(distance(in_exit, LUMEN) - limits.radius_mm)
    return float(np.concatenate(spare).min())


class TestBlocker:
    """`blocker_on_arc` is a proof: it neither passes a blocked arc nor refuses a clear one."""

    @given(scene=crowded_environments())
    @settings(max_examples=150)
    def test_without_exemption(self, scene: Any) -> None:
        lung, limits, pose, bend, length = scene
        label = proof.blocker_on_arc(arrays(lung), limits, pose, bend, length, 0.0, -1)
        points, s = points_of_arc(pose, bend, length, 0.02)
        spare = spare_clearance(lung, limits, points, s, -1)
        if label == 0:
            assert spare >= -1e-9
        else:
            assert spare < 0.01 + 0.01

    @given(
        scene=crowded_environments(), begun=st.sampled_from([0.0, 0.5, 2.0]), branch=st.sampled_from([0, 1])
    )
    @settings(max_examples=150)
    def test_with_exemption(self, scene: Any, begun: float, branch: int) -> None:
        lung, limits, pose, bend, length = scene
        label = proof.blocker_on_arc(arrays(lung), limits, pose, bend, length, begun, branch)
        points, s = points_of_arc(pose, bend, length, 0.02)
        spare = spare_clearance(lung, limits, points, s + begun, branch)
        if label == 0:
            assert spare >= -1e-9
        elif spare >= 0.01 + 0.01:
            # The end of the exemption falls between two samples: only there may the kernel know better.
            edge = limits.exempt_mm - begun
            assert 0.0 <= edge <= length
            at = points_of_arc(pose, bend, max(edge, 1e-9), 1e9)[0][-1:]
            assert spare_clearance(lung, limits, at, np.array([np.inf]), branch) < 0.01

    def test_the_label_is_that_of_a_voxel_in_the_way(self) -> None:
        canvas = Canvas.empty([-10, -10, -10], [10, 10, 10], 0.5)
        canvas.add(canvas.ball([0, 0, 5], 1.0), VESSEL)
        lung = canvas.lung()
        limits = limits_of(required_mm=1.0, radius_mm=0.5)
        bend = (0.0, 1.0, 0.0, 0.0)
        assert proof.blocker_on_arc(arrays(lung), limits, (0, 0, 0, 0, 0, 1.0), bend, 8.0, 0.0, -1) == VESSEL
        assert proof.blocker_on_arc(arrays(lung), limits, (0, 0, 0, 0, 0, 1.0), bend, 2.0, 0.0, -1) == 0
        assert (
            proof.blocker_on_arc(arrays(lung), limits, (5.0, 0, 0, 0, 0, 1.0), bend, 9.5, 0.0, -1) == OUTSIDE
        )

    @pytest.mark.parametrize("start", [(0.0, 0.0, 11.0), (math.nan, 0.0, 0.0)])
    def test_no_start_outside_the_grid(self, start: tuple[float, float, float]) -> None:
        lung = Canvas.empty([-10, -10, -10], [10, 10, 10], 1.0).lung()
        pose = (*start, 0.0, 0.0, 1.0)
        limits = limits_of(required_mm=1.0)
        assert proof.blocker_on_arc(arrays(lung), limits, pose, (0.0, 1.0, 0.0, 0.0), 1.0, 0.0, -1) == OUTSIDE


class TestExemption:
    """The needle starts in the wall of the pierced airway: only that wall, only at first."""

    @staticmethod
    def label(begun: float = 0.0, branch: int = 0, length: float = 5.0, **limits: float) -> int:
        """Go along +z in the wall (x from -1 to 2) of an airway whose lumen ends at x = -1."""
        canvas = Canvas.empty([-10, -10, -10], [10, 10, 10], 0.5)
        x = canvas.points[..., 0]
        canvas.airway(x < -1, x < 2, 0)
        lung = canvas.lung()
        values = limits_of(required_mm=0.9, radius_mm=0.4, exempt_mm=5.0, **limits)
        pose, bend = (0.0, 0, 0, 0, 0, 1.0), (0.0, 1.0, 0, 0)
        return int(proof.blocker_on_arc(arrays(lung), values, pose, bend, length, begun, branch))

    def test_the_wall_is_exempt_at_first(self) -> None:
        assert self.label(length=4.9) == 0

    def test_but_not_longer(self) -> None:
        assert self.label(length=5.1) & AIRWAY
        assert self.label(begun=3.0, length=2.1) & AIRWAY
        assert self.label(begun=3.0, length=1.9) == 0

    def test_nor_the_wall_of_another_branch(self) -> None:
        assert self.label(branch=1) & AIRWAY
        assert self.label(branch=-1) & AIRWAY

    def test_the_lumen_is_never_nearer_than_the_radius(self) -> None:
        canvas = Canvas.empty([-10, -10, -10], [10, 10, 10], 0.5)
        x = canvas.points[..., 0]
        canvas.airway(x < -1, x < 4, 0)
        environment = arrays(canvas.lung())
        values = limits_of(required_mm=0.9, radius_mm=0.4, exempt_mm=5.0)
        for gap, clear in ((0.41, True), (0.39, False)):
            pose = (-1.0 + gap, 0.0, 0.0, 0.0, 0.0, 1.0)
            label = proof.blocker_on_arc(environment, values, pose, (0.0, 1.0, 0, 0), 3.0, 0.0, 0)
            assert (label == 0) == clear
            assert clear or label & LUMEN

    def test_never_a_vessel_even_if_marked_as_wall_too(self) -> None:
        canvas = Canvas.empty([-10, -10, -10], [10, 10, 10], 0.5)
        x = canvas.points[..., 0]
        canvas.airway(x < -1, x < 2, 0)
        canvas.add(canvas.ball([0.0, 0.0, 3.0], 0.6), VESSEL)
        values = limits_of(required_mm=0.9, radius_mm=0.4, exempt_mm=5.0)
        pose = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        label = proof.blocker_on_arc(arrays(canvas.lung()), values, pose, (0.0, 1.0, 0, 0), 4.0, 0.0, 0)
        assert label & VESSEL


def arrays(lung: Lung) -> proof.Obstacles:
    """What the kernels look at, without fissures."""
    field = lung.fields["obstacle"]
    return proof.Obstacles(field.corners, lung.labels, field.geometry, OBSTACLES)


def ball_environment(**changes: float) -> NeedleEnvironment:
    """Free lung with a vessel ball in the middle of the way from (0, 0, -28) to (0, 0, 28)."""
    canvas = Canvas.empty([-32, -32, -32], [32, 32, 32], 1.0)
    canvas.add(canvas.ball([0, 0, 0], 4.0), VESSEL)
    values: dict[str, float] = {"diameter_mm": 1.0, "max_curvature_per_mm": 1 / 30, **changes}
    return needle_environment(canvas.lung(), Needle(**values), Margins(), with_fissures=False)


GOAL = np.array([0.0, 0.0, 28.0])
OBJECTIVE = SHORTEST.arrays(None)
START = np.array([0.0, 0.0, -28.0, 0.0, 0.0, 1.0])


def grow(
    environment: NeedleEnvironment,
    seed: int = 5,
    goal: Float = GOAL,
    iterations: int = 20000,
    size: int = 20000,
) -> tuple[Float, np.ndarray, int, int, bool]:
    """Run the RRT from START."""
    nodes, parents = np.zeros((size, tree.NODE_COLUMNS)), np.zeros(size, dtype=np.int64)
    nodes[0, :6] = START
    state = np.array([seed], dtype=np.uint64)
    count, used, solved = rrt.grow_rrt(
        environment.obstacles,
        environment.limits,
        OBJECTIVE,
        -1,
        goal,
        nodes,
        parents,
        1,
        iterations,
        0.5,
        state,
        math.inf,
    )
    return nodes[:count], parents[:count], count, used, solved


def start_frame() -> Float:
    frame = np.eye(4)
    frame[:3, 3] = START[:3]
    return frame


class TestDirectArcs:
    """Many starts at once."""

    def test_every_outcome(self) -> None:
        environment = ball_environment()
        positions = np.array([[0.0, 0, -28], [20, 0, -28], [0, 0, 20], [0, 0, 30], [0, 0, 28]])
        tangents = np.array([[0.0, 0, 1], [0, 0, 1], [1, 0, 0], [0, 0, 1], [0, 0, 1]])
        blockers, lengths, cost = direct_arcs(environment, positions, tangents, np.full(5, -1), GOAL)
        assert blockers[0] == VESSEL
        assert blockers[1] == 0
        assert blockers[2] == blockers[3] == -1, "too tight; straight behind"
        assert blockers[4] == 0 and lengths[4] == 0.0
        chord = math.hypot(20, 56)
        half = math.atan2(20, 56)
        assert lengths[1] == pytest.approx(chord * half / math.sin(half))
        assert lengths[3] == math.inf
        assert 56 / 32 < cost[1] < 56 / 3

    def test_the_turning_limits_hold_for_single_arcs(self) -> None:
        half = math.atan2(20, 56)
        start = np.array([[20.0, 0, -28]])
        for name in ("max_angle_from_start_deg", "max_accumulated_turn_deg"):
            for over, outcome in ((0.1, 0), (-0.1, -1)):
                environment = ball_environment(**{name: math.degrees(2 * half) + over})
                found = direct_arcs(environment, start, np.array([[0.0, 0, 1]]), np.array([-1]), GOAL)[0]
                assert found[0] == outcome

    def test_where_an_arc_exists_the_workspace_holds_the_target(self) -> None:
        environment = ball_environment()
        rng = np.random.default_rng(0)
        positions = rng.uniform(-30, 30, (3000, 3))
        tangents = rng.normal(size=(3000, 3))
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        blockers, lengths, _ = direct_arcs(environment, positions, tangents, np.full(3000, -1), GOAL)
        shortest = workspace_lengths(environment, positions, tangents, GOAL)
        arc = blockers != -1
        assert arc.sum() > 100
        assert (shortest[arc] <= lengths[arc] + 1e-9).all()

    def test_the_estimated_cost_of_a_clear_arc_beside_a_wall(self) -> None:
        """Straight along a flat pleura at 5 mm for 20 mm: 20 / 5."""
        canvas = Canvas.empty([-20, -20, -20], [20, 20, 20], 1.0)
        canvas.add(canvas.points[..., 0] < -5, OUTSIDE)
        environment = needle_environment(
            canvas.lung(), Needle(diameter_mm=1.0, max_curvature_per_mm=0.01), Margins(), with_fissures=False
        )
        cost = cost_kernels.inverse_clearance_on_arc(
            environment.obstacles, 0.5, (0.0, 0, -10, 0, 0, 1.0), (0.0, 1.0, 0, 0), 20.0
        )
        assert cost == pytest.approx(4.0, rel=5e-3)


class TestRrt:
    """The RRT goes around what blocks the direct arc."""

    def test_goes_around_the_ball(self) -> None:
        environment = ball_environment()
        blockers, _, _ = direct_arcs(environment, START[None, :3], START[None, 3:], np.array([-1]), GOAL)
        assert blockers[0] == VESSEL
        nodes, parents, count, used, solved = grow(environment)
        assert solved and used > 0
        path = path_from_tree(start_frame(), nodes, parents, count - 1)
        assert len(path.arcs) >= 2
        assert np.linalg.norm(path.frames()[-1][:3, 3] - GOAL) < 1e-6
        assert blocker_on_path(environment, path, -1) == 0
        points, _ = path.sample(0.02)
        gap = brute_clearance(environment.obstacles.labels, environment.grid, points, OBSTACLES, 2.0)
        assert gap.min() >= environment.required_clearance_mm - 1e-6

    @pytest.mark.parametrize(
        "changes",
        [
            {},
            {"max_angle_from_start_deg": 28.0},
            {"max_accumulated_turn_deg": 75.0},
            {"max_length_mm": 60.0},
            {"max_curvature_per_mm": 0.05, "max_angle_from_start_deg": 180.0},
        ],
    )
    def test_every_node_is_within_the_limits(self, changes: dict[str, float]) -> None:
        environment = ball_environment(**changes)
        needle = environment.needle
        solutions = 0
        for seed in range(3):
            nodes, parents, count, _, solved = grow(environment, seed)
            solutions += solved
            for last in range(1, count):
                path = path_from_tree(start_frame(), nodes, parents, last)
                end = path.frames()[-1]
                assert np.linalg.norm(end[:3, 3] - nodes[last, :3]) < 1e-9
                assert np.linalg.norm(end[:3, 2] - nodes[last, 3:6]) < 1e-9
                assert path.length_mm == pytest.approx(nodes[last, tree.PATH_LENGTH])
                assert path.accumulated_turn_rad == pytest.approx(nodes[last, tree.PATH_TURN])
                assert path.arcs[:, 2].max() <= needle.max_curvature_per_mm + 1e-12
                assert path.length_mm <= needle.max_length_mm + 1e-9
                assert path.accumulated_turn_rad <= math.radians(needle.max_accumulated_turn_deg) + 1e-9
                assert path.max_angle_from_start_rad() <= math.radians(needle.max_angle_from_start_deg) + 1e-7
        assert solutions > 0

    def test_the_same_seed_grows_the_same_tree(self) -> None:
        environment = ball_environment()
        first, again, other = (grow(environment, seed) for seed in (11, 11, 12))
        assert np.array_equal(first[0], again[0])
        assert np.array_equal(first[1], again[1])
        assert first[0].shape != other[0].shape or not np.array_equal(first[0], other[0])

    def test_slices_grow_the_same_tree_as_one_run(self) -> None:
        environment = ball_environment(max_length_mm=57.5)
        whole = grow(environment, 3, iterations=4000)
        nodes, parents = np.zeros((20000, tree.NODE_COLUMNS)), np.zeros(20000, dtype=np.int64)
        nodes[0, :6] = START
        state = np.array([3], dtype=np.uint64)
        count, used, solved = 1, 0, False
        while used < 4000 and not solved:
            count, spent, solved = rrt.grow_rrt(
                environment.obstacles,
                environment.limits,
                OBJECTIVE,
                -1,
                GOAL,
                nodes,
                parents,
                count,
                min(77, 4000 - used),
                0.5,
                state,
                math.inf,
            )
            used += spent
        assert used == whole[3]
        assert count == whole[2]
        assert np.array_equal(nodes[:count], whole[0])

    def test_a_goal_that_cannot_be_reached(self) -> None:
        _, _, _, used, solved = grow(ball_environment(), goal=np.array([0.0, 0.0, -31.0]), iterations=500)
        assert used == 500 and not solved
        _, _, _, used, solved = grow(ball_environment(), goal=np.array([0.0, 0.0, 0.0]), iterations=500)
        assert used == 500 and not solved, "in the vessel"

    def test_a_goal_at_the_start_and_a_full_tree_end_the_search(self) -> None:
        _, _, count, used, solved = grow(ball_environment(), goal=START[:3].copy(), iterations=500)
        assert (count, used, solved) == (1, 0, False)
        _, _, count, used, solved = grow(ball_environment(max_length_mm=57.5), iterations=50000, size=6)
        assert count <= 6 and used < 50000 and not solved

    def test_goals_more_than_two_radii_away(self) -> None:
        """Where no arc of the tightest curvature joins start and goal."""
        canvas = Canvas.empty([-22, -22, -52], [22, 22, 52], 1.0)
        canvas.add(canvas.ball([0, 0, 0], 5.0), VESSEL)
        needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 40)
        environment = needle_environment(canvas.lung(), needle, Margins(), with_fissures=False)
        nodes, parents = np.zeros((5000, tree.NODE_COLUMNS)), np.zeros(5000, dtype=np.int64)
        nodes[0, :6] = 0.0, 0.0, -46.0, 0.0, 0.0, 1.0
        _, _, solved = rrt.grow_rrt(
            environment.obstacles, environment.limits, OBJECTIVE, -1, np.array([0.0, 0.0, 46.0]), nodes,
            parents, 1, 20000, 0.5, np.array([1], dtype=np.uint64), math.inf,
        )  # fmt: skip
        assert solved

"""Shape, sweep, wall exit and refusals of the tubes, on lungs made of planes, cylinders and balls."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.poses import pose
from anatomy.structures import AIRWAY, BRANCH_SHIFT, FISSURE, LUMEN, OBSTACLES, OUTSIDE, VESSEL
from anatomy.typed import Float
from stages.tube import REASONS, Deployment, DeploymentValidator, kernels, tube_constants, tube_environment
from stages.tube.device import ConcentricTubes, Tube
from tests.stages.scenes import Canvas, brute_clearance, forked_tree

KAPPA = 0.025
CURVED = 40.0


def tubes_of(**changes: float) -> ConcentricTubes:
    """An outer tube of 1.6 mm, an inner one of 1.2 mm with 40 mm of 40 mm radius, any run in the wall."""
    changes.setdefault("max_wall_run_mm", 100.0)
    curved = changes.pop("curved_length_mm", CURVED)
    length = changes.pop("inner_length_mm", 680.0)
    kappa = changes.pop("kappa", KAPPA)
    outer = Tube(outer_diameter_mm=1.6, inner_diameter_mm=1.38, length_mm=640.0)
    inner = Tube(
        outer_diameter_mm=1.2, inner_diameter_mm=1.05, length_mm=length, curved_length_mm=curved,
        precurvature_per_mm=kappa,
    )  # fmt: skip
    return ConcentricTubes(outer=outer, inner=inner, **changes)


TUBES = tubes_of()
NUMBERS = tube_constants(TUBES, Margins())
OVERLAP = float(NUMBERS[kernels.OVERLAP_CURVATURE])
MARGIN = 0.5


def planar_by_steps(outer: float, inner: float, s: float, steps: int = 4000) -> tuple[float, float]:
    """Integrate the curvature along the centreline, midpoint by midpoint."""
    at = (np.arange(steps) + 0.5) * s / steps
    straight = max(inner - CURVED, 0.0)
    kappa = np.where(at < straight, 0.0, np.where(at < outer, OVERLAP, KAPPA))
    angle = np.concatenate([[0.0], np.cumsum(kappa * s / steps)])
    middle = 0.5 * (angle[1:] + angle[:-1])
    return float(np.sin(middle).sum() * s / steps), float(np.cos(middle).sum() * s / steps)


class TestShape:
    """`planar_point` and `lateral_sweep`."""

    def test_the_stiffer_outer_tube_straightens_the_overlap(self) -> None:
        stiffness = [t.outer_diameter_mm**4 - t.inner_diameter_mm**4 for t in (TUBES.inner, TUBES.outer)]
        assert pytest.approx(KAPPA * stiffness[0] / sum(stiffness)) == OVERLAP
        assert 0 < OVERLAP < 0.5 * KAPPA

    def test_inner_tube_alone_is_one_arc(self) -> None:
        aside, ahead = kernels.planar_point(NUMBERS, 0.0, 30.0, 30.0)
        assert aside == pytest.approx((1 - math.cos(0.75)) / KAPPA)
        assert ahead == pytest.approx(math.sin(0.75) / KAPPA)

    def test_covered_wholly_it_is_one_flatter_arc(self) -> None:
        aside, ahead = kernels.planar_point(NUMBERS, 30.0, 30.0, 30.0)
        assert aside == pytest.approx((1 - math.cos(30 * OVERLAP)) / OVERLAP)
        assert ahead == pytest.approx(math.sin(30 * OVERLAP) / OVERLAP)

    def test_beyond_the_curved_length_it_begins_straight(self) -> None:
        assert kernels.planar_point(NUMBERS, 0.0, 55.0, 15.0) == pytest.approx((0.0, 15.0))
        aside, ahead = kernels.planar_point(NUMBERS, 0.0, 55.0, 55.0)
        assert (aside, ahead) == pytest.approx(((1 - math.cos(1.0)) / KAPPA, 15 + math.sin(1.0) / KAPPA))

    def test_without_precurvature_it_is_a_line(self) -> None:
        straight = tube_constants(tubes_of(curved_length_mm=0.0, kappa=0.0), Margins())
        assert kernels.planar_point(straight, 10.0, 30.0, 25.0) == (0.0, 25.0)
        assert kernels.lateral_sweep(straight, 10.0, 50.0) == 0.0

    @given(inner=st.floats(0.0, 60.0), outer=st.floats(0.0, 1.0), s=st.floats(0.0, 1.0))
    def test_agrees_with_integrated_curvature(self, inner: float, outer: float, s: float) -> None:
        found = kernels.planar_point(NUMBERS, outer * inner, inner, s * inner)
        assert found == pytest.approx(planar_by_steps(outer * inner, inner, s * inner), abs=0.02)

    @given(inner=st.floats(0.0, CURVED), outer=st.floats(0.0, 1.0))
    def test_no_sweep_while_the_tip_is_within_the_curved_length(self, inner: float, outer: float) -> None:
        assert kernels.lateral_sweep(NUMBERS, outer * inner, inner) == 0.0

    @given(beyond=st.floats(0.5, 20.0), outer=st.floats(0.0, 1.0))
    @settings(max_examples=40)
    def test_sweep_beyond(self, beyond: float, outer: float) -> None:
        """The straight part pushes the bend ahead, farther the longer it is; against all tips and points."""
        inner = CURVED + beyond
        sweep = kernels.lateral_sweep(NUMBERS, outer * inner, inner)
        assert sweep > 0.0
        assert sweep >= kernels.lateral_sweep(NUMBERS, outer * inner, CURVED + 0.5 * beyond) - 0.02
        worst = 0.0
        for tip in np.linspace(0.0, inner, 61):
            for s in np.linspace(0.0, tip, 61):
                before = kernels.planar_point(NUMBERS, min(tip, outer * inner), tip, s)
                after = kernels.planar_point(NUMBERS, outer * inner, inner, s)
                worst = max(worst, math.dist(before, after))
        assert worst - 1e-3 <= sweep <= worst + 0.25


LOW, HIGH, SPACING = np.array([-12.0, -10.0, -20.0]), np.array([14.0, 10.0, 20.0]), 0.5
BASE = (-3.0, 0.0, -15.0)


def plane_canvas(wall_mm: float = 1.0, spacing: Any = SPACING) -> Canvas:
    """A lumen below x = 0 with a flat wall above."""
    canvas = Canvas.empty(LOW, HIGH, spacing)
    x = canvas.points[..., 0]
    canvas.airway(x < 0, x < wall_mm, 0)
    return canvas


def validated(
    lung: Lung, outer: float = 0.0, inner: float = 30.0, *, base: Any = BASE, tubes: ConcentricTubes = TUBES,
    rotation: float = 0.0, with_fissures: bool = False, forward: Any = (0.0, 0.0, 1.0),
) -> Deployment | str:  # fmt: skip
    """Validate a deployment that bends towards +x."""
    validator = DeploymentValidator(
        lung, tubes, Margins(segmentation_margin_mm=MARGIN), with_fissures=with_fissures
    )
    tip = pose(base, forward, (1.0, 0.0, 0.0))
    return validator.validate(tip, rotation, outer, inner)


CHAIN = forked_tree(
    [([0, 0, 9], [0, 0, 6], 8.0, -1), ([0, 0, 6], [0, 0, 3], 5.0, 0), ([0, 0, 3], [0, 0, 0], 3.0, 1)]
)
"""Trachea, main bronchus, lobar bronchus: the last may be left."""


def accepted(verdict: Deployment | str) -> Deployment:
    assert isinstance(verdict, Deployment), verdict
    return verdict


def arc_to_wall(depth: float, kappa: float = KAPPA) -> float:
    """Length of an arc that starts along a wall `depth` away and ends at it."""
    return math.acos(1 - kappa * depth) / kappa


class TestExit:
    """Where, and at what angle, the axis leaves the lumen."""

    @pytest.mark.parametrize("depth", [1.0, 3.0, 5.3])
    def test_through_a_plane(self, depth: float) -> None:
        found = accepted(validated(plane_canvas().lung(), base=(-depth, 0.1, -15.0)))
        s = arc_to_wall(depth)
        assert found.exit_mm == pytest.approx(s, abs=2e-3)
        assert found.branch == 0
        assert math.degrees(found.wall_angle_rad) == pytest.approx(math.degrees(KAPPA * s), abs=3.0)
        assert found.lateral_sweep_mm == 0.0

    @pytest.mark.parametrize("spacing", [(0.5, 0.5, 0.5), (0.7, 0.6, 0.9), (1.0, 0.5, 0.5)])
    @pytest.mark.parametrize("angle_deg", [25.0, 50.0, 75.0, 88.0])
    def test_angle_of_a_straight_tube(self, spacing: Any, angle_deg: float) -> None:
        """On a plane seen through several voxel sizes, in several places of a voxel."""
        straight = tubes_of(curved_length_mm=0.0, kappa=0.0)
        lung = plane_canvas(spacing=spacing).lung()
        border = spacing[0] * round((0.0 - LOW[0]) / spacing[0]) + LOW[0]
        angle = math.radians(angle_deg)
        forward = np.array([math.sin(angle), 0.0, math.cos(angle)])
        for shift in (0.0, 0.13, 0.31):
            base = np.array([border, shift, shift]) - 4.0 * forward
            found = accepted(validated(lung, 8.0, 8.0, base=base, forward=forward, tubes=straight))
            assert found.exit_mm == pytest.approx(4.0, abs=2e-3)
            assert math.degrees(found.wall_angle_rad) == pytest.approx(angle_deg, abs=5.0)

    @pytest.mark.parametrize("branch", [-1, 0, 1, 2, 3])
    def test_only_out_of_a_known_branch_beyond_the_main_bronchi(self, branch: int) -> None:
        canvas = Canvas.empty(LOW, HIGH, 0.5)
        x = canvas.points[..., 0]
        canvas.airway(x < 0, x < 1, branch)
        verdict = validated(canvas.lung(CHAIN))
        if branch == 2:
            assert accepted(verdict).branch == 2
        else:
            assert verdict == REASONS[kernels.LEAVES_MEDIASTINAL]

    @pytest.mark.parametrize("rotation", np.linspace(0.0, 2 * math.pi, 7, endpoint=False))
    def test_through_a_cylinder(self, rotation: float) -> None:
        """Against the voxels met by a dense walk along the same arc."""
        canvas = Canvas.empty([-15, -15, -20], [15, 15, 20], 0.6)
        radial = np.linalg.norm(canvas.points[..., :2], axis=-1)
        canvas.airway(radial < 3.0, radial < 4.0, 2)
        lung = canvas.lung(CHAIN)
        found = accepted(validated(lung, base=(0.0, 0.0, -15.0), rotation=rotation))
        s = np.arange(0.0, 30.0, 0.001)
        aside, ahead = (1 - np.cos(KAPPA * s)) / KAPPA, np.sin(KAPPA * s) / KAPPA
        points = np.column_stack([aside * math.cos(rotation), aside * math.sin(rotation), ahead - 15.0])
        in_lumen = (labels_along(lung, points) & LUMEN) != 0
        assert found.exit_mm == pytest.approx(s[np.argmin(in_lumen)], abs=3e-3)
        assert found.branch == 2
        assert np.allclose(found.lps_from_tip[:3, 3], tip_of(0.0, 30.0, (0, 0, -15.0), rotation), atol=1e-9)
        exact = math.asin(math.sin(KAPPA * found.exit_mm))
        assert math.degrees(found.wall_angle_rad) == pytest.approx(math.degrees(exact), abs=6.0)

    @pytest.mark.parametrize("out_mm", [0.03, 0.09, 0.13, 0.4])
    def test_a_corner_is_no_exit(self, out_mm: float) -> None:
        """A wall voxel in the lumen, of which the axis cuts a corner at 45 degrees before it leaves."""
        canvas = plane_canvas()
        x, z = canvas.points[..., 0], canvas.points[..., 2]
        canvas.labels[(np.abs(x + 1.75) < 0.1) & (np.abs(z + 1.75) < 0.1)] &= ~np.uint16(LUMEN)
        forward = np.array([1.0, 0.0, 1.0]) / math.sqrt(2.0)
        base = np.array([-5.0, 0.13, -5.5 + out_mm / math.sqrt(2.0)])
        straight = tubes_of(curved_length_mm=0.0, kappa=0.0)
        found = validated(canvas.lung(), 12.0, 12.0, base=base, forward=forward, tubes=straight)
        if out_mm <= kernels.CORNER_MM:
            assert accepted(found).exit_mm == pytest.approx(5.0 * math.sqrt(2.0), abs=2e-3)
        else:
            assert found == REFUSALS["again"]

    @pytest.mark.parametrize("outer_mm", [0.0, 12.0])
    @pytest.mark.parametrize("angle_deg", [20.0, 45.0, 88.0])
    def test_run_in_the_wall(self, angle_deg: float, outer_mm: float) -> None:
        """A straight tube is in a flat wall until its axis is beyond it by its radius."""
        angle, radius = math.radians(angle_deg), 0.8 if outer_mm else 0.6
        forward = np.array([math.sin(angle), 0.0, math.cos(angle)])
        base = np.array([0.0, 0.13, -2.0]) - 4.0 * forward
        expected = (1.0 + radius) / math.sin(angle)
        over = kernels.RUN_STEP_MM * (1.0 + 1.0 / math.sin(angle))
        for limit in (expected + 0.1, expected - 0.1):
            tubes = tubes_of(curved_length_mm=0.0, kappa=0.0, max_wall_run_mm=limit)
            found = validated(plane_canvas().lung(), outer_mm, 12.0, base=base, forward=forward, tubes=tubes)
            if limit > expected:
                assert expected - 1e-6 <= accepted(found).wall_run_mm <= expected + over
            else:
                assert found == REFUSALS["wall"]

    def test_tip_pose_of_both_tubes(self) -> None:
        found = accepted(validated(plane_canvas().lung(), 12.0, 32.0, rotation=0.2))
        tip = found.lps_from_tip
        assert np.allclose(tip[:3, 3], tip_of(12.0, 32.0, BASE, 0.2), atol=1e-9)
        angle = 12 * OVERLAP + 20 * KAPPA
        bend = np.array([math.cos(0.2), math.sin(0.2), 0.0])
        assert np.allclose(tip[:3, 2], math.sin(angle) * bend + math.cos(angle) * np.array([0, 0, 1.0]))
        assert np.allclose(tip[:3, 0], math.cos(angle) * bend - math.sin(angle) * np.array([0, 0, 1.0]))


def tip_of(outer: float, inner: float, base: Any, rotation: float) -> Float:
    aside, ahead = kernels.planar_point(NUMBERS, outer, inner, inner)
    return np.array(base) + [aside * math.cos(rotation), aside * math.sin(rotation), ahead]


def labels_along(lung: Lung, points: Float) -> np.ndarray:
    return lung.labels[tuple(np.rint(lung.grid.ijk(points)).astype(int).T)]


REFUSALS = {
    "vessel": "the tube comes too near a vessel",
    "pleura": "the tube comes too near the pleura or leaves the lung",
    "fissure": "the tube comes too near a fissure",
    "branch": "the tube comes too near another airway",
    "again": "the tube enters an airway again",
    "flat": "the tube meets the airway wall at too flat an angle",
    "wall": "the tube runs too far in the wall of the airway that it leaves",
    "none": "the tube does not leave the airway",
    "long": "the tube would extend too far",
    "short": "the inner tube is too short to protrude so far",
    "sweep": "the tube would sweep tissue sideways",
}


class TestRefusals:
    """Every reason, where it holds and where it just does not."""

    POINT = np.array(tip_of(0.0, 25.0, BASE, 0.0))
    """On the axis in the tissue, 5 mm before the tip."""
    ASIDE = np.array([math.cos(0.625), 0.0, -math.sin(0.625)])
    """Square to the axis there."""
    REQUIRED = 0.6 + MARGIN

    def near(self, bits: int, gap: float) -> Lung:
        """A block of voxels whose nearest point is about `gap` from the axis at POINT."""
        canvas = plane_canvas(spacing=0.25)
        canvas.add(canvas.ball(self.POINT + (gap + 1.5) * self.ASIDE, 1.5), bits)
        return canvas.lung()

    @pytest.mark.parametrize(
        ("bits", "why"),
        [
            (VESSEL, "vessel"),
            (OUTSIDE, "pleura"),
            (FISSURE, "fissure"),
            (AIRWAY | (2 << BRANCH_SHIFT), "branch"),
            (AIRWAY | (2 << BRANCH_SHIFT) | LUMEN, "branch"),
        ],
    )
    def test_near_a_structure(self, bits: int, why: str) -> None:
        assert validated(self.near(bits, self.REQUIRED - 0.2), with_fissures=True) == REFUSALS[why]
        accepted(validated(self.near(bits, self.REQUIRED + 0.4), with_fissures=True))

    def test_fissures_may_be_allowed(self) -> None:
        accepted(validated(self.near(FISSURE, -2.0), with_fissures=False))

    def test_the_outer_tube_needs_more_room(self) -> None:
        """The inner tube's 1.1 mm are there, the outer tube's 1.3 mm are not."""
        canvas = plane_canvas(spacing=0.25)
        point = np.array(tip_of(30.0, 30.0, (-1.0, 0, -15.0), 0.0))
        canvas.add((canvas.points[..., 1] > 1.2) & (canvas.points[..., 0] > 1.5), VESSEL)
        lung, any_angle = canvas.lung(), tubes_of(min_wall_angle_deg=1.0)
        assert point[0] > 1.5
        accepted(validated(lung, 10.0, 30.0, base=(-1.0, 0.0, -15.0), tubes=any_angle))
        assert validated(lung, 30.0, 30.0, base=(-1.0, 0.0, -15.0), tubes=any_angle) == REFUSALS["vessel"]

    def test_behind_the_wall_where_the_tube_rubs_it(self) -> None:
        """A vessel on the wall, passed in touch with the wall before the exit."""
        canvas = plane_canvas(spacing=0.25)
        s = arc_to_wall(3.0) - 1.0
        touch = np.array(tip_of(0.0, s, BASE, 0.0))
        where = (canvas.points[..., 0] > 0) & (canvas.points[..., 0] < 0.5)
        canvas.labels[
            where & (canvas.points[..., 2] < touch[2]) & (canvas.points[..., 2] > touch[2] - 1)
        ] |= VESSEL
        assert validated(canvas.lung()) == REFUSALS["vessel"]

    def test_vessels_that_only_lie_beside_the_free_tube_do_not_matter(self) -> None:
        canvas = plane_canvas(spacing=0.25)
        canvas.add((np.abs(canvas.points[..., 0] - 0.5) < 0.5) & (canvas.points[..., 2] < -11), VESSEL)
        accepted(validated(canvas.lung()))

    @pytest.mark.parametrize("branch", [0, 3])
    def test_a_second_lumen(self, branch: int) -> None:
        """The own branch, farther on, or another one."""
        canvas = plane_canvas()
        x = canvas.points[..., 0]
        canvas.airway((x > 4) & (x < 6), (x > 3) & (x < 7), branch)
        assert validated(canvas.lung()) == REFUSALS["again" if branch == 0 else "branch"]

    def test_flat_exit(self) -> None:
        lung = plane_canvas().lung()
        angle = math.degrees(KAPPA * arc_to_wall(3.0))
        accepted(validated(lung, tubes=tubes_of(min_wall_angle_deg=angle - 4)))
        assert validated(lung, tubes=tubes_of(min_wall_angle_deg=angle + 4)) == REFUSALS["flat"]

    def test_no_exit(self) -> None:
        lung = plane_canvas().lung()
        s = arc_to_wall(3.0)
        assert validated(lung, 0.0, 0.0) == REFUSALS["none"]
        assert validated(lung, 0.0, s - 0.1) == REFUSALS["none"]
        assert validated(lung, 0.0, s + 0.9) == REFUSALS["none"], "still in the wall zone"
        accepted(validated(lung, 0.0, s + 1.1))
        assert validated(lung, 0.0, 30.0, base=(2.0, 0.0, -15.0)) == REFUSALS["none"], (
            "starts beside the airway"
        )
        assert validated(lung, 0.0, 20.0, rotation=math.pi, base=(-0.9, 0, -15)) == REFUSALS["none"]

    def test_too_long(self) -> None:
        lung = plane_canvas().lung()
        assert validated(lung, tubes=tubes_of(max_extension_mm=29.9)) == REFUSALS["long"]
        accepted(validated(lung, tubes=tubes_of(max_extension_mm=30.0)))

    def test_protrusion(self) -> None:
        lung, short = plane_canvas().lung(), tubes_of(inner_length_mm=665.0)
        assert validated(lung, 4.9, 30.0, tubes=short) == REFUSALS["short"]
        accepted(validated(lung, 5.0, 30.0, tubes=short))

    def test_sweep_is_limited_and_widens_the_clearance(self) -> None:
        lung = plane_canvas().lung()
        some = tubes_of(curved_length_mm=27.0, max_lateral_sweep_mm=5.0)
        sweep = accepted(validated(lung, 0.0, 30.0, tubes=some)).lateral_sweep_mm
        assert 0.2 < sweep < 5.0
        strict = tubes_of(curved_length_mm=27.0, max_lateral_sweep_mm=0.99 * sweep)
        assert validated(lung, 0.0, 30.0, tubes=strict) == REFUSALS["sweep"]
        beside = plane_canvas(spacing=0.25)
        beside.add((beside.points[..., 1] > 1.25) & (beside.points[..., 0] > 1.5), VESSEL)
        accepted(validated(beside.lung(), 0.0, 30.0))
        assert validated(beside.lung(), 0.0, 30.0, tubes=some) == REFUSALS["vessel"]

    def test_out_of_the_grid(self) -> None:
        assert validated(plane_canvas().lung(), 0.0, 40.0, base=(-1.0, 0.0, -5.0)) == REFUSALS["pleura"]


@pytest.mark.parametrize("seed", range(4))
def test_what_is_accepted_is_clear_and_what_is_clear_is_accepted(seed: int) -> None:
    """Random vessels about a flat wall, against distances to every voxel along a dense walk."""
    rng = np.random.default_rng(seed)
    canvas = plane_canvas(spacing=(0.6, 0.5, 0.7))
    for _ in range(14):
        canvas.add(canvas.ball(rng.uniform([2, -8, -15], [13, 8, 18]), rng.uniform(0.6, 2.0)), VESSEL)
    canvas.labels[(canvas.labels & LUMEN) != 0] &= ~np.uint16(VESSEL)
    lung = canvas.lung()
    outcomes = set()
    for _ in range(60):
        rotation, inner = rng.uniform(-0.9, 0.9), rng.uniform(20.0, 32.0)
        outer = rng.uniform(0.0, inner)
        verdict = validated(lung, outer, inner, rotation=rotation)
        spare = spare_behind_exit(lung, outer, inner, rotation)
        if isinstance(verdict, Deployment):
            assert spare >= -1e-9
        elif verdict in (REFUSALS["vessel"], REFUSALS["pleura"]) and spare > 0.08:
            pytest.fail(f"refused with {spare} mm to spare: {verdict}")
        outcomes.add(isinstance(verdict, Deployment))
    assert outcomes == {True, False}


def spare_behind_exit(lung: Lung, outer: float, inner: float, rotation: float) -> float:
    """The least clearance beyond what is required, from the first touch of the wall to the tip."""
    s = np.linspace(0.0, inner, math.ceil(inner / 0.04))
    planar = np.array([kernels.planar_point(NUMBERS, outer, inner, v) for v in s])
    bend = np.array([math.cos(rotation), math.sin(rotation), 0.0])
    points = np.array(BASE) + planar[:, :1] * bend + planar[:, 1:] * np.array([0.0, 0.0, 1.0])
    radius = np.where(s < outer, 0.8, 0.6)
    free = np.flatnonzero(-points[:, 0] >= radius)
    behind = slice(int(free[-1]) + 1 if len(free) else 0, None)
    if not len(points[behind]):
        return math.inf
    gap = brute_clearance(lung.labels, lung.grid, points[behind], OBSTACLES, 3.0, exempt_branch=0)
    return float((gap - radius[behind] - MARGIN).min())


class TestEnumeration:
    """`enumerate_site` shares the beginnings of deployments; each alone has the same verdict."""

    @pytest.mark.parametrize("tubes", [TUBES, tubes_of(inner_length_mm=660.0)])
    def test_agrees_with_deployments_one_by_one(self, tubes: ConcentricTubes) -> None:
        rng = np.random.default_rng(3)
        canvas = plane_canvas(spacing=0.6)
        for _ in range(10):
            canvas.add(canvas.ball(rng.uniform([2, -8, -12], [12, 8, 16]), rng.uniform(0.6, 1.6)), VESSEL)
        canvas.labels[(canvas.labels & LUMEN) != 0] &= ~np.uint16(VESSEL)
        lung = canvas.lung()
        environment, numbers = tube_environment(lung, with_fissures=False), tube_constants(tubes, Margins())
        base = np.array([*BASE, 0.0, 0.0, 1.0])
        angles = np.linspace(0.0, 2 * math.pi, 16, endpoint=False)
        normals = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(16)])
        stops = np.linspace(0.0, 34.0, 18)
        rows = np.zeros((16 * 18 * 19 // 2, kernels.ENTRY_COLUMNS))
        reasons = np.zeros(kernels.N_REASONS, dtype=np.int64)
        count = kernels.enumerate_site(
            environment, numbers, base, normals, 7, stops, rows, reasons, np.zeros((2, kernels.N_TRACE))
        )
        found = {(int(row[1]), row[2], row[3]): row for row in rows[:count]}
        assert len(found) == count and (rows[:count, 0] == 7).all()
        assert count + reasons.sum() == 16 * (18 * 19 // 2 - 1)
        trace, tip, alone = np.zeros(kernels.N_TRACE), np.zeros(9), np.zeros(kernels.N_REASONS, dtype=int)
        for t in range(16):
            for m in range(18):
                for e in range(m, 18):
                    if e == 0:
                        continue
                    reason = kernels.validate_deployment(
                        environment, numbers, base, normals[t], stops[m], stops[e], trace, tip
                    )
                    key = (t, stops[m], stops[e])
                    assert (reason == kernels.ACCEPTED) == (key in found), (key, reason)
                    alone[reason] += 1
                    if key in found:
                        row = found[key]
                        assert np.allclose(row[kernels.ENTRY_TIP :], tip[:6], atol=1e-9)
                        assert row[4] == trace[kernels.BRANCH]
                        assert row[5] == pytest.approx(trace[kernels.LEFT_AT], abs=1e-3)
                        assert row[6] == pytest.approx(trace[kernels.WALL_ANGLE], abs=1e-2)
                        assert row[7] == pytest.approx(trace[kernels.WALL_RUN], abs=0.1)
        assert count > 100
        assert reasons[kernels.NEAR_VESSEL] > 0
        if tubes is not TUBES:
            assert reasons[kernels.PROTRUDES] > 0

"""Deployments that are refused, one by one and enumerated, against brute force."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest

from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.poses import pose
from anatomy.structures import AIRWAY, BRANCH_SHIFT, FISSURE, LUMEN, OBSTACLES, OUTSIDE, VESSEL
from stages.tube import (
    Deployment,
    DeploymentValidator,
    ShapeGrid,
    ShapeLimits,
    SiteEnumerator,
    TubeShapes,
    kernels,
    tree_of_shapes,
    tube_shapes,
)
from stages.tube.device import ConcentricTubes
from tests.stages.scenes import brute_clearance
from tests.stages.tube.flat_wall import (
    BASE,
    KAPPA,
    MARGIN,
    NUMBERS,
    REFUSALS,
    TUBES,
    accepted,
    arc_to_wall,
    plane_canvas,
    tip_of,
    tubes_of,
    validated,
)


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


def shapes_at_stops(tubes: ConcentricTubes) -> tuple[Any, TubeShapes, Any]:
    shapes = tube_shapes(tubes.nested, ShapeLimits(max_extension_mm=34.0), ShapeGrid(stop_mm=2.0))
    return np.arange(shapes.count), shapes, tree_of_shapes(shapes)


class TestEnumeration:
    """A tree of shapes shares the beginnings of deployments; each alone has the same verdict."""

    @pytest.mark.parametrize("tubes", [TUBES, tubes_of(inner_length_mm=660.0)])
    def test_agrees_with_deployments_one_by_one(self, tubes: ConcentricTubes) -> None:
        rng = np.random.default_rng(3)
        canvas = plane_canvas(spacing=0.6)
        for _ in range(10):
            canvas.add(canvas.ball(rng.uniform([2, -8, -12], [12, 8, 16]), rng.uniform(0.6, 1.6)), VESSEL)
        canvas.labels[(canvas.labels & LUMEN) != 0] &= ~np.uint16(VESSEL)
        lung, at_stops = canvas.lung(), shapes_at_stops(tubes)
        enumerator = SiteEnumerator(
            lung, tubes, Margins(), with_fissures=False, rotations=16, at_stops=at_stops
        )
        row = np.array([*BASE, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
        every = lambda at, _towards: np.ones(len(at), dtype=bool)  # noqa: E731
        found = enumerator.deployments(row, every)
        shapes, validator = at_stops[1], DeploymentValidator(lung, tubes, Margins(), with_fissures=False)
        places = {
            (round(turn, 9), shape): n
            for n, (turn, shape) in enumerate(
                zip(found.rotation_rad.tolist(), found.shape.tolist(), strict=True)
            )
        }
        assert len(places) == found.count > 100
        assert found.candidates == found.count + sum(found.refused.values()) == 32 * shapes.count
        alone: Counter[str] = Counter()
        for turn in enumerator.angles.tolist():
            for shape in range(shapes.count):
                one = validator.validate_shape(pose(row[:3], row[3:6], row[6:]), turn, shapes.member(shape))
                n = places.get((round(turn, 9), shape))
                assert isinstance(one, Deployment) == (n is not None), one
                if isinstance(one, str):
                    alone[one] += 1
                    continue
                assert np.allclose(found.positions[n], one.lps_from_tip[:3, 3], atol=1e-9)
                assert found.branch[n] == one.branch
                assert found.exit_mm[n] == pytest.approx(one.exit_mm, abs=1e-3)
                assert found.wall_angle_rad[n] == pytest.approx(one.wall_angle_rad, abs=1e-2)
                assert found.wall_run_mm[n] == pytest.approx(one.wall_run_mm, abs=0.1)
        assert set(alone) == set(found.refused) and alone["the tube comes too near a vessel"] > 0
        kept = rng.uniform(size=32 * shapes.count) < 0.05
        some = enumerator.deployments(row, lambda _at, _towards: kept)
        wanted = [
            kept[n * shapes.count + shape]
            for n, turn in enumerate(enumerator.angles.tolist())
            for shape in found.shape[np.isclose(found.rotation_rad, turn)].tolist()
        ]
        assert np.array_equal(some.positions, found.positions[np.array(wanted)])
        assert some.candidates == some.count + sum(some.refused.values()) == kept.sum()

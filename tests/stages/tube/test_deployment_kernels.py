"""Deployments that are refused, one by one and enumerated, against brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.structures import AIRWAY, BRANCH_SHIFT, FISSURE, LUMEN, OBSTACLES, OUTSIDE, VESSEL
from stages.tube import Deployment, kernels, tube_constants, tube_environment
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
        every = np.repeat(np.triu(np.ones((18, 18), dtype=bool))[None], 16, axis=0)
        every[:, 0, 0] = False
        work = np.zeros((2, kernels.N_TRACE))
        count = kernels.enumerate_site(
            environment,
            numbers,
            base,
            normals,
            7,
            stops,
            every,
            rows,
            reasons,
            np.zeros((2, kernels.N_TRACE)),
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
        some = every & (rng.uniform(size=every.shape) < 0.05)
        fewer, left_out = np.zeros_like(rows), np.zeros_like(reasons)
        part = kernels.enumerate_site(
            environment, numbers, base, normals, 7, stops, some, fewer, left_out, work
        )
        at = np.rint(rows[:count, 2:4] / stops[1]).astype(int)
        chosen = some[rows[:count, 1].astype(int), at[:, 0], at[:, 1]]
        assert (fewer[:part] == rows[:count][chosen]).all()
        assert part + left_out.sum() == some.sum()

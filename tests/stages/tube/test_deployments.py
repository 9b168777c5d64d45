"""The deployments of a pair of tubes: enumeration from many sites, single verdicts, constants."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.poses import pose
from anatomy.structures import FISSURE, LUMEN, VESSEL
from stages.tube import (
    REASONS,
    Deployment,
    DeploymentValidator,
    enumerate_deployments,
    kernels,
    longest_mm,
    shapes_of,
    tube_constants,
)
from stages.tube.device import ConcentricTubes
from tests.stages.scenes import Canvas
from tests.stages.tube.pairs import thin_pair

TUBES, STRAIGHT = thin_pair(30.0), thin_pair(0.0)
INNER, OUTER = TUBES.inner, TUBES.outer
MARGINS = Margins(segmentation_margin_mm=0.3, registration_margin_mm=0.2)
POINTS = np.array(
    [[-3.0, 0.0, -15.0, 0.0, 0.0, 1.0], [-1.0, 2.0, -12.0, 0.1, 0.0, 1.0], [8.0, 0, 0, 0, 0, 1.0]]
)
FRAMES = np.array([pose(tip[:3], tip[3:]) for tip in POINTS])
TIPS = np.concatenate([FRAMES[:, :3, 3], FRAMES[:, :3, 2], FRAMES[:, :3, 0]], axis=1)


def scene() -> Lung:
    """A lumen below x = 0 with a flat wall above, some vessels, a fissure far on."""
    canvas = Canvas.empty([-12, -14, -20], [14, 14, 20], 0.6)
    x = canvas.points[..., 0]
    canvas.airway(x < 0, x < 1, 0)
    rng = np.random.default_rng(0)
    for _ in range(10):
        canvas.add(canvas.ball(rng.uniform([2, -10, -12], [12, 10, 16]), 1.5) & (x > 1), VESSEL)
    canvas.add(np.abs(x - 7) < 0.4, FISSURE)
    assert not (canvas.labels[(canvas.labels & LUMEN) != 0] & VESSEL).any()
    return canvas.lung()


@pytest.fixture(scope="module")
def lung() -> Lung:
    return scene()


def test_constants() -> None:
    numbers = tube_constants(TUBES, MARGINS)
    assert numbers[kernels.MARGIN] == pytest.approx(0.5)
    assert numbers[kernels.OUTER_RADIUS] == 0.8 and numbers[kernels.INNER_RADIUS] == 0.6
    assert numbers[kernels.MIN_WALL_ANGLE] == pytest.approx(math.radians(10.0))
    assert numbers[kernels.MAX_PROTRUSION] == 40.0


def test_longest_insertions() -> None:
    assert longest_mm(TUBES) == 30.0 < TUBES.max_extension_mm
    short = ConcentricTubes(outer=OUTER, inner=INNER, max_extension_mm=20.0)
    assert longest_mm(short) == 20.0
    assert longest_mm(STRAIGHT) == STRAIGHT.max_extension_mm


def test_every_reason_has_a_sentence() -> None:
    assert set(REASONS) == set(range(1, kernels.N_REASONS))
    assert len(set(REASONS.values())) == len(REASONS)


def test_every_candidate_is_accepted_or_counted(lung: Lung) -> None:
    found = enumerate_deployments(lung, TUBES, MARGINS, TIPS, with_fissures=True, rotations=12)
    a_turn = shapes_of(TUBES).count
    assert 3 * 12 * a_turn <= found.candidates <= 3 * 24 * a_turn and found.candidates % a_turn == 0
    assert found.count + sum(found.refused.values()) == found.candidates
    assert found.count > 50
    assert set(found.site.tolist()) == {0, 1}, "the third tip is not in the lumen"
    assert set(found.refused) <= set(REASONS.values())
    assert (found.inner_mm >= found.outer_mm).all() and (found.exit_mm + 1.0 <= found.inner_mm).all()
    assert np.allclose(np.linalg.norm(found.tangents, axis=1), 1.0)
    with pytest.raises(ValueError, match="read-only"):
        found.positions[0, 0] = 0.0


def test_each_is_what_the_judge_says(lung: Lung) -> None:
    found = enumerate_deployments(lung, TUBES, MARGINS, TIPS, with_fissures=True, rotations=12)
    validator = DeploymentValidator(lung, TUBES, MARGINS, with_fissures=True)
    for n in np.random.default_rng(0).choice(found.count, 60, replace=False):
        inserted = [found.outer_mm[n], found.inner_mm[n]]
        one = validator.validate(FRAMES[found.site[n]], found.rotation_rad[n], inserted)
        assert isinstance(one, Deployment)
        assert np.allclose(one.lps_from_tip[:3, 3], found.positions[n], atol=1e-9)
        assert np.allclose(one.lps_from_tip[:3, 2], found.tangents[n], atol=1e-9)
        assert one.branch == found.branch[n] == 0
        assert one.exit_mm == pytest.approx(found.exit_mm[n], abs=2e-3)
        assert one.wall_angle_rad == pytest.approx(found.wall_angle_rad[n], abs=1e-2)
        assert one.lateral_sweep_mm == pytest.approx(shapes_of(TUBES).lateral_sweep_mm[found.shape[n]])


def test_without_fissures_as_obstacles_there_are_more(lung: Lung) -> None:
    strict = enumerate_deployments(lung, TUBES, MARGINS, TIPS, with_fissures=True, rotations=8)
    free = enumerate_deployments(lung, TUBES, MARGINS, TIPS, with_fissures=False, rotations=8)
    assert strict.refused["the tube comes too near a fissure"] > 0
    assert "the tube comes too near a fissure" not in free.refused
    assert free.count > strict.count
    strict_tips = {tuple(np.round(p, 6)) for p in strict.positions}
    assert strict_tips <= {tuple(np.round(p, 6)) for p in free.positions}


def test_larger_margins_leave_fewer(lung: Lung) -> None:
    counts = [
        enumerate_deployments(
            lung, TUBES, Margins(segmentation_margin_mm=margin), TIPS, with_fissures=True, rotations=8
        ).count
        for margin in (0.0, 0.6, 2.0)
    ]
    assert counts[0] > counts[1] > counts[2]


def test_the_same_call_gives_the_same_arrays(lung: Lung) -> None:
    first, again = (
        enumerate_deployments(
            lung, TUBES, MARGINS, np.repeat(TIPS, 5, axis=0), with_fissures=True, rotations=6
        )
        for _ in range(2)
    )
    assert np.array_equal(first.positions, again.positions)
    assert first.refused == again.refused


def test_no_sites_no_deployments(lung: Lung) -> None:
    found = enumerate_deployments(lung, TUBES, MARGINS, np.zeros((0, 9)), with_fissures=False)
    assert found.count == 0 and found.candidates == 0 and found.refused == {}
    assert found.positions.shape == (0, 3)


def test_progress_is_told(lung: Lung) -> None:
    shares: list[float] = []
    tips = np.repeat(TIPS[:1], 100, axis=0)
    enumerate_deployments(
        lung,
        TUBES,
        MARGINS,
        tips,
        with_fissures=False,
        rotations=1,
        stop_spacing_mm=15.0,
        progress=shares.append,
    )
    assert shares and all(0.0 < share <= 1.0 for share in shares)


def test_straight_tubes_leave_along_the_axis_of_the_scope(lung: Lung) -> None:
    tip = np.array([[-4.0, 0.0, -12.0, 0.6, 0.0, 0.8, 0.8, 0.0, -0.6]])
    found = enumerate_deployments(lung, STRAIGHT, MARGINS, tip, with_fissures=False, rotations=1)
    assert found.count > 0
    along = (found.positions - tip[0, :3]) @ tip[0, 3:6]
    assert np.allclose(found.positions, tip[0, :3] + along[:, None] * tip[0, 3:6], atol=1e-9)
    assert np.allclose(along, found.inner_mm)


@pytest.mark.parametrize(("outer", "inner"), [(10.0, 9.9), (-0.1, 5.0), (math.nan, 5.0), (1.0, math.nan)])
def test_impossible_insertions(lung: Lung, outer: float, inner: float) -> None:
    validator = DeploymentValidator(lung, TUBES, MARGINS, with_fissures=False)
    with pytest.raises(SettingsError, match="insertions"):
        validator.validate(pose([-3, 0, -15], [0, 0, 1]), 0.0, [outer, inner])

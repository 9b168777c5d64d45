"""Where tubes leave the airway, and how long they run in its wall."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.structures import LUMEN
from stages.tube import REASONS, kernels
from tests.stages.scenes import Canvas
from tests.stages.tube.flat_wall import (
    BASE,
    CHAIN,
    HIGH,
    KAPPA,
    LOW,
    OVERLAP,
    REFUSALS,
    accepted,
    arc_to_wall,
    plane_canvas,
    tip_of,
    tubes_of,
    validated,
)


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


def labels_along(lung: Lung, points: Float) -> np.ndarray:
    return lung.labels[tuple(np.rint(lung.grid.ijk(points)).astype(int).T)]

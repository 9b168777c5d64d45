"""The proof of clearance against brute force."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, BRANCH_SHIFT, LUMEN, OBSTACLES, OUTSIDE, VESSEL
from stages.needle.kernels import proof
from stages.needle.kernels.proof import Limits
from tests.stages.needle.needles import limits_of
from tests.stages.scenes import Canvas, brute_clearance, line_tree, lung_of

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

    @pytest.mark.slow
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
        assert (
            proof.blocker_on_arc(arrays(lung), limits, (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), bend, 8.0, 0.0, -1)
            == VESSEL
        )
        assert (
            proof.blocker_on_arc(arrays(lung), limits, (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), bend, 2.0, 0.0, -1)
            == 0
        )
        assert (
            proof.blocker_on_arc(arrays(lung), limits, (5.0, 0.0, 0.0, 0.0, 0.0, 1.0), bend, 9.5, 0.0, -1)
            == OUTSIDE
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
        pose, bend = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 0.0)
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
            label = proof.blocker_on_arc(environment, values, pose, (0.0, 1.0, 0.0, 0.0), 3.0, 0.0, 0)
            assert (label == 0) == clear
            assert clear or label & LUMEN

    def test_never_a_vessel_even_if_marked_as_wall_too(self) -> None:
        canvas = Canvas.empty([-10, -10, -10], [10, 10, 10], 0.5)
        x = canvas.points[..., 0]
        canvas.airway(x < -1, x < 2, 0)
        canvas.add(canvas.ball([0.0, 0.0, 3.0], 0.6), VESSEL)
        values = limits_of(required_mm=0.9, radius_mm=0.4, exempt_mm=5.0)
        pose = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        label = proof.blocker_on_arc(arrays(canvas.lung()), values, pose, (0.0, 1.0, 0.0, 0.0), 4.0, 0.0, 0)
        assert label & VESSEL


def arrays(lung: Lung) -> proof.Obstacles:
    """What the kernels look at, without fissures."""
    field = lung.fields["obstacle"]
    return proof.Obstacles(field.corners, lung.labels, field.geometry, OBSTACLES)

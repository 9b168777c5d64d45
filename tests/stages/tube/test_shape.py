"""The centreline in space, and how far the tip's track is from it."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stages.tube import deployed, design_arrays, points_on_arcs
from tests.stages.tube.closed_form import centreline
from tests.stages.tube.pairs import thin_pair

TUBES = thin_pair(40.0)
INNER, OUTER = TUBES.inner, TUBES.outer
STIFF = [t.outer_diameter_mm**4 - t.inner_diameter_mm**4 for t in (INNER, OUTER)]
OVERLAP = 0.025 * STIFF[0] / sum(STIFF)


def scope_tip(seed: int) -> np.ndarray:
    frame = np.eye(4)
    frame[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    frame[:3, 3] = np.random.default_rng(seed).uniform(-200, 200, 3)
    return frame


def by_steps(frame: np.ndarray, rotation: float, outer: float, inner: float, steps: int) -> np.ndarray:
    """Roll the frame along the tube in small steps of its curvature."""
    pose = frame.copy()
    pose[:3, :3] = frame[:3, :3] @ Rotation.from_rotvec([0, 0, rotation]).as_matrix()
    points = [pose[:3, 3]]
    for n in range(steps):
        s = (n + 0.5) * inner / steps
        kappa = 0.0 if s < inner - 40.0 else OVERLAP if s < outer else 0.025
        half = Rotation.from_rotvec([0, 0.5 * kappa * inner / steps, 0]).as_matrix()
        small = np.eye(4)
        small[:3, :3], small[:3, 3] = half @ half, half @ [0, 0, inner / steps]
        pose = pose @ small
        points.append(pose[:3, 3])
    return np.array(points)


@given(inner=st.floats(0.5, 60.0), share=st.floats(0.0, 1.0))
def test_the_mechanics_give_the_closed_form(inner: float, share: float) -> None:
    design, frame = design_arrays(TUBES), scope_tip(2)
    made = deployed(design, [inner, share * inner], [0.0, 0.0])
    sweeps = inner > 40.0
    if made is not None:
        arcs, at = made.arcs[: made.number[0]], np.linspace(0.0, inner, 50)
        expected = centreline(TUBES, frame, 0.7, share * inner, inner, at)
        assert np.abs(points_on_arcs(arcs, frame, 0.7, at) - expected).max() < 1e-9
    assert made is not None or sweeps


@given(
    seed=st.integers(0, 1000),
    rotation=st.floats(-7.0, 7.0),
    inner=st.floats(1.0, 60.0),
    share=st.floats(0.0, 1.0),
)
def test_centreline_agrees_with_small_steps(seed: int, rotation: float, inner: float, share: float) -> None:
    frame = scope_tip(seed)
    expected = by_steps(frame, rotation, share * inner, inner, 300)
    found = centreline(TUBES, frame, rotation, share * inner, inner, np.linspace(0.0, inner, 301))
    assert np.abs(found - expected).max() < 0.1


def test_ends() -> None:
    frame = scope_tip(1)
    points = centreline(TUBES, frame, 0.4, 0.0, 20.0, [0.0, 20.0])
    assert np.allclose(points[0], frame[:3, 3])
    local = frame[:3, :3].T @ (points[1] - frame[:3, 3])
    aside = (1 - math.cos(0.5)) / 0.025
    assert np.allclose(local, [aside * math.cos(0.4), aside * math.sin(0.4), math.sin(0.5) / 0.025])
    assert centreline(TUBES, frame, 0.4, 0.0, 20.0, 7.0).shape == (1, 3)

"""Shapes placed in a patient: as each shape by itself."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.lung import Lung
from stages.tube import (
    Deployments,
    ShapeGrid,
    ShapeLimits,
    SiteEnumerator,
    enumerate_deployments,
    kernels,
    tree_of_shapes,
    tube_shapes,
)
from stages.tube.kernels.shapes import bend_towards, carried
from stages.tube.kernels.wall_exit import ACCEPTED, IN_TISSUE, PHASE, march, reset
from stages.tube.one_shape import tube_constants, tube_environment
from stages.tube.shapes import TubeShapes
from tests.stages.tube.test_deployments import FRAMES, MARGINS, TIPS, TUBES, scene
from tests.stages.tube.test_shapes import PAIR

ROTATIONS = 24


@pytest.fixture(scope="module")
def lung() -> Lung:
    return scene()


def placed(lung: Lung, shapes: TubeShapes, tolerance_mm: float) -> Deployments:
    tree = tree_of_shapes(shapes, tolerance_mm=tolerance_mm)
    enumerator = SiteEnumerator(
        lung, TUBES, MARGINS, with_fissures=True, rotations=ROTATIONS,
        at_stops=(np.arange(shapes.count), shapes, tree),
    )  # fmt: skip
    return enumerate_deployments(lung, TUBES, MARGINS, TIPS, with_fissures=True, enumerator=enumerator)


def follow_alone(lung: Lung, shapes: TubeShapes, shape: int, frame: np.ndarray, clearance: float) -> bool:
    """Tell whether a shape leaves the airway safely if it is followed by itself."""
    environment = tube_environment(lung, with_fissures=True)
    constants, trace = tube_constants(TUBES, MARGINS), np.zeros(kernels.N_TRACE)
    reset(trace)
    here, across = (*frame[:3, 3], *frame[:3, 2]), tuple(frame[:3, 0])
    at = 0.0
    for length, direction, curvature, radius in shapes.arcs_of(shape):
        bend = bend_towards.py_func(here, across, direction, curvature)
        reason = march(environment, constants, trace, here, bend, at, length, radius, clearance)
        if reason != ACCEPTED:
            return False
        here, across = carried.py_func(here, across, bend, direction, length)
        at += length
    return bool(trace[PHASE] == IN_TISSUE)


@pytest.mark.parametrize("tolerance_mm", [0.0, 0.2])
def test_what_is_placed_is_clear_by_itself(lung: Lung, tolerance_mm: float) -> None:
    """What is accepted keeps its own sweep free; with nothing shared and less room no other does."""
    limits = ShapeLimits(max_extension_mm=30.0, max_lateral_sweep_mm=0.3)
    shapes = tube_shapes(PAIR, limits, ShapeGrid(stop_mm=5.0, rotations=4))
    found = placed(lung, shapes, tolerance_mm)
    assert found.count > 100
    ours = set(
        zip(found.site, np.rint(found.rotation_rad / (2 * math.pi / ROTATIONS)), found.shape, strict=True)
    )
    rng = np.random.default_rng(0)
    agreed = 0
    for row in rng.integers(0, found.count, 60):
        turn, shape = found.rotation_rad[row], found.shape[row]
        frame = FRAMES[found.site[row]] @ turned(turn)
        assert follow_alone(lung, shapes, shape, frame, MARGINS.total_mm + shapes.lateral_sweep_mm[shape])
        tip = frame @ shapes.scope_from_tip[shape]
        assert found.positions[row] == pytest.approx(tip[:3, 3], abs=1e-9)
    for _ in range(200):
        site, turn, shape = rng.integers(0, 3), rng.integers(0, ROTATIONS), rng.integers(0, shapes.count)
        frame = FRAMES[site] @ turned(turn * 2 * math.pi / ROTATIONS)
        alone = follow_alone(lung, shapes, shape, frame, MARGINS.total_mm + 0.3 + 0.2 + 0.02)
        agreed += alone
        assert (site, turn, shape) in ours or not alone
    assert agreed > 3


def turned(angle: float) -> np.ndarray:
    """Return a rotation about +z."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def test_tree_shares_more_with_more_tolerance() -> None:
    shapes = tube_shapes(PAIR, ShapeLimits(), ShapeGrid(stop_mm=5.0, rotations=12))
    exact, loose = (tree_of_shapes(shapes, tolerance_mm=tolerance) for tolerance in (0.0, 0.2))
    assert len(loose.depth) < len(exact.depth)
    for tree in (exact, loose):
        assert sorted(tree.shapes) == list(range(shapes.count))
        assert tree.skip[-1] == len(tree.depth) and (tree.skip > np.arange(len(tree.depth))).all()
        ends = tree.first_shape[1:] > tree.first_shape[:-1]
        for node in np.flatnonzero(ends):
            own = tree.shapes[tree.first_shape[node] : tree.first_shape[node + 1]]
            assert (tree.clearance[node] >= shapes.lateral_sweep_mm[own] - 1e-6).all()
    assert (exact.clearance <= 1.01 + 1e-9).all() and loose.clearance.max() > exact.clearance.max()

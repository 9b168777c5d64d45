"""What a needle path costs, against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.structures import FISSURE, OUTSIDE, VESSEL
from lungaccess.plans.costs import obstacle_clearance_mm, path_cost, path_costs
from stages.needle.device import Needle
from stages.needle.environment import needle_environment
from stages.needle.kernels.cost import inverse_clearance_on_arc
from stages.needle.path import ArcPath, kernel_arcs
from tests.stages.scenes import Canvas

START = np.eye(4)
START[2, 3] = -10.0


def straight(length: float, x: float = 0.0) -> ArcPath:
    start = START.copy()
    start[0, 3] = x
    return ArcPath(lps_from_start=start, arcs=np.array([[length, 0.0, 0.0]]))


@pytest.fixture(scope="module")
def lung() -> Lung:
    """The pleura is the plane x = -6, a fissure the plane x = 4."""
    canvas = Canvas.empty([-20, -20, -20], [20, 20, 20], 1.0)
    canvas.add(canvas.points[..., 0] < -6, OUTSIDE)
    canvas.add((canvas.points[..., 0] > 4) & (canvas.points[..., 0] < 5), FISSURE)
    return canvas.lung()


def test_inverse_clearance_beside_a_plane(lung: Lung) -> None:
    """20 mm at a distance of 6 mm; with the fissure at 4 mm."""
    for with_fissures, expected in ((False, 20 / 6), (True, 20 / 4)):
        found = path_cost(lung, straight(20.0), "inverse_clearance", with_fissures=with_fissures)
        assert found == pytest.approx(expected, rel=1e-2)


def test_inverse_clearance_towards_a_plane(lung: Lung) -> None:
    """From 6 mm to 1 mm straight at it: ln 6."""
    start = np.eye(4)
    start[:3, :3] = [[0, 0, -1.0], [0, 1, 0], [1, 0, 0]]
    path = ArcPath(lps_from_start=start, arcs=np.array([[5.0, 0.0, 0.0]]))
    found = path_cost(lung, path, "inverse_clearance", with_fissures=False)
    assert found == pytest.approx(math.log(6.0), rel=2e-3)


def test_touching_an_obstacle_costs_no_more_than_a_tenth_of_a_millimetre_away(lung: Lung) -> None:
    for x in (-5.99, -6.5):
        found = path_cost(lung, straight(8.0, x), "inverse_clearance", with_fissures=False)
        assert found == pytest.approx(8.0 / 0.1)


def test_the_estimate_is_near_the_cost() -> None:
    """That of the kernels, by which the search sorts out paths before it computes their cost."""
    rng = np.random.default_rng(0)
    canvas = Canvas.empty([-20, -20, -20], [20, 20, 20], 1.0)
    for _ in range(30):
        canvas.add(canvas.ball(rng.uniform(-18, 18, 3), 1.5), VESSEL)
    crowded = canvas.lung()
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=0.05)
    environment = needle_environment(crowded, needle, Margins(), with_fissures=False)
    tested = 0
    for _ in range(40):
        arcs = [[rng.uniform(3, 9), rng.uniform(-3, 3), rng.uniform(0, 0.03)] for _ in range(2)]
        path = ArcPath(lps_from_start=START, arcs=np.array(arcs))
        exact = path_cost(crowded, path, "inverse_clearance", with_fissures=False)
        clearance = obstacle_clearance_mm(crowded, path.sample(0.1)[0], with_fissures=False)
        if clearance.min() > 1.0:
            tested += 1
            estimate = sum(
                inverse_clearance_on_arc(environment.obstacles, environment.limits.cost_step_mm, *arc)
                for arc in kernel_arcs(path)
            )
            assert 0.9 * exact <= estimate <= 1.1 * exact
    assert tested > 10


def test_clearance_is_exact(lung: Lung) -> None:
    points = np.array([[0.0, 0, 0], [3.3, 0, 0], [-5.75, 1, 1], [12.0, 0, 0]])
    found = obstacle_clearance_mm(lung, points, with_fissures=False)
    assert found[:3] == pytest.approx([6.0, 9.3, 0.25], abs=0.05)
    assert obstacle_clearance_mm(lung, points, with_fissures=True) == pytest.approx(
        [4.0, 0.7, 0.25, 7.0], abs=0.05
    )


def test_length() -> None:
    path = ArcPath(lps_from_start=START, arcs=np.array([[3.0, 0.0, 0.01], [4.5, 1.0, 0.0]]))
    assert (
        path_cost(Canvas.empty([-20] * 3, [20] * 3, 1.0).lung(), path, "length_mm", with_fissures=False)
        == 7.5
    )


@pytest.fixture
def mapped(lung: Lung) -> Lung:
    """The lung with a map of 0.25 below z = 0 and 0.75 above, infinite beyond z = 12."""
    values = np.full(lung.grid.shape, 0.25, dtype=np.float32, order="F")
    values[:, :, 20:] = 0.75
    values[:, :, 32:] = np.inf
    return replace(lung, cost=Volume(grid=lung.grid, array=values))


def test_cost_map(mapped: Lung) -> None:
    def cost(length: float) -> float:
        return path_cost(mapped, straight(length), "cost_map", with_fissures=False)

    assert cost(8.0) == pytest.approx(2.0)
    assert cost(18.0) == pytest.approx(10 * 0.25 + 8 * 0.75)
    assert cost(23.0) == math.inf
    assert cost(40.0) == math.inf, "beyond the grid"


def test_sum_over_voxels(mapped: Lung) -> None:
    """Voxels of 1 mm, from the face at z = -10, to the middle of one."""

    def cost(length: float) -> float:
        return path_cost(mapped, straight(length, 0.5), "voxel_sum", with_fissures=False)

    assert cost(7.5) == pytest.approx(8 * 0.25)
    assert cost(17.5) == pytest.approx(10 * 0.25 + 8 * 0.75)
    assert cost(22.5) == math.inf
    assert cost(40.0) == math.inf, "beyond the grid"


@pytest.mark.parametrize("name", ["cost_map", "voxel_sum"])
def test_without_a_cost_map_it_costs_nothing(lung: Lung, name: str) -> None:
    assert path_cost(lung, straight(20.0), name, with_fissures=False) == 0.0


@pytest.mark.parametrize("with_fissures", [False, True])
def test_the_cost_under_an_objective_is_the_weighted_sum(lung: Lung, with_fissures: bool) -> None:
    path = straight(20.0)
    costs = path_costs(lung, path, with_fissures=with_fissures)
    for name, cost in costs.items():
        assert path_cost(lung, path, name, with_fissures=with_fissures) == cost
    found = path_cost(lung, path, "inverse-clearance=2,length=0.5", with_fissures=with_fissures)
    assert found == 2.0 * costs["inverse_clearance"] + 0.5 * 20.0

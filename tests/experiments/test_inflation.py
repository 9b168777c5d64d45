"""The paper's mode of [Fu2018]: inflation and step bound as printed, lookups, and where they fail."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

import lungaccess
from anatomy.base.errors import SettingsError
from anatomy.grid import Volume
from anatomy.structures import AIRWAY, OUTSIDE, VESSEL
from experiments.support.cost_map.inflation import (
    grown_by_voxels,
    inflated_environment,
    inflation_voxels,
    largest_step_mm,
    refuting_labels,
)
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, environment_of_labels
from stages.needle.kernels.proof import blocker_on_arc
from stages.needle.objective import Objective
from stages.needle.path import ArcPath, Query, blocker_on_path
from stages.needle.search.base import RestartingRRT
from tests.stages.scenes import Canvas

NEEDLE = Needle(diameter_mm=1.0, max_curvature_per_mm=0.05)


def environment_of(canvas: Canvas, required_mm: float, costs: np.ndarray | None = None) -> NeedleEnvironment:
    return environment_of_labels(
        canvas.labels,
        canvas.grid,
        NEEDLE,
        required_clearance_mm=required_mm,
        cost_map=None if costs is None else Volume(grid=canvas.grid, array=costs.astype(np.float32)),
    )


def single_voxel(required_mm: float) -> NeedleEnvironment:
    """One vessel voxel, the cube from 0 to 1 mm on every axis."""
    canvas = Canvas.empty([-10] * 3, [10] * 3, 1.0)
    canvas.labels[10, 10, 10] = VESSEL
    return environment_of(canvas, required_mm)


def along_z(x: float, y: float) -> ArcPath:
    start = np.eye(4)
    start[:3, 3] = x, y, -6.0
    return ArcPath(lps_from_start=start, arcs=np.array([[12.0, 0.0, 0.0]]))


class TestAsPrinted:
    """The numbers."""

    def test_inflation(self) -> None:
        assert inflation_voxels([1.0, 1.0, 1.0], 1.5).tolist() == [2, 2, 2]
        assert inflation_voxels([0.6, 0.7, 1.25], 1.5).tolist() == [3, 3, 2]

    def test_a_multiple_of_the_voxel_size_is_not_rounded_up(self) -> None:
        assert inflation_voxels([0.1, 0.3, 0.7], 2.1).tolist() == [21, 7, 3]

    def test_grows_by_whole_voxels(self) -> None:
        """ceil(1.5 / (0.7, 0.8, 1.0)) = (3, 2, 2) voxels."""
        mask = np.zeros((15, 14, 13), dtype=bool)
        mask[7, 6, 5] = True
        grown = grown_by_voxels(mask, inflation_voxels([0.7, 0.8, 1.0], 1.5))
        assert np.argwhere(grown).min(axis=0).tolist() == [4, 4, 3]
        assert np.argwhere(grown).max(axis=0).tolist() == [10, 8, 7]
        assert not grown[10, 8, 7]

    def test_step(self) -> None:
        assert largest_step_mm([1.0, 1.0, 1.0], 1.5) == pytest.approx(2 * math.sqrt(4 - 2.25))
        assert largest_step_mm([0.6, 0.6, 1.0], 0.8) == pytest.approx(2 * math.sqrt(1 - 0.64))

    @pytest.mark.parametrize(
        ("spacing", "radius"), [([0.5, 0.5, 0.5], 1.5), ([0.1, 0.1, 0.1], 0.3), ([0.7, 0.6, 0.8], 1.2)]
    )
    def test_no_step_is_left_at_a_multiple_of_the_voxel_size(
        self, spacing: list[float], radius: float
    ) -> None:
        with pytest.raises(SettingsError, match="multiple of the voxel size"):
            largest_step_mm(spacing, radius)

    def test_nor_without_any_radius(self) -> None:
        with pytest.raises(SettingsError, match="clearance field"):
            inflated_environment(single_voxel(0.0))


class TestInflatedSpace:
    """What grows, and what the kernels then do."""

    def test_obstacles_grow_by_an_ellipsoid(self) -> None:
        """Against a structuring element; each structure by itself."""
        rng = np.random.default_rng(0)
        spacing = [0.6, 1.0, 0.45]
        canvas = Canvas.empty([-12] * 3, [12] * 3, spacing)
        canvas.add(rng.uniform(size=canvas.labels.shape) < 2e-3, VESSEL)
        canvas.add(rng.uniform(size=canvas.labels.shape) < 1e-3, AIRWAY)
        environment = inflated_environment(environment_of(canvas, 1.7))
        axes = np.array([3, 2, 4])
        assert inflation_voxels(spacing, 1.7).tolist() == axes.tolist()
        steps = np.stack(np.meshgrid(*[np.arange(-a, a + 1) for a in axes], indexing="ij"), axis=-1)
        ellipsoid = (steps.astype(float) ** 2 / axes**2).sum(axis=-1) <= 1 + 1e-12
        for bit in (VESSEL, AIRWAY):
            expected = ndimage.binary_dilation((canvas.labels & bit) != 0, structure=ellipsoid)
            assert np.array_equal((environment.obstacles.labels & bit) != 0, expected)

    def test_voxels_of_infinite_cost_are_obstacles(self) -> None:
        canvas = Canvas.empty([-10] * 3, [10] * 3, 1.0)
        costs = np.full(canvas.grid.shape, 0.5)
        costs[10, 10, 10] = math.inf
        environment = inflated_environment(environment_of(canvas, 1.5, costs))
        assert environment.cost_map is not None
        barred = np.isinf(environment.cost_map.array)
        assert np.array_equal(barred, environment.obstacles.labels == OUTSIDE)
        assert barred[3:-3, 3:-3, 3:-3].sum() == 33, "a ball of radius 2 voxels, and the grown border"
        assert blocker_on_path(environment, along_z(1.5, 0.5), -1) == OUTSIDE
        assert (environment.cost_map.array[~barred] == 0.5).all()

    def test_the_rest_stays(self) -> None:
        before = single_voxel(1.5)
        after = inflated_environment(before)
        assert before.limits.lookup_step_mm == 0.0
        assert before.obstacles.labels[1:-1, 1:-1, 1:-1].sum() == VESSEL
        assert after.limits.lookup_step_mm == after.limits.max_step_mm == largest_step_mm([1] * 3, 1.5)
        assert after.grid is before.grid and after.needle is before.needle and after.cost_map is None
        assert after.obstacles.clearance is before.obstacles.clearance

    def test_only_the_ends_of_steps_are_looked_up(self) -> None:
        """A slab one voxel thick lies between them, whatever its clearance."""
        environment = inflated_environment(single_voxel(1.5))
        labels = np.zeros_like(environment.obstacles.labels)
        labels[:, :, 10] = VESSEL
        arrays = environment.obstacles._replace(labels=labels)
        for low, found in ((-1.2, 0), (0.2, VESSEL), (-2.0, VESSEL)):
            pose = (0.0, 0.0, low, 0.0, 0.0, 1.0)
            assert (
                blocker_on_arc(arrays, environment.limits, pose, (0.0, 1.0, 0.0, 0.0), 2.4, 0.0, -1) == found
            )

    def test_beyond_the_grid_is_outside(self) -> None:
        environment = inflated_environment(single_voxel(1.5))
        pose = (5.0, 5.0, 8.0, 0.0, 0.0, 1.0)
        assert (
            blocker_on_arc(
                environment.obstacles, environment.limits, pose, (0.0, 1.0, 0.0, 0.0), 6.0, 0.0, -1
            )
            == OUTSIDE
        )


class TestNotConservative:
    """What the paper calls conservative passes paths that touch obstacles."""

    def test_the_ellipsoid_leaves_out_a_voxel_too_near(self) -> None:
        """Needle and margin of 1.9 mm grow the voxel by 2; that two aside and one up stays free."""
        environment = single_voxel(1.9)
        path = along_z(2.05, 1.05)
        assert blocker_on_path(inflated_environment(environment), path, -1) == 0
        assert refuting_labels(environment, [path]).tolist() == [VESSEL]
        points, _lengths = path.sample(0.01)
        distance = np.linalg.norm(np.maximum(np.abs(points - 0.5) - 0.5, 0.0), axis=1).min()
        assert distance == pytest.approx(math.hypot(1.05, 0.05), abs=1e-6)

    def test_paths_of_a_search(self) -> None:
        """Planned in both modes through the same balls: the proof refutes some of the paper's mode alone."""
        rng = np.random.default_rng(0)
        canvas = Canvas.empty([-15, -15, -5], [15, 15, 50], 1.0)
        for centre in rng.uniform([-9, -9, 8], [9, 9, 36], (25, 3)):
            canvas.add(canvas.ball(centre, 1.5), VESSEL)
        environment = environment_of(canvas, 1.3)
        query = Query(lps_from_start=np.eye(4), target=np.array([0.0, 0.0, 44.0]))
        refuted = {}
        for name, planned_in in (("proof", environment), ("paper", inflated_environment(environment))):
            paths = []
            for seed in range(1, 13):
                search = RestartingRRT(planned_in, query, seed=seed, objective=Objective(length=1.0))
                while search.iterations < 4000:
                    if search.advance(1000):
                        assert search.path is not None
                        paths.append(search.path)
            assert len(paths) >= 20
            refuted[name] = int((refuting_labels(environment, paths) != 0).sum())
        assert refuted["proof"] == 0
        assert refuted["paper"] > 0

    def test_a_space_of_this_mode_proves_nothing(self) -> None:
        with pytest.raises(SettingsError, match="cannot be proved"):
            refuting_labels(inflated_environment(single_voxel(1.5)), [along_z(5.0, 5.0)])

    def test_the_planner_of_the_whole_system_does_not_use_it(self) -> None:
        sources = [path.read_text() for path in Path(lungaccess.__file__).parent.rglob("*.py")]
        assert len(sources) > 10
        assert not any("inflation" in source for source in sources)

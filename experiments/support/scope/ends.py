"""How deep a bronchoscope of a true radius gets, and what the collision rule of [Rosell2012] lets pass."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from anatomy.lung import Lung
from experiments.support.scope.goals import end_goals, ends, goal_with_clearance
from stages.scope.advisor.advisor import Advisor, PathSettings, start_state
from stages.scope.advisor.environment import ScopeEnvironment
from stages.scope.advisor.kinematics import ScopeModel, joints
from stages.scope.advisor.lumen import Lumen, lumen_of_lung
from stages.scope.advisor.nf1 import navigation_field
from stages.scope.advisor.path import ScopePath

NEAR_MM = 10.0


class Wall:
    """Exact distances to the voxels around a lumen, by a search tree and nothing of the planner's.

    Looked at are the nearest centres of wall voxels; a box whose centre is not among them is farther away.
    """

    NEAREST = 48
    SPACING_MM = 0.5

    def __init__(self, lumen: Lumen) -> None:
        solid = lumen.index < 0
        near = ndimage.binary_dilation(~solid, np.ones((3, 3, 3))) & solid
        self._grid, self._spacing = lumen.grid, lumen.grid.spacing_mm
        self._centres = np.argwhere(near) * self._spacing
        self._tree = cKDTree(self._centres)

    def distance_mm(self, points_lps: np.ndarray) -> np.ndarray:
        """Return distances `(N,)` to the nearest wall voxel as a box."""
        local = self._grid.ijk(points_lps) * self._spacing
        _, index = self._tree.query(local, k=self.NEAREST)
        gap = np.maximum(np.abs(local[:, None] - self._centres[index]) - 0.5 * self._spacing, 0.0)
        return np.sqrt((gap**2).sum(axis=2)).min(axis=1)

    def clearance_mm(self, path: ScopePath) -> np.ndarray:
        """Return for every pose by how much its tip, and its share of the shaft, clear the scope's radius."""
        share = np.arange(0.0, 1.0, self.SPACING_MM / path.model.link_mm)[:, None]
        clearance = np.zeros(path.count)
        chains = joints(path.model, path.states)
        for number in range(path.count):
            ends = zip(chains[number, :-1], chains[number, 1:], strict=True)
            points = [a + share * (b - a) for a, b in ends] + [chains[number, -1:]]
            if number:
                points.append(np.array([path.between(number, f)[9:12] for f in (0.25, 0.5, 0.75)]))
            clearance[number] = self.distance_mm(np.concatenate(points)).min() - path.model.radius_mm
        return clearance


def success(lung: Lung, radii: tuple[float, ...], retreats: int) -> list[dict[str, Any]]:
    """Return for every radius how many airway ends are reached, and how near the others are come to."""
    lumen, rows = lumen_of_lung(lung), []
    wall = Wall(lumen)
    fields = [(goal, navigation_field(lumen, goal.voxel)) for goal in end_goals(lumen, lung)]
    for radius in radii:
        model = ScopeModel(radius_mm=radius, twist_low_deg=-90.0, bend_low_deg=-120.0)
        state = start_state(lumen, lung.tree, model)
        fits = lumen.width_from(lumen.nearest_voxel(lung.tree.carina_lps)[0]) >= radius
        reached, far, touching, poses, least, left = 0, 0, 0, 0, np.inf, []
        began = time.process_time()
        for goal, field in fields:
            advisor = Advisor(lumen, model, goal, PathSettings(retreats=retreats))
            path = advisor.path(state, seed=1)
            reached += path.reached
            left.append(path.distance_mm)
            far += path.reached or path.potentials[path.nearest] <= field.potential[fits].min() + 1.0
            clearance = wall.clearance_mm(path)
            touching += int((clearance < 0.0).sum())
            least = min(least, float(clearance.min()))
            poses += path.count
        rows.append(
            {
                "radius_mm": radius, "ends": len(fields), "reached": reached,
                "near": int((np.array(left) <= NEAR_MM).sum()),
                "as_far_as_a_ball": int(far),
                "median_left_mm": float(np.median(left)),
                "touching_poses": touching, "least_clearance_mm": least, "poses": poses,
                "s_per_end": (time.process_time() - began) / len(fields),
            }
        )  # fmt: skip
    return rows


def touching(lung: Lung, seeds: list[int]) -> dict[str, Any]:
    """Return how many poses of paths by the printed rules bring the scope of radius l into the wall."""
    lumen, model = lumen_of_lung(lung), ScopeModel()
    state = start_state(lumen, lung.tree, model)
    poses = touched = violating = paths_touched = paths = 0
    for point in ends(lung):
        goal = goal_with_clearance(lumen, lung, point, model, 0)
        advisor = Advisor(lumen, model, goal, PathSettings(retreats=0), reproduction=True)
        strict = ScopeEnvironment(model=model, field=advisor.field)
        for seed in seeds:
            path = advisor.path(state, seed=seed)
            wrong = ~strict.fits(path.states)
            poses += path.count
            touched += int(wrong.sum())
            violating += int((~advisor.environment.fits(path.states)).sum())
            paths_touched += bool(wrong.any())
            paths += 1
    return {
        "poses": poses,
        "touching": touched,
        "violating": violating,
        "paths": paths,
        "paths_touching": paths_touched,
    }

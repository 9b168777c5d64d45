"""Recorded needle queries on Med-RAD patients: their obstacles, poses, and the results of another planner.

Their rules are those of `lungaccess.running.benchmark.published`.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from dataclasses import field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import binary_erosion
from scipy.spatial import cKDTree

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.io.frames import LPS_FROM_RAS
from anatomy.io.med_rad import load_med_rad
from anatomy.structures import OBSTACLES
from lungaccess.running.benchmark.published import (
    UNC_GOAL_TOLERANCE_MM,
    UncObstacles,
    unc_needle,
    unc_obstacles,
)
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment
from stages.needle.path import ArcPath

MAX_TURN_DEG = 180.0
"""The recorded hard queries limit the angle from the start alone."""
RECHECK_MM = 0.02
"""A tenth of a voxel or less: no obstacle is stepped over."""
GENERATED_RADII_MM = (50.0, 121.0)
"""The two radii of curvature of the recorded queries."""
GENERATED_MM = (20.0, 50.0)
"""Distances of drawn targets, as those of the recorded queries."""
GENERATED_CONE_RAD = 0.5
"""Drawn targets lie within this angle of straight ahead, where the needle bends to."""
AROUND_VOXELS = 3
"""No obstacle lies within so many voxels of a drawn target: a tip can stop there."""
EXEMPT_MM = 4.0
"""The airway's wall around the start, which the needle pierces."""


@frozen_record
class Query:
    """A start pose, a target and a needle, with what is known of them.

    Args:
        radius_mm: The needle's least radius of curvature.
        lps_from_start: (4, 4) float64.
        target_lps ((3,) float64): LPS mm.
        exempt_mm: Obstacles so near to the start do not count.
        known: What was recorded with the query.
        runs: Recorded runs of another planner.
    """

    name: str
    patient: int
    radius_mm: float
    lps_from_start: Float
    target_lps: Float
    exempt_mm: float = 0.0
    known: dict[str, Any] = field(default_factory=dict)
    runs: tuple[dict[str, Any], ...] = ()

    @property
    def needle(self) -> Needle:
        """The needle of the query."""
        return unc_needle(self.radius_mm, max_accumulated_turn_deg=MAX_TURN_DEG)


def environment_of(obstacles: UncObstacles, query: Query) -> NeedleEnvironment:
    """Return a query among the obstacles of its patient."""
    return obstacles.environment(
        query.needle, query.lps_from_start, query.target_lps, exempt_mm=query.exempt_mm
    )


def load_obstacles(folder: Path) -> UncObstacles:
    """Read the masks of a Med-RAD patient."""
    return unc_obstacles(load_med_rad(folder))


def hard_queries(folder: Path) -> list[Query]:
    """Read the queries whose direct arc is blocked, with the other planner's runs."""
    runs = defaultdict(list)
    for run in json.loads((folder / "hard_peer.json").read_text())["runs"]:
        runs[run["id"]].append(run)
    return [
        Query(
            name=known["id"],
            patient=known["patient"],
            radius_mm=known["R_mm"],
            lps_from_start=LPS_FROM_RAS @ np.array(known["start_RAS"]),
            target_lps=LPS_FROM_RAS[:3, :3] @ np.array(known["target_RAS"]),
            known=known,
            runs=tuple(runs[known["id"]]),
        )
        for known in json.loads((folder / "hard_queries.json").read_text())["queries"]
    ]


def easy_queries(folder: Path, patients: Path) -> list[Query]:
    """Read the poses shipped with Med-RAD, each with every radius and exemption that was run."""
    runs = defaultdict(list)
    for run in json.loads((folder / "easy_peer.json").read_text())["runs"]:
        runs[run["patient"], run["start"], run["radius_mm"], run["start_exemption_mm"]].append(run)
    queries = []
    poses = {patient: _poses(patients / f"Patient{patient}") for patient in {key[0] for key in runs}}
    for (patient, start, radius, exempt), found in sorted(runs.items()):
        starts, target = poses[patient]
        queries.append(
            Query(
                name=f"P{patient}_start{start}_R{radius}_E{exempt}",
                patient=patient,
                radius_mm=float(radius),
                lps_from_start=starts[start - 1],
                target_lps=target,
                exempt_mm=float(exempt),
                runs=tuple(found),
            )
        )
    return queries


def generated_queries(obstacles: UncObstacles, tree: AirwayTree, count: int, seed: int) -> list[Query]:
    """Draw queries of patient 0: from the ends of airways, to free points ahead; half of each radius."""
    rng = np.random.default_rng(seed)
    ends = [int(tree.branch_points(int(branch))[-1]) for branch in tree.leaf_branches]
    queries: list[Query] = []
    while len(queries) < count:
        point = int(rng.choice(ends))
        along = tree.tangents[point]
        aside = np.cross(along, rng.normal(size=3))
        aside /= np.linalg.norm(aside)
        angle, far = rng.uniform(0.0, GENERATED_CONE_RAD), rng.uniform(*GENERATED_MM)
        target = tree.points_lps[point] + far * (np.cos(angle) * along + np.sin(angle) * aside)
        if not _has_clearance(obstacles, target):
            continue
        start = np.eye(4)
        start[:3, :3] = np.stack([aside, np.cross(along, aside), along], axis=1)
        start[:3, 3] = tree.points_lps[point]
        number = len(queries)
        queries.append(
            Query(
                name=f"generated {number + 1}", patient=0, radius_mm=GENERATED_RADII_MM[number % 2],
                lps_from_start=start, target_lps=target, exempt_mm=float(tree.radius_mm[point]) + EXEMPT_MM,
            )
        )  # fmt: skip
    return queries


def _has_clearance(obstacles: UncObstacles, target: Float) -> bool:
    low = np.floor(obstacles.grid.ijk(target)).astype(int) - AROUND_VOXELS
    high = low + 2 * AROUND_VOXELS + 2
    if (low < 0).any() or (high > obstacles.grid.shape).any():
        return False
    return not obstacles.labels[tuple(slice(a, b) for a, b in zip(low, high, strict=True))].any()


def _poses(folder: Path) -> tuple[tuple[Float, ...], Float]:
    """Read the start poses and the target of a Med-RAD patient."""
    images = load_med_rad(folder)
    return images.starts, images.targets_lps[0]


class Validator:
    """Walks a path again in small steps and measures to every obstacle voxel's centre.

    It shares nothing with the planners but the path's own numbers.
    """

    def __init__(self, environment: NeedleEnvironment, query: Query) -> None:
        # From outside an obstacle, the nearest of its voxels has a free neighbour.
        self._solid = (environment.obstacles.labels & OBSTACLES) != 0
        surface = self._solid & ~binary_erosion(self._solid, border_value=1)
        self._tree = cKDTree(environment.grid.lps(np.argwhere(surface).astype(float)))
        self._environment = environment
        self._query = query

    def faults(self, path: ArcPath) -> list[str]:
        """Return what is wrong with a path; nothing if it is valid."""
        query, needle = self._query, self._query.needle
        out = []
        points, _lengths = path.sample(RECHECK_MM)
        inside = self._solid[tuple(np.rint(self._environment.grid.ijk(points)).astype(int).T)]
        if inside.any():
            out.append("enters an obstacle")
        clearance = float(self._tree.query(points)[0].min())
        if clearance < self._environment.required_clearance_mm - 1e-9:
            out.append(f"{self._environment.required_clearance_mm - clearance:.4f} mm too near")
        if not self._environment.grid.contains(points).all():
            out.append("leaves the box")
        if np.linalg.norm(points[-1] - query.target_lps) > UNC_GOAL_TOLERANCE_MM + 1e-9:
            out.append("ends off the target")
        if not np.array_equal(path.lps_from_start, query.lps_from_start):
            out.append("starts elsewhere")
        if path.arcs[:, 2].max() > needle.max_curvature_per_mm * (1 + 1e-9):
            out.append("bends too much")
        if path.length_mm > needle.max_length_mm + 1e-9:
            out.append("is too long")
        if path.max_angle_from_start_rad() > math.radians(needle.max_angle_from_start_deg) + 1e-9:
            out.append("turns too far")
        return out

    def miss_mm(self, path: ArcPath) -> float:
        """Return the distance left to the target."""
        return float(np.linalg.norm(path.frames()[-1][:3, 3] - self._query.target_lps))

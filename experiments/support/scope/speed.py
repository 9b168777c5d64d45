"""Speed of the bronchoscope advisor on the number of voxels that [Rosell2012] had, CPU time of one core."""

from __future__ import annotations

import statistics
from functools import partial

import numpy as np

from anatomy.lung import Lung
from experiments.support.machine import median_cpu_s
from experiments.support.results import Result
from experiments.support.scope.goals import PAPER_VOXELS, end_goals, ends, goal_with_clearance, paper_sized
from stages.scope.advisor.advisor import Advisor, PathSettings, start_state
from stages.scope.advisor.best_motion import evaluate_motions
from stages.scope.advisor.kinematics import ScopeModel
from stages.scope.advisor.lumen import Lumen
from stages.scope.advisor.nf1 import Goal, goal_at, navigation_field

FIELD_S, MOTION_S, PATH_S = 10.0, 0.3, 31.0
"""[Rosell2012, section VI]: 10 s, 0.3 s, and 31 s with a standard deviation of 2 s in 10 runs."""
LOOK_AHEAD_MM = 5.0
ARRIVED_MM = 0.5 * LOOK_AHEAD_MM + 0.5
"""By the printed rules a scope stops where its look-ahead goes as far beyond the goal as it is before it."""
SPARE_VOXELS = 2
SPARE_MM = 0.25


def measure_speed(result: Result, lung: Lung, repeats: int) -> None:
    """Add rows for the field, the best motion and paths."""
    lumen, model = paper_sized(lung), ScopeModel()
    result.add("interior voxels", float(lumen.count), float(PAPER_VOXELS), note=f"{lung.name}, resampled")
    goals = [goal_with_clearance(lumen, lung, point, model, SPARE_VOXELS) for point in ends(lung)]
    field_s = median_cpu_s(lambda: navigation_field(lumen, goals[0].voxel, metric="voxels"), repeats)
    result.add("navigation function with clearance", field_s, FIELD_S, "s")
    for rules, reproduction in (("printed rules", True), ("true radius", False)):
        _measure_rules(result, lumen, lung, goals, rules, reproduction, repeats)
    _measure_retreats(result, lumen, lung, repeats)


def _measure_rules(
    result: Result, lumen: Lumen, lung: Lung, goals: list[Goal], rules: str, reproduction: bool, repeats: int
) -> None:
    model, options = ScopeModel(), PathSettings(retreats=0)
    state = start_state(lumen, lung.tree, model)
    advisors = [Advisor(lumen, model, goal, options, reproduction=reproduction) for goal in goals]
    found = [advisor.path(state, seed=result.seeds[0]) for advisor in advisors]
    paths = _path_times(advisors, state, result.seeds[0], repeats)
    motions = [
        median_cpu_s(
            partial(
                evaluate_motions, advisors[n].environment, path.state(number), LOOK_AHEAD_MM, options.weights
            ),
            3,
        )
        for n, path in enumerate(found)
        for number in range(0, path.count, 20)
    ]
    result.add(
        f"best motion, {rules}", statistics.median(motions), MOTION_S, "s",
        f"median of {len(motions)} configurations; slowest {1e3 * max(motions):.2f} ms",
    )  # fmt: skip
    arrived = sum(path.distance_mm <= ARRIVED_MM for path in found)
    result.add(
        f"path, {rules}, no retreats", statistics.median(paths), PATH_S, "s",
        f"median of {len(goals)} goals; slowest {1e3 * max(paths):.0f} ms; "
        f"{arrived} end within {ARRIVED_MM:g} mm of the goal",
    )  # fmt: skip


def _measure_retreats(result: Result, lumen: Lumen, lung: Lung, repeats: int) -> None:
    """Measure paths with retreats, by true radius, to the last voxels with a little clearance to spare."""
    model = ScopeModel(twist_low_deg=-90.0, bend_low_deg=-120.0)
    state = start_state(lumen, lung.tree, model)
    width = lumen.width_from(lumen.nearest_voxel(lung.tree.carina_lps)[0])
    fits = np.flatnonzero(width >= model.radius_mm + SPARE_MM)
    goals = set()
    for goal in end_goals(lumen, lung):
        goals.add(int(fits[np.argmin(navigation_field(lumen, goal.voxel).potential[fits])]))
    advisors = [Advisor(lumen, model, goal_at(lumen, lumen.centres(voxel))) for voxel in sorted(goals)]
    reached = [each for each in advisors if each.path(state, seed=result.seeds[0]).reached]
    times = _path_times(reached, state, result.seeds[0], repeats)
    if not times:
        return
    result.add(
        "path, true radius, with retreats, goal reached", statistics.median(times), PATH_S, "s",
        f"{len(reached)} of {len(goals)} goals with {SPARE_MM} mm to spare; "
        f"slowest {1e3 * max(times):.0f} ms",
    )  # fmt: skip


def _path_times(advisors: list[Advisor], state: np.ndarray, seed: int, repeats: int) -> list[float]:
    few = max(repeats // 4, 1)
    return [median_cpu_s(partial(advisor.path, state, seed=seed), few) for advisor in advisors]

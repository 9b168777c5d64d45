"""The figure of needle searches on a cost map, as [Fu2018, fig. 7]."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from anatomy.base.typed import Float
from experiments.support.cost_map.case import Case
from experiments.support.cost_map.problems import Scenario, unit
from experiments.support.cost_map.runs import COST_MAP, INTENSITY, SHORTEST_PATH, Run, success_and_means
from lungaccess.showing.report import style
from stages.needle.path import ArcPath

VARIANTS: dict[str, dict[str, Any]] = {
    COST_MAP: {"color": "#0072B2", "lw": 3.0},
    SHORTEST_PATH: {"color": "#D55E00", "lw": 1.8},
    INTENSITY: {"color": "#009E73", "lw": 1.8, "ls": (0, (4, 2))},
}


def draw(
    case: Case, scenarios: list[Scenario], results: dict[tuple[str, str], list[Run]], limit_s: float
) -> Figure:
    """Draw each scenario, and below it cost and success over time, as in the paper's figure."""
    figure = style.new_figure(12.0, 10.5)
    axes = figure.subplots(4, len(scenarios), height_ratios=(1.1, 1, 1, 1), squeeze=False)
    seconds = np.geomspace(1e-4, limit_s, 500)
    for column, scenario in zip(axes.T, scenarios, strict=True):
        best = {variant: _best(results[scenario.name, variant]) for variant in VARIANTS}
        _draw_scenario(column[0], case, scenario, best)
        for variant, look in VARIANTS.items():
            success, sums, integrals = success_and_means(results[scenario.name, variant], seconds)
            for axis, values in zip(column[1:], (sums, integrals, 100 * success), strict=True):
                axis.plot(seconds, values, label=variant, **look)
                axis.set_xscale("log")
                axis.set_xlim(seconds[0], limit_s)
                axis.grid(alpha=0.25)
        for axis in column[1:3]:
            axis.set_ylim(0, 1.1 * axis.dataLim.y1)
        column[3].set_ylim(-3, 103)
        column[3].set_xlabel("processor time, s")
    names = ("mean cost, eq. 1", "mean integral of the map, mm", "success, %")
    for axis, label in zip(axes[1:, 0], names, strict=True):
        axis.set_ylabel(label)
    axes[3, 0].legend(frameon=False, fontsize=9, loc="lower right")
    figure.suptitle(case.name)
    figure.set_layout_engine("constrained")
    return figure


def _best(runs: list[Run]) -> ArcPath | None:
    """Return the last path of the first run that has one."""
    return next((run.paths[-1] for run in runs if run.paths), None)


def _draw_scenario(axis: Axes, case: Case, scenario: Scenario, best: dict[str, ArcPath | None]) -> None:
    """Draw the plane through start and goal in which the paths spread most, over 6 mm of the map."""
    start, goal = scenario.query.lps_from_start[:3, 3], scenario.query.target
    along = unit(goal - start)
    curves = {name: path.sample(0.2)[0] for name, path in best.items() if path is not None}
    offsets = np.concatenate([curve - start for curve in curves.values()])
    offsets -= (offsets @ along)[:, None] * along
    across = np.linalg.svd(offsets, full_matrices=False)[2][0]
    across = unit(across - (across @ along) * along)
    length = float(np.linalg.norm(goal - start))
    s, t = np.meshgrid(np.arange(-8, length + 8, 0.5), np.arange(-22, 22.1, 0.5), indexing="ij")
    plane = start + s[..., None] * along + t[..., None] * across
    layers = [_look_up(case, plane + d * np.cross(along, across)) for d in np.arange(-3, 3.1, 1.0)]
    barred = np.isinf(layers).mean(axis=0)
    soft = np.where(np.isinf(layers), 0.0, layers).max(axis=0)
    image = np.stack([1 - 0.55 * soft, 1 - 0.8 * soft, 1 - 0.8 * soft], axis=-1)
    image *= (1 - 0.7 * barred)[..., None]
    axis.imshow(image.transpose(1, 0, 2), origin="lower", extent=(s.min(), s.max(), t.min(), t.max()))
    for name, curve in curves.items():
        axis.plot((curve - start) @ along, (curve - start) @ across, **VARIANTS[name])
    axis.plot(0, 0, "o", color="#2ca02c", ms=7, mec="white")
    axis.plot(length, 0, "o", color="#d62728", ms=7, mec="white")
    axis.set_title(
        f"{scenario.name}: {100 * scenario.solved_share:.0f} % of short searches succeed", fontsize=10
    )
    axis.set_xlabel("mm")


def _look_up(case: Case, points: Float) -> Float:
    """Return the map's value at points, infinite beyond the grid."""
    costs = case.costs
    ijk = np.floor(costs.grid.ijk(points) + 0.5).astype(int)
    inside = ((ijk >= 0) & (ijk < costs.grid.shape)).all(axis=-1)
    values = np.full(points.shape[:-1], math.inf)
    values[inside] = costs.array[tuple(ijk[inside].T)]
    return values

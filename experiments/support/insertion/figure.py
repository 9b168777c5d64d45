"""Pictures of needles inserted with errors: their true paths, and the errors of their tips."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from anatomy.lung import Lung
from anatomy.typed import Float
from experiments.support.insertion.closed_loop import TOLERANCE_MM, Outcome
from experiments.support.insertion.repeated import Study
from lungaccess.report import style
from stages.needle.path import ArcPath
from stages.needle.query import Query

OPEN, CLOSED = style.TUBE, style.SCOPE
LEVEL_COLOURS = (style.NODULE, style.SCOPE, style.VESSEL)


def draw_insertions(
    lung: Lung, query: Query, plan: ArcPath, at_target: Study, by_level: dict[str, Study]
) -> Figure:
    """Draw the true paths to one target over a slice of the lung, and the tip errors of all by level."""
    figure = style.new_figure(13.0, 5.2)
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.5, 1.0]})
    draw_paths(left, lung, query, plan, at_target)
    for (level, made), colour in zip(by_level.items(), LEVEL_COLOURS, strict=True):
        for line, kind, mode in (("--", "open", made.open_loop), ("-", "closed", made.closed_loop)):
            errors = np.sort([run.tip_error_mm for run in mode.insertions])
            share = 100.0 * np.arange(1, len(errors) + 1) / len(errors)
            label = f"{level} errors, {kind} loop"
            right.step(errors, share, line, where="post", color=colour, label=label)
    right.axvline(TOLERANCE_MM, color=style.FAINT_INK, lw=0.8)
    right.set(
        xscale="log", xlim=(0.05, 100.0), ylim=(0.0, 100.0), xlabel="tip error, mm", ylabel="insertions, %"
    )
    right.set_title(f"Tip error of {len(errors)} insertions each ({lung.name})", fontsize=10)
    right.legend(fontsize=8, loc="lower right", frameon=False)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return figure


def draw_paths(axes: Any, lung: Lung, query: Query, plan: ArcPath, made: Study) -> None:
    """Draw true paths in the plane of the plan, with what the plane cuts in grey."""
    start, target = query.lps_from_start, query.target
    ahead = (target - start[:3, 3]) / np.linalg.norm(target - start[:3, 3])
    aside = start[:3, 2] - (start[:3, 2] @ ahead) * ahead
    aside = aside / np.linalg.norm(aside) if np.linalg.norm(aside) > 1e-6 else start[:3, 0]

    def flat(points: Float) -> Float:
        return np.stack([(points - start[:3, 3]) @ ahead, (points - start[:3, 3]) @ aside], axis=-1)

    length = float(np.linalg.norm(target - start[:3, 3]))
    u, v = np.meshgrid(np.arange(-6.0, length + 10.0, 0.25), np.arange(-14.0, 14.0, 0.25), indexing="xy")
    cut = start[:3, 3] + u[..., None] * ahead + v[..., None] * aside
    inside = np.array([lung.label_at(point) != 0 for point in cut.reshape(-1, 3)]).reshape(u.shape)
    extent = (u.min(), u.max(), v.min(), v.max())
    axes.imshow(inside, origin="lower", extent=extent, cmap="Greys", vmin=0.0, vmax=2.5, aspect="auto")
    for colour, mode, name in (
        (OPEN, made.open_loop, "open loop"),
        (CLOSED, made.closed_loop, "closed loop"),
    ):
        for n, run in enumerate(mode.insertions):
            points, goal = flat(run.lps_from_tip[:, :3, 3]), flat(run.target_lps)
            axes.plot(*points.T, color=colour, lw=0.8, alpha=0.7, label=None if n else name)
            axes.plot(*points[-1], "x" if run.outcome is Outcome.HIT else ".", color=colour, ms=5)
            axes.plot(*np.stack([points[-1], goal]).T, color=colour, lw=0.6, ls=":")
            axes.plot(*goal, "+", color=style.INK, ms=4)
    axes.plot([], [], "+", color=style.INK, ms=4, label="where the target is in the end")
    axes.plot(*flat(plan.sample(0.5)[0]).T, "--", color=style.INK, lw=1.0, label="plan")
    axes.set(xlabel="towards the target, mm", ylabel="aside, mm", ylim=(-14.0, 14.0))
    axes.set_title("True paths to one target, full errors; grey: what the plane cuts", fontsize=10)
    axes.legend(fontsize=8, loc="lower left", frameon=False)

"""The picture of a needle planned alone: its start, its path or what stands in the way, and the target."""

import os
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Patch

from anatomy.base.typed import Float
from anatomy.organ import Organ
from lungaccess.planning.one_stage import NeedleAnswer
from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.layers import Layers
from lungaccess.showing.report.views import View, plane_view
from lungaccess.showing.report.zoom import paint_cut
from stages.needle import Query

WIDTH_IN, HEIGHT_IN = 12.4, 6.9
WHOLE_IN, CLOSE_IN = (0.25, 1.05, 5.8, 5.0), (6.35, 1.05, 5.8, 5.0)
CLOSE_MM = 6.0
"""The right panel shows this much around its middle: a needle of 1 mm is then well seen."""
STEP_MM = 0.25
"""Between drawn points of a path."""
BLOCKED = "#D62728"


@style.plain_look
def needle_png(answer: NeedleAnswer, lung: Organ, path: str | os.PathLike[str]) -> Path:
    """Draw a needle planned alone and write the picture to `path`.

    Both panels are cuts.  The left one follows the path; without one it holds start, direction of insertion
    and target.  Dashed are the tightest arcs of the needle, between which it reaches.  The right one shows
    what is blocked, else the start, with the needle's radius and the distance that it has to keep.  Raises
    FileError if the file cannot be written.
    """
    from lungaccess.planning.one_stage import reason_in_words

    query = answer.query
    figure = style.new_figure(WIDTH_IN, HEIGHT_IN)
    layers = Layers(lung)
    start, forward = query.lps_from_start[:3, 3], query.lps_from_start[:3, 2]
    points = np.array([start, *(() if answer.path is None else answer.path.sample(STEP_MM)[0])])
    shown = points if len(points) > 1 else np.array([start, start + 10.0 * forward, query.target])
    view = plane_view(shown, "")
    found = answer.obstruction
    near_blocked = found is not None and found.place != "reach"
    middle = found.point_lps if found is not None and near_blocked else start
    whole, close = style.panel(figure, WHOLE_IN), style.panel(figure, CLOSE_IN)
    _whole_panel(whole, answer, query, layers, view, points)
    if found is not None and found.obstacle_lps is not None:
        # The plane of what is too near, so that the distance is seen in its true length.
        view = plane_view(np.array([middle, found.obstacle_lps, middle + 10.0 * forward]), "")
    _close_panel(close, answer, query, layers, view, points, middle)
    what = f"{found.place.capitalize()} blocked" if found is not None and near_blocked else "Start"
    drawing.title(close, f"{what}, close up (cut through {'the obstacle' if near_blocked else 'it'})")
    said = "a path, proved clear" if found is None else reason_in_words(found)
    if found is not None:
        said += " (proved: no path exists)" if answer.proved else " (not proved)"
    elif answer.path is None:
        said = "nothing found within the limit; not proved that there is none"
    style.heading(figure, f"Needle in {lung.name}: {said}", size=12.5)
    _legend(figure.add_axes((0.0, 0.0, 1.0, 0.11)), answer)
    return style.save_png(figure, path)


def _whole_panel(
    axes: Axes, answer: NeedleAnswer, query: Query, layers: Layers, view: View, points: Float
) -> None:
    """Draw all from start to target on a cut that follows the path, or in the plane of start and target."""
    start = query.lps_from_start[:3, 3]
    shown = view.project(np.concatenate([points, [start, query.target]]))
    drawing.fit(axes, shown.min(axis=0) - 7.0, shown.max(axis=0) + 7.0)
    paint_cut(axes, layers, view, points)
    far = 1.15 * float(np.linalg.norm(query.target - start))
    for arc in _tightest_arcs(query, view, 1.0 / answer.environment.limits.kappa, far):
        uv = view.project(arc)
        axes.plot(uv[:, 0], uv[:, 1], color=style.INK, lw=1.3, ls=(0, (5, 3)), zorder=7)
    _needle(axes, answer, query, view, points)
    drawing.target_mark(axes, view.project(query.target))
    if answer.obstruction is not None and answer.obstruction.place != "reach":
        uv = view.project(answer.obstruction.point_lps)
        axes.plot(
            uv[0], uv[1], marker="X", ms=10, mfc=BLOCKED, mec="white", mew=1.2, zorder=15, ls="none",
            path_effects=drawing.halo(2.5),
        )  # fmt: skip
    drawing.dress(axes, view, ticks=False)
    drawing.title(
        axes,
        "From start to target "
        + ("(cut in the plane of both)" if answer.path is None else "(cut that follows the path)"),
    )


def _close_panel(
    axes: Axes, answer: NeedleAnswer, query: Query, layers: Layers, view: View, points: Float, middle: Float
) -> None:
    """Draw the needle and what it has to keep near one place."""
    uv = view.project(middle)
    drawing.fit(axes, uv - CLOSE_MM, uv + CLOSE_MM)
    paint_cut(axes, layers, view, middle)
    _needle(axes, answer, query, view, points)
    found = answer.obstruction
    if found is not None and found.place != "reach":
        needed = answer.environment.required_clearance_mm if found.needed_mm is None else found.needed_mm
        axes.add_patch(Circle((uv[0], uv[1]), needed, fill=False, ec=BLOCKED, lw=1.6, ls="--", zorder=12))
        if found.obstacle_lps is not None:
            ends = view.project(np.array([middle, found.obstacle_lps]))
            axes.plot(ends[:, 0], ends[:, 1], color=BLOCKED, lw=2.0, marker="o", ms=4, zorder=15)
        radius = answer.environment.needle.radius_mm
        axes.add_patch(Circle((uv[0], uv[1]), radius, fc=BLOCKED, alpha=0.5, ec="none", zorder=11))
    drawing.dress(axes, view, ticks=False)


def _needle(axes: Axes, answer: NeedleAnswer, query: Query, view: View, points: Float) -> None:
    """Draw the path true to its width, and the start with its direction."""
    uv = view.project(points)
    if answer.path is not None:
        drawing.ribbon(axes, uv, answer.environment.needle.radius_mm, style.NEEDLE, fill=0.9, order=9)
        drawing.dashed_band(axes, uv, answer.environment.required_clearance_mm, 8)
    tail = view.project(query.lps_from_start[:3, 3])
    tip = view.project(query.lps_from_start[:3, 3] + 5.0 * query.lps_from_start[:3, 2])
    arrow = {"arrowstyle": "-|>", "color": style.TUBE, "lw": 2.2}
    axes.annotate("", xy=tuple(tip), xytext=tuple(tail), arrowprops=arrow, zorder=13)
    axes.plot(tail[0], tail[1], marker="D", ms=6, mfc="white", mec=style.INK, mew=1.4, zorder=14, ls="none")


def _tightest_arcs(query: Query, view: View, radius_mm: float, far_mm: float) -> list[Float]:
    """Return the arcs of greatest curvature to both sides within the plane of a view, `(M, 3)` each."""
    forward = query.lps_from_start[:3, 2]
    aside = np.cross(view.towards_viewer, forward)
    aside /= np.linalg.norm(aside)
    turn = np.linspace(0.0, min(far_mm / radius_mm, 0.5 * np.pi), 60)[:, None]
    start = query.lps_from_start[:3, 3]
    return [
        start + radius_mm * (np.sin(turn) * forward + side * (1.0 - np.cos(turn)) * aside) for side in (1, -1)
    ]


def _legend(axes: Axes, answer: NeedleAnswer) -> None:
    axes.set_axis_off()
    handles: list[Line2D | Patch] = [
        Line2D([], [], marker="D", mfc="white", mec=style.INK, color=style.TUBE, lw=2, label="start"),
        Line2D([], [], marker="o", mfc="none", mec=style.TARGET, mew=2, ls="none", label="target"),
        Line2D([], [], color=style.INK, lw=1.3, ls=(0, (5, 3)), label="tightest arcs of the needle"),
    ]
    if answer.path is not None:
        handles.append(Line2D([], [], color=style.NEEDLE, lw=4, label="needle; dashed: distance to keep"))
    if answer.obstruction is not None and answer.obstruction.place != "reach":
        handles.append(
            Line2D([], [], marker="X", mfc=BLOCKED, mec="white", ms=10, ls="none", label="blocked")
        )
        handles.append(Line2D([], [], color=BLOCKED, lw=1.6, ls="--", label="distance to keep"))
    for name, colour in (
        ("airway", style.LUMEN), ("vessel", style.VESSEL), ("fissure", style.FISSURE), ("outside", "#C9C9C9"),
    ):  # fmt: skip
        handles.append(Patch(facecolor=colour, edgecolor="#999999", label=name))
    axes.legend(handles=handles, loc="center", ncols=len(handles), frameon=False, fontsize=8.5)

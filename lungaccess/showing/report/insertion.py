"""Needles inserted with errors, drawn: their true paths in the plane of the plan, as a picture or a film."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.files import atomic_write
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.planning.procedure.insertion import Insertion, InsertionStudy, Summary
from lungaccess.showing.report import style
from stages.needle import Query

OPEN, CLOSED = style.TUBE, style.SCOPE
FRAMES, FRAME_MS, LAST_MS = 40, 90, 2000
ASIDE_MM = 14.0
"""Half the width of the plane that is drawn."""


class Plane:
    """The plane of a plan: from its start towards the target, and the way its start looks aside from that."""

    def __init__(self, query: Query) -> None:
        start, target = query.lps_from_start, query.target
        away = target - start[:3, 3]
        self.length_mm = float(np.linalg.norm(away))
        self._origin, self._ahead = start[:3, 3], away / self.length_mm
        aside = start[:3, 2] - (start[:3, 2] @ self._ahead) * self._ahead
        size = float(np.linalg.norm(aside))
        self._aside = aside / size if size > 1e-6 else start[:3, 0]

    def flat(self, points: Float) -> Float:
        """Return points `(..., 3)` LPS mm as `(..., 2)`: towards the target, and aside."""
        off = points - self._origin
        return np.stack([off @ self._ahead, off @ self._aside], axis=-1)

    def show_obstacles(self, axes: Any, lung: Lung) -> None:
        """Draw in grey what the plane cuts."""
        u, v = np.meshgrid(
            np.arange(-6.0, self.length_mm + 10.0, 0.25), np.arange(-ASIDE_MM, ASIDE_MM, 0.25), indexing="xy"
        )
        cut = self._origin + u[..., None] * self._ahead + v[..., None] * self._aside
        inside = np.array([lung.label_at(point) != 0 for point in cut.reshape(-1, 3)]).reshape(u.shape)
        extent = (u.min(), u.max(), v.min(), v.max())
        axes.imshow(inside, origin="lower", extent=extent, cmap="Greys", vmin=0.0, vmax=2.5, aspect="auto")
        axes.set(xlabel="towards the target, mm", ylabel="aside, mm", ylim=(-ASIDE_MM, ASIDE_MM))


def _modes(found: InsertionStudy) -> dict[str, tuple[str, Summary]]:
    """Return the colour and the insertions of both ways to insert, by the name of the way."""
    return {"open loop": (OPEN, found.open_loop), "closed loop": (CLOSED, found.closed_loop)}


def draw_paths(axes: Any, lung: Lung, found: InsertionStudy) -> None:
    """Draw true paths in the plane of the plan, with what the plane cuts in grey."""
    from lungaccess.planning.procedure.insertion import Outcome

    plane = Plane(found.query)
    plane.show_obstacles(axes, lung)
    for name, (colour, mode) in _modes(found).items():
        for n, run in enumerate(mode.insertions):
            points, goal = plane.flat(run.lps_from_tip[:, :3, 3]), plane.flat(run.target_lps)
            axes.plot(*points.T, color=colour, lw=0.8, alpha=0.7, label=None if n else name)
            axes.plot(*points[-1], "x" if run.outcome is Outcome.HIT else ".", color=colour, ms=5)
            axes.plot(*np.stack([points[-1], goal]).T, color=colour, lw=0.6, ls=":")
            axes.plot(*goal, "+", color=style.INK, ms=4)
    axes.plot([], [], "+", color=style.INK, ms=4, label="where the target is in the end")
    axes.plot(*plane.flat(found.path.sample(0.5)[0]).T, "--", color=style.INK, lw=1.0, label="plan")
    axes.legend(fontsize=8, loc="lower left", frameon=False)


@style.plain_look
def insertions_png(found: InsertionStudy, lung: Lung, path: str | os.PathLike[str]) -> Path:
    """Draw the true paths of all needles, and how many of them end how near to the target.

    Raises FileError if the file cannot be written.
    """
    figure = style.new_figure(13.0, 5.2)
    left, right = figure.subplots(1, 2, gridspec_kw={"width_ratios": [1.5, 1.0]})
    draw_paths(left, lung, found)
    left.set_title("True paths; grey: what the plane of the plan cuts", fontsize=10)
    for name, (colour, mode) in _modes(found).items():
        errors = np.sort(mode.tip_errors_mm)
        share = 100.0 * np.arange(1, len(errors) + 1) / len(errors)
        right.step(errors, share, where="post", color=colour, label=name)
    right.axvline(found.tolerance_mm, color=style.FAINT_INK, lw=0.8)
    right.set(xscale="log", ylim=(0.0, 100.0), xlabel="tip error, mm", ylabel="insertions, %")
    right.set_title(f"Tip error of {len(errors)} insertions each ({lung.name})", fontsize=10)
    right.legend(fontsize=8, loc="lower right", frameon=False)
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return style.save_png(figure, path)


@style.plain_look
def insertion_webp(
    found: InsertionStudy, lung: Lung, path: str | os.PathLike[str], *, frames: int = FRAMES
) -> Path:
    """Write a film of the first needle, blindly and with the tracker side by side in time.

    Shown are the true paths so far, the plan, the path that was planned last from where the tracker has the
    tip, and where the target is in the end.  Raises FileError if the file cannot be written.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image

    blind, watched = found.open_loop.insertions[0], found.closed_loop.insertions[0]
    figure = style.new_figure(8.0, 4.4)
    canvas, axes = FigureCanvasAgg(figure), figure.subplots()
    plane = Plane(found.query)
    plane.show_obstacles(axes, lung)
    axes.plot(*plane.flat(found.path.sample(0.5)[0]).T, "--", color=style.INK, lw=1.0, label="plan")
    lines = [
        axes.plot([], [], color=c, lw=1.8, label=n)[0] for c, n in ((OPEN, "blind"), (CLOSED, "tracked"))
    ]
    planned = axes.plot([], [], color=style.NODULE, lw=1.2, label="planned last")[0]
    axes.plot(*plane.flat(watched.target_lps), "+", color=style.INK, ms=9, label="target in the end")
    axes.legend(fontsize=8, loc="lower left", frameon=False)
    figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.94))
    last = max(float(blind.inserted_mm[-1]), float(watched.inserted_mm[-1]))
    pictures = []
    for at_mm in np.linspace(0.0, last, max(frames, 2)).tolist():
        for line, run in zip(lines, (blind, watched), strict=True):
            line.set_data(*plane.flat(run.lps_from_tip[run.inserted_mm <= at_mm + 1e-9][:, :3, 3]).T)
        planned.set_data(*_planned(watched, plane, at_mm))
        words = f"{at_mm:.1f} mm inserted"
        if at_mm >= last:
            words += f"; blind ends {blind.tip_error_mm:.1f} mm from the target"
            words += f", tracked {watched.tip_error_mm:.1f} mm"
        axes.set_title(words, fontsize=10)
        canvas.draw()
        pictures.append(Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy()))
    target = Path(path)
    with atomic_write(target) as temporary:
        pictures[0].save(
            temporary, format="WEBP", save_all=True, append_images=pictures[1:], quality=75, method=4, loop=0,
            duration=[FRAME_MS] * (len(pictures) - 1) + [LAST_MS],
        )  # fmt: skip
    return target


def _planned(run: Insertion, plane: Plane, at_mm: float) -> tuple[Float, Float]:
    """Return the path that was planned last when so much was inserted."""
    tip = run.lps_from_tip[run.inserted_mm <= at_mm + 1e-9][-1][:3, 3]
    paths = [each.path for each in run.replans if each.path is not None]
    begun = [each for each in paths if plane.flat(each.lps_from_start[:3, 3])[0] <= plane.flat(tip)[0] + 0.5]
    if not begun:
        return np.zeros(0), np.zeros(0)
    x, y = plane.flat(begun[-1].sample(0.5)[0]).T
    return x, y

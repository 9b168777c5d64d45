"""Cuts through the anatomy along the plane of a device, with the device true to its width."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

from anatomy.base.typed import Float
from lungaccess.plans.curves import SHORTEST_MM
from lungaccess.plans.plan import Plan
from lungaccess.showing.report import drawing, style
from lungaccess.showing.report.layers import Layers
from lungaccess.showing.report.views import View, plane_view

PIXELS = 520
"""Columns of a cut: as many as the panel has on paper."""
SLAB_MM = (-2.0, -1.0, 1.0, 2.0)
# Painted in this order; a later layer covers an earlier one.
PAINT = (
    ("lung", style.LUNG), ("outside", "#C9C9C9"), ("fissure", style.FISSURE), ("airway", style.AIRWAY),
    ("lumen", style.LUMEN), ("vessel", style.VESSEL),
)  # fmt: skip


def exit_zoom(axes: Axes, plan: Plan, layers: Layers) -> None:
    """Draw where the tube leaves the airway, in the plane in which the tube bends."""
    tube = plan.curves().tubes.points_lps
    exit_lps = np.asarray(plan.tube.exit.point_lps)
    view = plane_view(_bending_plane(plan, tube), "")
    shown = np.concatenate([tube, exit_lps[None]])
    _cut_panel(axes, plan, layers, view, exit_lps, shown, margin_mm=7.0)
    uv = view.project(exit_lps)
    axes.plot(uv[0], uv[1], marker="D", ms=6, mfc="white", mec=style.INK, mew=1.4, zorder=13, ls="none")
    drawing.title(axes, "Exit through the wall (cut in the tube's plane)")


def needle_zoom(axes: Axes, plan: Plan, layers: Layers) -> None:
    """Draw the needle, or the tubes beyond the lumen where there is none, on a cut that follows them.

    It is seen in the direction that shows it best.
    """
    path = plan.costed_poses()[0][:, :3, 3]
    target = np.asarray(plan.target_lps)
    view = plane_view(path, "")
    shown = np.concatenate([path, target[None]])
    _cut_panel(axes, plan, layers, view, path, shown, margin_mm=6.0)
    what = "Tubes to the target (cut that follows them)"
    drawing.title(axes, what if plan.needle is None else "Needle (cut that follows it)")


def _bending_plane(plan: Plan, tube: Float) -> Float:
    """Return points that span the plane in which a tube bends, also where its bend is slight.

    Tubes bend most nearly in the plane of the scope's direction and their own tip; where the tip is straight
    ahead, in that of their rotation.
    """
    pose = np.asarray(plan.scope.lps_from_scope_tip)
    angle = plan.tube.rotation_rad
    aside = pose[:3, :2].T @ (tube[-1] - tube[0])
    if np.hypot(*aside) > SHORTEST_MM:
        angle = float(np.arctan2(aside[1], aside[0]))
    sideways = pose[:3, 0] * np.cos(angle) + pose[:3, 1] * np.sin(angle)
    start, length = pose[:3, 3], float(np.linalg.norm(tube[-1] - tube[0])) + 1.0
    return np.stack([start, start + length * pose[:3, 2], start + length * sideways])


def _cut_panel(
    axes: Axes, plan: Plan, layers: Layers, view: View, through: Float, shown: Float, *, margin_mm: float
) -> None:
    """Paint the cut through a point or along a curve, then the devices, and show all of `shown`."""
    uv = view.project(shown)
    drawing.fit(axes, uv.min(axis=0) - margin_mm, uv.max(axis=0) + margin_mm)
    paint_cut(axes, layers, view, through)
    _draw_devices_true_to_width(axes, plan, view)
    goal_marks(axes, plan, view)
    drawing.dress(axes, view, ticks=False)


def goal_marks(axes: Axes, plan: Plan, view: View) -> None:
    """Mark the target, and the aim of a plan that ends beside it because it moves."""
    drawing.target_mark(axes, view.project(np.asarray(plan.target_lps)))
    if plan.aim is not None:
        drawing.aim_mark(axes, view.project(np.asarray(plan.aim.point_lps)))


def _draw_devices_true_to_width(axes: Axes, plan: Plan, view: View) -> None:
    """Draw scope, tubes and needle as bands of their own width."""
    system = plan.system
    body, tube, needle = plan.curves()
    scope = view.project(body.points_lps)
    tube_uv, needle_uv = view.project(tube.points_lps), view.project(needle.points_lps)
    inserted = plan.tube.insertions_mm(system.tubes)
    ends = [int((tube.arc_length_mm <= length + SHORTEST_MM).sum()) for length in inserted]
    drawing.ribbon(axes, scope, system.scope.radius_mm, style.SCOPE, fill=0.35, order=6)
    required = plan.required_clearance_mm
    for (name, each), begin, end in zip(system.tubes.named, [0, *ends], ends, strict=False):
        inmost = name == "inner"
        fill, order = (0.9, 8) if inmost else (0.45, 7)
        drawing.ribbon(axes, tube_uv[:end], each.radius_mm, style.TUBE, fill=fill, order=order)
        drawing.dashed_band(axes, tube_uv[max(begin - 1, 0) : end], required[f"{name}_tube"], 5)
    if system.needle is not None:
        drawing.ribbon(axes, needle_uv, system.needle.radius_mm, style.NEEDLE, fill=0.9, order=9)
        drawing.dashed_band(axes, needle_uv, required["needle"], 5)


def paint_cut(axes: Axes, layers: Layers, view: View, through: Float) -> None:
    """Colour each pixel by the structure it lies in; vessels just beside the cut show faintly.

    The cut is the plane through a point `(3,)`, or the surface that follows a curve `(N, 3)` in depth: each
    pixel is as deep as the point of the curve that is nearest in the picture.
    """
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    u = np.linspace(left, right, PIXELS)
    v = np.linspace(bottom, top, int(PIXELS * (top - bottom) / (right - left)))
    lps = u[None, :, None] * view.right + v[:, None, None] * view.up
    curve = np.atleast_2d(through)
    lps = lps + _depth(curve, view, u, v)[..., None] * view.towards_viewer
    image = np.ones((len(v), len(u), 3))
    labels = layers.labels(lps)
    for name, colour in PAINT:
        if name == "vessel":
            beside = np.any([layers.cut(name, lps + d * view.towards_viewer) for d in SLAB_MM], axis=0)
            image[beside] = 0.65 * image[beside] + 0.35 * np.array(to_rgb(colour))
        image[layers.cut(name, lps, labels)] = to_rgb(colour)
    axes.imshow(image, extent=(left, right, bottom, top), origin="lower", aspect="auto", zorder=0)
    nodule = layers.cut("nodule", lps)
    if nodule.any():
        axes.contourf(u, v, nodule, levels=[0.5, 1.5], colors=[style.NODULE], alpha=0.35, zorder=4)
        axes.contour(u, v, nodule, levels=[0.5], colors=[style.NODULE], linewidths=[1.4], zorder=5)
    axes.set_aspect("equal", adjustable="box")


def _depth(curve: Float, view: View, u: Float, v: Float) -> Float:
    """Return how deep a cut along a curve `(N, 3)` lies at each pixel, `(V, U)` or broadcast to it, mm."""
    depth = curve @ view.towards_viewer
    if len(curve) == 1:
        return np.asarray(depth[None])
    from scipy.spatial import cKDTree

    # Pixels are smaller than voxels: a block of 2 x 2 has one depth.
    pixels = np.stack(np.meshgrid(u[::2], v[::2]), axis=-1)
    blocks = depth[cKDTree(view.project(curve)).query(pixels)[1]]
    return np.asarray(blocks.repeat(2, axis=0).repeat(2, axis=1)[: len(v), : len(u)])

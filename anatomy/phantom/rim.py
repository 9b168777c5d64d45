"""The rim below the pleura, into which no vessel runs: there they are too thin for a CT to show."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Bool, Float, UInt8
from anatomy.phantom.branching import Sprouts
from anatomy.phantom.territory import Territory


def ends_below_pleura(
    sprouts: Sprouts, radius_mm: Float, freedom: UInt8, territory: Territory, rim_mm: float
) -> tuple[Sprouts, Float, Bool]:
    """End the nameless branches of a tree where they run from deeper tissue into the rim.

    A vessel that has not yet left the rim, on its way from the mediastinum, goes on.

    Parameters
    ----------
    sprouts : Sprouts
        B branches, N points.
    radius_mm : (N,) float64
    freedom : (B,) uint8
        Nameless branches have 0, see `paint_tree`.
    rim_mm : float
        Depth of the rim.

    Returns
    -------
    Sprouts, (M,) float64, (B,) bool
        The tree that is left, its radii, and which branches those are.
    """
    start = np.concatenate([[0], np.cumsum(sprouts.counts)])
    outside_rim = territory.depth_mm(np.vstack(sprouts.points)) >= rim_mm
    deep = np.zeros(len(sprouts.parent), dtype=np.bool_)
    whole, kept = deep.copy(), deep.copy()
    points = list(sprouts.points)
    radii = []
    for branch, parent in enumerate(sprouts.parent):
        if parent >= 0 and not whole[parent]:
            continue
        along = outside_rim[start[branch] : start[branch + 1]]
        was_deep = np.logical_or.accumulate(along) | (parent >= 0 and deep[parent])
        bound = np.flatnonzero(was_deep & ~along) if freedom[branch] == 0 else np.zeros(0, dtype=np.int64)
        count = int(bound[0]) if len(bound) else len(along)
        if count < 2:
            continue
        kept[branch], whole[branch], deep[branch] = True, count == len(along), was_deep[-1]
        points[branch] = points[branch][:count]
        radii.append(radius_mm[start[branch] : start[branch] + count])
    cut = Sprouts(
        parent=sprouts.parent,
        points=points,
        diameter_mm=sprouts.diameter_mm,
        lobe=sprouts.lobe,
        name=sprouts.name,
    )
    return cut.pruned(kept), np.concatenate(radii), kept

"""Scores of a segmentation on a CT rendered from masks, so that the truth about every voxel is known."""

from __future__ import annotations

from collections.abc import Iterator

import edt
import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float32, Int, Mask
from anatomy.grid import Grid
from anatomy.segmentation.airway import Airways
from experiments.support.segmentation.synthetic_ct import SyntheticCt

POINTS, VESSEL_POINTS, NEAR_MM = 882, 281, 3.0
"""As many as in VESSEL12's three scans [Rudyanto2014]; half of the others lie so near to what confuses."""
THRESHOLDS = np.linspace(0.02, 0.98, 97)
"""Steps of 0.01 change F1 by less than a tenth of a percent."""
RADII_MM = (0.0, 0.75, 1.0, 1.5, 2.0, 2.83, 4.0)
"""Lower ends of the classes of vessels."""
BRANCH_FOUND = 0.5
"""A branch counts as found if half of its length is."""
AUC_SAMPLES = 200_000
"""Voxels of each class: the area is then known to a thousandth."""


@frozen_value
class F1:
    """Mean F1 of several draws of points, at the best threshold of each draw and at the fixed threshold."""

    best: float
    best_threshold: float
    fixed: float
    fixed_deviation: float


@frozen_record
class PointGroups:
    """Where points are drawn, as flat indices of the images' memory order.

    `vessel` lie in vessels, `near` within 3 mm of a vessel, an airway's wall or a fissure, `far` elsewhere in
    the lung.
    """

    vessel: Int
    near: Int
    far: Int

    def draws(
        self, values: Float32, count: int, vessel: Int | None = None
    ) -> Iterator[tuple[Float32, Float32]]:
        """Yield the values at 281 points in `vessel` and at 601 others, `count` times; always the same."""
        rng, n_near = np.random.default_rng(0), (POINTS - VESSEL_POINTS) // 2
        groups = (self.vessel if vessel is None else vessel, self.near, self.far)
        for _ in range(count):
            parts = [
                values[rng.choice(group, min(size, group.size), replace=False)]
                for group, size in zip(
                    groups, (VESSEL_POINTS, n_near, POINTS - VESSEL_POINTS - n_near), strict=True
                )
            ]
            yield parts[0], np.concatenate(parts[1:])


def distance_mm(mask: Mask, grid: Grid) -> Float32:
    """Return the distance from each voxel to the nearest of `mask`."""
    sides = tuple(grid.spacing_mm)
    return np.asarray(edt.edt(np.array(~mask, order="F"), anisotropy=sides, order="F", parallel=2))


def point_groups(truth: SyntheticCt, *, sure: bool) -> PointGroups:
    """Return where points are drawn.

    Args:
        sure: Whether points outside vessels keep off the voxels that touch one.  Those are partly vessel, and
            readers mark points they are sure of.
    """
    grid = truth.ct.grid
    tissue = truth.lung & ~truth.lumen
    other = tissue & ~truth.vessels
    near = other & (distance_mm(truth.vessels | truth.wall | truth.fissures, grid) <= NEAR_MM)
    if sure:
        touching = distance_mm(truth.vessels, grid) < 2.0 * grid.spacing_mm.min() - 1e-3
        near, other = near & ~touching, other & ~touching
    groups = [np.flatnonzero(m.ravel(order="K")) for m in (tissue & truth.vessels, near, other & ~near)]
    return PointGroups(vessel=groups[0], near=groups[1], far=groups[2])


def point_scores(
    groups: PointGroups, score: Float32, fixed: float, draws: int, vessel: Int | None = None
) -> F1:
    """Return F1 at `draws` sets of points; `vessel` are those to draw vessel points from, if not all."""
    best, at, held = [], [], []
    for inside, outside in groups.draws(score.ravel(order="K"), draws, vessel):
        curve = [f1(inside, outside, t) for t in THRESHOLDS]
        best.append(max(curve))
        at.append(THRESHOLDS[int(np.argmax(curve))])
        held.append(f1(inside, outside, fixed))
    return F1(
        best=float(np.mean(best)),
        best_threshold=float(np.mean(at)),
        fixed=float(np.mean(held)),
        fixed_deviation=float(np.std(held)),
    )


def f1(inside: Float32, outside: Float32, threshold: float) -> float:
    """Return 2 TP / (2 TP + FP + FN), with the points outside weighted to be 601 for 281 inside."""
    weight = (POINTS - VESSEL_POINTS) / VESSEL_POINTS * inside.size / outside.size
    hits, wrong = float((inside >= threshold).sum()), weight * float((outside >= threshold).sum())
    return 2.0 * hits / max(hits + wrong + inside.size, 1.0)


def vessels_by_radius(truth: SyntheticCt, groups: PointGroups) -> dict[str, Int]:
    """Return the voxels of vessels by radius: that of the largest ball in it within a voxel of them."""
    grid = truth.ct.grid
    sides = tuple(grid.spacing_mm)
    inside = np.array(truth.vessels, order="F")
    voxel_mm = float(grid.spacing_mm.min())
    depth = edt.edt(inside, anisotropy=sides, order="F", parallel=2) - 0.5 * voxel_mm
    radius = np.zeros(grid.shape, dtype=np.uint8, order="F")
    for low in RADII_MM[1:]:
        core = depth >= low
        if core.any():
            radius += inside & (distance_mm(core, grid) <= low + voxel_mm)
    of_vessel = radius.ravel(order="K")[groups.vessel]
    ends = (*RADII_MM[1:], np.inf)
    names = [
        f"{low:g} to {high:g} mm" if high < np.inf else f"over {low:g} mm"
        for low, high in zip(RADII_MM, ends, strict=True)
    ]
    return {name: groups.vessel[of_vessel == n] for n, name in enumerate(names)}


def share_of(mask: Mask, at: Int) -> float:
    """Return the share of voxels, given by flat indices in memory order, that a mask holds."""
    return float(mask.ravel(order="K")[at].mean())


@frozen_value
class AirwayScores:
    """Shares of the tree's length and branches found, and of the lumen found that is none."""

    length: float
    length_from_half_mm: float
    branches: float
    leakage: float


def airway_scores(truth: SyntheticCt, tree: AirwayTree, airways: Airways) -> AirwayScores:
    """Return how much of a tree was found, within a voxel, and how much lies more than a voxel outside."""
    grid = truth.ct.grid
    found = distance_mm(airways.lumen, grid) <= grid.spacing_mm.max() + 1e-3
    ijk = np.clip(np.rint(grid.ijk(tree.points_lps)).astype(np.int64), 0, np.array(grid.shape) - 1)
    hit = found[tuple(ijk.T)]
    parent = np.maximum(tree.parent_point, 0)
    step = np.linalg.norm(tree.points_lps - tree.points_lps[parent], axis=1) * (tree.parent_point >= 0)
    n_branches = int(tree.branch_of_point.max()) + 1
    lengths = np.bincount(tree.branch_of_point, weights=step, minlength=n_branches)
    hits = np.bincount(tree.branch_of_point, weights=step * hit, minlength=n_branches)
    counted = lengths > 0.0
    around = distance_mm(truth.lumen, grid) <= grid.spacing_mm.max() + 1e-3
    wide = step * (tree.radius_mm >= 0.5)
    return AirwayScores(
        length=float(hits.sum() / lengths.sum()),
        length_from_half_mm=float((wide * hit).sum() / wide.sum()),
        branches=float((hits[counted] >= BRANCH_FOUND * lengths[counted]).mean()),
        leakage=float((airways.lumen & ~around).sum() / max(int(airways.lumen.sum()), 1)),
    )


def dice(first: Mask, second: Mask) -> float:
    """Return twice what two masks share over what they hold."""
    return float(2.0 * (first & second).sum() / (first.sum() + second.sum()))


def auc(inside: Float32, outside: Float32) -> float:
    """Return how often a value inside exceeds one outside; ties count half."""
    order = np.sort(outside)
    below, upto = np.searchsorted(order, inside, "left"), np.searchsorted(order, inside, "right")
    return float((below + upto).mean() / 2.0 / order.size)


def sampled_voxels(truth: SyntheticCt) -> tuple[Int, Int]:
    """Return 200,000 voxels of vessels and as many of the other tissue, `(N, 3)` each."""
    rng = np.random.default_rng(0)
    tissue = truth.lung & ~truth.lumen
    groups = [np.argwhere(m) for m in (tissue & truth.vessels, tissue & ~truth.vessels)]
    inside, outside = (g[rng.choice(len(g), min(AUC_SAMPLES, len(g)), replace=False)] for g in groups)
    return inside, outside

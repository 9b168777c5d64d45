"""Scores of the segmentation on a CT rendered from the masks of a patient, so that the truth is known.

    python experiments/segmentation_scores.py PATIENT [--noise 25] [--vessel-hu 40] [--spacing 0.7]

Vessels: F1 at 882 points, 281 in vessels, as in [Rudyanto2014]; of the others half lie within 3 mm of a
vessel, an airway's wall or a fissure.  Readers mark points they are sure of, so no point outside lies in a
voxel that touches a vessel; the score over all voxels is given beside it.  Airways: share of the tree's
length and branches found, and share of the found volume that lies more than a voxel outside the true lumen.
Lungs: Dice.  Vesselness alone against ObjectnessMeasure of SimpleITK over the same scales: time side by side,
and area under the curve.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import edt
import numpy as np
import SimpleITK
from numpy.typing import NDArray

from anatomy.airway_tree import AirwayTree
from anatomy.grid import Grid, Volume
from anatomy.io import load_patient
from anatomy.segmentation.airway import Airways, segment_airway
from anatomy.segmentation.lungs import segment_lungs
from anatomy.segmentation.scale_space import SIGMAS_MM, ScaleSpace
from anatomy.segmentation.vesselness import ALPHA, BETA, C_HU, vesselness
from anatomy.segmentation.vessels import Vessels, segment_vessels
from anatomy.synthetic_ct import CtLook, SyntheticCt, render_ct
from anatomy.tree import tree_from_mask

Mask = NDArray[np.bool_]
Rng = np.random.Generator

POINTS, VESSEL_POINTS, NEAR_MM = 882, 281, 3.0
THRESHOLDS = np.linspace(0.02, 0.98, 97)
RADII_MM = (0.0, 0.75, 1.0, 1.5, 2.0, 2.83, 4.0, 20.0)
BRANCH_FOUND = 0.5
AUC_SAMPLES = 200_000


def distance_mm(mask: Mask, grid: Grid) -> NDArray[np.float32]:
    """Return the distance from each voxel to the nearest of `mask`."""
    sides = tuple(grid.spacing_mm)
    return np.asarray(edt.edt(np.array(~mask, order="F"), anisotropy=sides, order="F", parallel=2))


def point_scores(
    truth: SyntheticCt, score: NDArray[np.float32], fixed: float, draws: int, *, sure: bool
) -> str:
    """Return the mean F1 of `draws` sets of points, at the best threshold of each and at the fixed one."""
    grid = truth.ct.grid
    tissue = truth.lung & ~truth.lumen
    other = tissue & ~truth.vessels
    near = other & (distance_mm(truth.vessels | truth.wall | truth.fissures, grid) <= NEAR_MM)
    if sure:
        touching = distance_mm(truth.vessels, grid) < 2.0 * grid.spacing_mm.min() - 1e-3
        near, other = near & ~touching, other & ~touching
    groups = [np.flatnonzero(m.ravel(order="K")) for m in (tissue & truth.vessels, near, other & ~near)]
    values = score.ravel(order="K")
    n_near = (POINTS - VESSEL_POINTS) // 2
    sizes = (VESSEL_POINTS, n_near, POINTS - VESSEL_POINTS - n_near)
    best, at, held = [], [], []
    rng = np.random.default_rng(0)
    for _ in range(draws):
        inside, *outside = [
            values[rng.choice(g, n, replace=False)] for g, n in zip(groups, sizes, strict=True)
        ]
        curve = [f1(inside, np.concatenate(outside), t) for t in THRESHOLDS]
        best.append(max(curve))
        at.append(THRESHOLDS[int(np.argmax(curve))])
        held.append(f1(inside, np.concatenate(outside), fixed))
    return (
        f"best {np.mean(best):.4f} (sd {np.std(best):.4f}, at {np.mean(at):.2f}), "
        f"fixed {fixed:g}: {np.mean(held):.4f} (sd {np.std(held):.4f})"
    )


def f1(inside: NDArray[np.float32], outside: NDArray[np.float32], threshold: float) -> float:
    """Return 2 TP / (2 TP + FP + FN)."""
    hits, wrong = float((inside >= threshold).sum()), float((outside >= threshold).sum())
    return 2.0 * hits / max(hits + wrong + inside.size, 1.0)


def recall_by_radius(truth: SyntheticCt, vessels: Vessels) -> list[str]:
    """Return the share of vessel voxels found, by their depth in the vessel."""
    grid = truth.ct.grid
    depth = np.where(truth.vessels, distance_mm(~truth.vessels, grid), np.float32(0.0))
    inside = truth.vessels & truth.lung & ~truth.lumen & ~truth.wall
    lines = []
    for low, high in zip(RADII_MM, RADII_MM[1:], strict=False):
        core = (
            (depth - 0.5 * grid.spacing_mm.min() >= low)
            & (depth - 0.5 * grid.spacing_mm.min() < high)
            & inside
        )
        n = max(int(core.sum()), 1)
        found, large = (vessels.mask & core).sum() / n, (vessels.large & core).sum() / n
        lines.append(f"depth {low:g} to {high:g} mm: {n} voxels, found {found:.3f}, large {large:.3f}")
    return lines


def airway_scores(truth: SyntheticCt, tree: AirwayTree, airways: Airways) -> str:
    """Return share of length and of branches found, and the share of the lumen found that is none."""
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
    branches = (hits[counted] >= BRANCH_FOUND * lengths[counted]).mean()
    around = distance_mm(truth.lumen, grid) <= grid.spacing_mm.max() + 1e-3
    leak = (airways.lumen & ~around).sum() / max(int(airways.lumen.sum()), 1)
    share = hits.sum() / lengths.sum()
    return f"length {share:.4f}, branches {branches:.4f} of {counted.sum()}, leakage {leak:.4f}"


def objectness(ct: Volume, lung: Mask) -> Callable[[], NDArray[np.float32]]:
    """Return SimpleITK's vesselness over the same scales and box, ready to be called; `(2, nk, nj, ni)`.

    First the greatest response of the scales that apply at a voxel [Fu2018, eq. 4], then that of all.
    """
    space = ScaleSpace.of(ct.array, lung, ct.grid.spacing_mm)
    image = SimpleITK.GetImageFromArray(space.hu.astype(np.float32))
    image.SetSpacing([float(s) for s in ct.grid.spacing_mm])

    def run() -> NDArray[np.float32]:
        best = np.zeros((2, *space.hu.shape), dtype=np.float32)
        for scale, sigma in enumerate(SIGMAS_MM):
            smooth = SimpleITK.SmoothingRecursiveGaussian(image, sigma)
            # ITK's Hessian is not normalised: C_HU / sigma^2 is the same strength.
            response = SimpleITK.ObjectnessMeasure(smooth, ALPHA, BETA, C_HU / sigma**2, False, 1, True)
            view = SimpleITK.GetArrayViewFromImage(response)
            np.maximum(best[0], view, out=best[0], where=space.n_scales > scale)
            np.maximum(best[1], view, out=best[1])
        return best

    return run


def auc(inside: NDArray[np.float32], outside: NDArray[np.float32]) -> float:
    """Return how often a value inside exceeds one outside; ties count half."""
    order = np.sort(outside)
    below, upto = np.searchsorted(order, inside, "left"), np.searchsorted(order, inside, "right")
    return float((below + upto).mean() / 2.0 / order.size)


def timed(work: Callable[[], Any]) -> tuple[Any, float, float]:
    """Return the result, wall seconds and processor seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def compare_with_simpleitk(truth: SyntheticCt, repeats: int) -> None:
    """Print time and area under the curve of both, run in turns."""
    ct, lung = truth.ct, truth.lung
    theirs = objectness(ct, lung)
    vesselness(ct.array, lung, ct.grid.spacing_mm)
    rows = [
        (timed(lambda: vesselness(ct.array, lung, ct.grid.spacing_mm)), timed(theirs)) for _ in range(repeats)
    ]
    ours = [r[0] for r in rows]
    other = [r[1] for r in rows]
    space = ScaleSpace.of(ct.array, lung, ct.grid.spacing_mm)
    rng = np.random.default_rng(0)
    tissue = truth.lung & ~truth.lumen
    groups = [np.argwhere(m) for m in (tissue & truth.vessels, tissue & ~truth.vessels)]
    groups = [g[rng.choice(len(g), min(AUC_SAMPLES, len(g)), replace=False)] for g in groups]
    start = [s.start for s in space.box]
    a = auc(*[ours[0][0][tuple(g.T)] for g in groups])
    b, everywhere = (auc(*[found[tuple((g - start).T[::-1])] for g in groups]) for found in other[0][0])
    fastest = [[min(o[n] for o in rows) for n in (1, 2)] for rows in (ours, other)]
    for name, (wall, cpu), area in zip(("ours", "SimpleITK"), fastest, (a, b), strict=True):
        print(f"vesselness of {name}: {wall:.2f} s wall, {cpu:.2f} s processor, AUC {area:.4f}")
    wall, cpu = (fastest[1][n] / fastest[0][n] for n in (0, 1))
    print(f"  ours is {wall:.1f} times faster by wall, {cpu:.1f} by processor, best of {repeats}")
    print(f"  SimpleITK with all scales everywhere: AUC {everywhere:.4f}")


def main(arguments: list[str]) -> None:
    """Render, segment and score."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("patient", type=Path)
    parser.add_argument("--noise", type=float, default=25.0, help="standard deviation in HU")
    parser.add_argument("--vessel-hu", type=float, default=40.0)
    parser.add_argument("--spacing", type=float, default=0.7, help="mm")
    parser.add_argument("--draws", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=3, help="of the timing; 0 leaves it out")
    given = parser.parse_args(arguments)
    images = load_patient(given.patient)
    truth = render_ct(
        images, CtLook(noise_hu=given.noise, vessel_hu=given.vessel_hu, spacing_mm=given.spacing)
    )
    print(
        f"{images.name}: {truth.ct.grid.describe()}, noise {given.noise:g} HU, vessels {given.vessel_hu:g} HU"
    )
    tree = tree_from_mask(images.lumen)
    del images
    lungs, wall, cpu = timed(lambda: segment_lungs(truth.ct))
    both = lungs.left | lungs.right
    dice = 2.0 * (both & truth.lung).sum() / (both.sum() + truth.lung.sum())
    print(f"lungs: Dice {dice:.4f}; {wall:.1f} s wall, {cpu:.1f} s processor")
    airways, wall, cpu = timed(lambda: segment_airway(truth.ct, lungs))
    print(f"airways: {airway_scores(truth, tree, airways)}; {wall:.1f} s wall, {cpu:.1f} s processor")
    vessels, wall, cpu = timed(lambda: segment_vessels(truth.ct, both, airways))
    print(f"vessels: {wall:.1f} s wall, {cpu:.1f} s processor")
    for sure, name in ((True, "points off the border"), (False, "all points")):
        scores = point_scores(truth, vessels.vesselness, vessels.threshold, given.draws, sure=sure)
        print(f"  F1 at {name}: {scores}")
    print("\n".join(f"  {line}" for line in recall_by_radius(truth, vessels)))
    if given.repeats:
        compare_with_simpleitk(truth, given.repeats)


if __name__ == "__main__":
    main(sys.argv[1:])

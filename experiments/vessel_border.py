"""How far the border of a segmented vessel lies from the true one, by its radius and the slices of the CT.

    python -m experiments.vessel_border [--seeds N ...] [--looks N ...] [--record FILE]

A CT is rendered from the masks of a phantom and averaged over thicker slices; the lungs and airways are the
true ones, so that nothing but the vessels is judged.  Places are the voxels at the surface of true vessels
of at least the radius from which vessels are obstacles.  The error is positive where the true vessel reaches
out of the mask.  Places that lie farther out than `MISSED_MM` are counted as missed.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import edt
import numpy as np
from scipy import ndimage

from anatomy.base.typed import Float, Float32, Int, Mask
from anatomy.grid import Grid
from anatomy.phantom import make_phantom
from anatomy.segmentation.airway import Airways
from anatomy.segmentation.vessels import segment_vessels
from experiments.support.segmentation.slices import thickened
from experiments.support.segmentation.synthetic_ct import CtLook, SyntheticCt, render_ct

SPACING_MM, MISSED_MM = 0.7, 3.0
SLICES_MM = (0.7, 1.25, 2.0, 2.5, 3.0, 5.0)
LARGE_MM = (2.83, 1.415)
"""Radii from which vessels are obstacles: two of the scales of `anatomy.segmentation.vessels`."""
LOOKS = (
    CtLook(spacing_mm=SPACING_MM),
    CtLook(spacing_mm=SPACING_MM, psf_mm=0.9, dose=0.5),
    CtLook(spacing_mm=SPACING_MM, psf_mm=0.45, noise_hu=45.0),
    CtLook(spacing_mm=SPACING_MM, vessel_hu=250.0),
)


def distance(mask: Mask, spacing_mm: Float) -> Float32:
    """Return the distance from each voxel of a mask to the nearest that is not in it."""
    return np.asarray(edt.edt(np.array(mask, order="F"), anisotropy=tuple(spacing_mm), order="F", parallel=1))


def places(truth: SyntheticCt) -> tuple[tuple[Int, ...], Float]:
    """Return the voxels at the surface of the true vessels within the lung, and the vessel's radius at each.

    The radius is that of the largest ball within the vessel that reaches the voxel.
    """
    spacing = truth.ct.grid.spacing_mm
    vessels = truth.vessels & truth.lung
    depth = distance(vessels, spacing)
    radius = np.zeros(vessels.shape, dtype=np.float32)
    for low in np.arange(1.0, 8.0, 0.25):
        core = vessels & (depth - 0.5 * spacing.min() >= low)
        if not core.any():
            break
        radius[vessels & (distance(~core, spacing) <= low + spacing.min())] = low
    inner = ndimage.binary_erosion(vessels, iterations=1)
    surface = vessels & ~inner & ndimage.binary_erosion(truth.lung, iterations=6)
    surface &= ~ndimage.binary_dilation(truth.lumen | truth.wall, iterations=3) & (radius > 0.0)
    at = np.nonzero(surface)
    return at, radius[at].astype(np.float64)


def on_grid(mask: Mask, grid: Grid, other: Grid) -> Mask:
    """Return a mask on the slices of another grid: voxels whose middle lies in it."""
    k = np.rint(grid.ijk(other.lps(np.outer(np.arange(other.shape[2]), (0.0, 0.0, 1.0))))[:, 2])
    return np.asfortranarray(mask[:, :, np.clip(k.astype(int), 0, grid.shape[2] - 1)])


def errors_mm(
    truth: SyntheticCt, where: tuple[tuple[Int, ...], Float], slice_mm: float, large_mm: float
) -> tuple[Float, Float]:
    """Return the error of the border at all places whose vessel is an obstacle, and the vessel's radius."""
    grid = truth.ct.grid
    ct = truth.ct if slice_mm <= SPACING_MM else thickened(truth.ct, slice_mm)
    lung, lumen, wall = (on_grid(each, grid, ct.grid) for each in (truth.lung, truth.lumen, truth.wall))
    airways = Airways(lumen=lumen, wall=wall)
    found = segment_vessels(ct, lung, airways, large_radius_mm=large_mm * 1.0001).large
    mask = on_grid(found, ct.grid, grid)
    at, radius = where
    kept = radius >= large_mm
    at = tuple(each[kept] for each in at)
    spacing = grid.spacing_mm
    out, deep = distance(~mask, spacing)[at], distance(mask, spacing)[at]
    return np.where(out > 0.0, out, spacing.min() - deep), radius[kept]


def main() -> None:
    """Measure, and print a row for each phantom, look, thickness and radius."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[51, 52, 53])
    parser.add_argument("--looks", type=int, nargs="+", default=list(range(len(LOOKS))))
    parser.add_argument("--record", type=Path, default=Path(".studies/vessel_border.json"))
    options = parser.parse_args()
    rows = json.loads(options.record.read_text()) if options.record.is_file() else []
    done = {tuple(row[:4]) for row in rows}
    for seed in options.seeds:
        images = make_phantom(seed=seed, size="small", spacing_mm=SPACING_MM).images
        for look in options.looks:
            truth = render_ct(images, LOOKS[look])
            where = places(truth)
            for slice_mm in SLICES_MM:
                for large_mm in LARGE_MM:
                    if (seed, look, slice_mm, large_mm) in done:
                        continue
                    error, radius = errors_mm(truth, where, slice_mm, large_mm)
                    for low, high in ((1.415, 2.0), (2.0, 2.83), (2.83, 4.0), (4.0, np.inf)):
                        own = error[(radius >= low) & (radius < high)]
                        near = own[own <= MISSED_MM]
                        if len(near) < 50:
                            continue
                        row = [seed, look, slice_mm, large_mm, low, len(own), 1.0 - len(near) / len(own)]
                        row += [float(near.mean()), float(near.std()), *np.quantile(near, (0.05, 0.5, 0.95))]
                        rows.append(row)
                        print(*(f"{each:.3g}" for each in row), flush=True)
                    options.record.parent.mkdir(parents=True, exist_ok=True)
                    options.record.write_text(json.dumps(rows))


if __name__ == "__main__":
    main()

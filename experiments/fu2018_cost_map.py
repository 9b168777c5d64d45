"""The cost map of [Fu2018, sec. V-A]: F1 of vessels, and lungs and airways, where the truth is known.

    python -m experiments.fu2018_cost_map [--quick] [--seed 1] [--results FOLDER] [--patients NAME ...]

A CT is rendered from the masks of each patient and segmented.  F1 is that of 882 points, 281 in vessels, as
in [Rudyanto2014]; of the others half lie within 3 mm of a vessel, an airway's wall or a fissure.  Vesselness
alone is measured against ObjectnessMeasure of SimpleITK over the same scales, side by side.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import SimpleITK
from matplotlib.figure import Figure

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float32
from anatomy.grid import Volume
from anatomy.io import load_patient
from anatomy.patient import PatientImages
from anatomy.phantom import make_phantom
from anatomy.segmentation.airway import segment_airway
from anatomy.segmentation.lungs import segment_lungs
from anatomy.segmentation.vessels import (
    ALPHA,
    BETA,
    C_HU,
    SIGMAS_MM,
    ScaleSpace,
    Vessels,
    segment_vessels,
    vesselness,
)
from anatomy.tree import tree_from_mask
from experiments.support.anatomies import PHANTOM, default_anatomies, require_data
from experiments.support.results import Result, setting_of, study_parser, write_result
from experiments.support.segmentation import scores
from experiments.support.segmentation.synthetic_ct import CtLook, SyntheticCt, render_ct
from lungaccess.showing.report import style

PAPER_F1 = 0.9709
DRAWS = 20
QUICK_SPACING_MM = 1.0
NOT_REPRODUCED = [
    "The three scans of VESSEL12 with the points their readers marked cannot be had: points are drawn from "
    "rendered CT instead, whose truth is exact, and which has neither disease nor breathing."
]

Timed = tuple[Any, float, float]


@frozen_record
class Curve:
    """F1 over the threshold, of one patient."""

    name: str
    groups: scores.PointGroups
    vessels: Vessels

    def values(self) -> list[float]:
        """Return the mean F1 at each of `THRESHOLDS`."""
        parts = list(self.groups.draws(self.vessels.vesselness.ravel(order="K"), DRAWS))
        return [
            float(np.mean([scores.f1(inside, outside, t) for inside, outside in parts]))
            for t in scores.THRESHOLDS
        ]


def images_of(name: str, spacing_mm: float) -> PatientImages:
    """Return the masks of a patient, or of the phantom."""
    if name == PHANTOM:
        return make_phantom(seed=3, size="small", spacing_mm=spacing_mm).images
    return load_patient(name if Path(name).exists() else require_data(f"med-rad/{name}"))


def timed(work: Callable[[], Any]) -> Timed:
    """Return the result, wall seconds and processor seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    return result, time.perf_counter() - wall, time.process_time() - cpu


def measure(result: Result, name: str, look: CtLook, repeats: int) -> Curve:
    """Render, segment and score one patient, and add its rows."""
    images = images_of(name, look.spacing_mm)
    title, tree = images.name, tree_from_mask(images.lumen)
    truth, _, cpu = timed(partial(render_ct, images, look))
    del images
    result.conditions[title] = truth.ct.grid.describe()
    lungs, _, lungs_cpu = timed(lambda: segment_lungs(truth.ct))
    airways, _, airways_cpu = timed(lambda: segment_airway(truth.ct, lungs))
    vessels, _, vessels_cpu = timed(lambda: segment_vessels(truth.ct, lungs.mask, airways))
    found = scores.airway_scores(truth, tree, airways)
    result.add(f"{title}: lungs, Dice", scores.dice(lungs.mask, truth.lung))
    result.add(f"{title}: airway tree, length found", 100.0 * found.length, unit="%")
    result.add(
        f"{title}: the same where its radius is 0.5 mm or more", 100.0 * found.length_from_half_mm, unit="%"
    )
    result.add(
        f"{title}: branches found", 100.0 * found.branches, unit="%", note="a branch of which half is found"
    )
    result.add(f"{title}: lumen more than a voxel outside", 100.0 * found.leakage, unit="%")
    barred = vessels.large | ~lungs.mask
    groups = vessel_rows(result, title, truth, vessels, barred)
    for what, seconds in (
        ("rendering", cpu),
        ("lungs", lungs_cpu),
        ("airways", airways_cpu),
        ("vessels", vessels_cpu),
    ):
        result.add(f"{title}: time of {what}", seconds, unit="s of CPU")
    if repeats:
        compare_with_simpleitk(result, title, truth, repeats)
    return Curve(name=title, groups=groups, vessels=vessels)


def vessel_rows(
    result: Result, title: str, truth: SyntheticCt, vessels: Vessels, barred: scores.Mask
) -> scores.PointGroups:
    """Add F1 of sure points, of all points and by radius; return the groups of the sure points.

    `barred` are large vessels and what was not taken for lung: obstacles of the cost map.
    """
    fixed = vessels.threshold
    everywhere = scores.point_groups(truth, sure=False)
    of_all = scores.point_scores(everywhere, vessels.vesselness, fixed, DRAWS)
    del everywhere
    groups = scores.point_groups(truth, sure=True)
    of_sure = scores.point_scores(groups, vessels.vesselness, fixed, DRAWS)
    for what, score in (("points off the border", of_sure), ("points in all voxels", of_all)):
        result.add(
            f"{title}: F1, {what}, best threshold",
            score.best,
            PAPER_F1,
            note=f"{DRAWS} draws, at {score.best_threshold:.2f}",
        )
        result.add(
            f"{title}: F1, {what}, threshold {fixed:g}",
            score.fixed,
            note=f"standard deviation {score.fixed_deviation:.3f}",
        )
    for name, at in scores.vessels_by_radius(truth, groups).items():
        if at.size >= scores.VESSEL_POINTS:
            score = scores.point_scores(groups, vessels.vesselness, fixed, DRAWS, at)
            note = f"best {score.best:.3f}; found {100 * scores.share_of(vessels.mask, at):.1f} %, "
            note += f"obstacle {100 * scores.share_of(barred, at):.1f} % of {at.size} voxels"
            result.add(
                f"{title}: F1 of vessels of radius {name}, threshold {fixed:g}", score.fixed, note=note
            )
    return groups


def objectness(ct: Volume, lung: scores.Mask) -> Callable[[], Float32]:
    """Return SimpleITK's vesselness over the same scales and box, ready to be called; `(2, nk, nj, ni)`.

    First the greatest response of the scales that apply at a voxel [Fu2018, eq. 4], then that of all.
    """
    space = ScaleSpace.of(ct.array, lung, ct.grid.spacing_mm)
    image = SimpleITK.GetImageFromArray(space.hu.astype(np.float32))
    image.SetSpacing([float(s) for s in ct.grid.spacing_mm])

    def run() -> Float32:
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


def compare_with_simpleitk(result: Result, title: str, truth: SyntheticCt, repeats: int) -> None:
    """Add time and area under the curve of both, run in turns."""
    ct, lung = truth.ct, truth.lung
    theirs = objectness(ct, lung)
    mine, _, _ = timed(lambda: vesselness(ct.array, lung, ct.grid.spacing_mm))
    start = [s.start for s in ScaleSpace.of(ct.array, lung, ct.grid.spacing_mm).box]
    inside, outside = scores.sampled_voxels(truth)
    area = scores.auc(mine[tuple(inside.T)], mine[tuple(outside.T)])
    times, areas = [], []
    for _ in range(repeats):
        _, *ours = timed(lambda: vesselness(ct.array, lung, ct.grid.spacing_mm))
        other, *itk = timed(theirs)
        times.append((ours, itk))
        areas = [
            scores.auc(r[tuple((inside - start).T[::-1])], r[tuple((outside - start).T[::-1])]) for r in other
        ]
    (wall, cpu), (itk_wall, itk_cpu) = (np.min([t[n] for t in times], axis=0) for n in (0, 1))
    result.add(f"{title}: vesselness, area under the curve", area)
    result.add(f"{title}: the same of SimpleITK", areas[0], note=f"with all scales everywhere {areas[1]:.4f}")
    result.add(
        f"{title}: vesselness, wall time", wall, unit="s", note=f"{cpu:.1f} s of CPU, best of {repeats}"
    )
    result.add(
        f"{title}: the same of SimpleITK",
        itk_wall,
        unit="s",
        note=f"{itk_cpu:.1f} s of CPU; ours is {itk_wall / wall:.1f} times faster",
    )


def draw(curves: list[Curve]) -> Figure:
    """Draw F1 over the threshold."""
    figure = style.new_figure(6.0, 4.0)
    axes = figure.subplots()
    for curve, colour in zip(curves, (style.VESSEL, style.SCOPE, style.NODULE), strict=False):
        axes.plot(scores.THRESHOLDS, curve.values(), color=colour, lw=2.0, label=curve.name)
    axes.axhline(PAPER_F1, color=style.INK, lw=1.0, ls="--", label="[Fu2018], best threshold")
    axes.axvline(curves[0].vessels.threshold, color=style.INK, lw=0.7, ls=":", label="our fixed threshold")
    axes.set_xlabel("threshold of the vesselness")
    axes.set_ylabel("F1 at 882 points off the border")
    axes.set_ylim(0.8, 1.0)
    axes.legend(frameon=False, fontsize=8)
    return figure


def parse(arguments: list[str] | None) -> argparse.Namespace:
    """Return the options."""
    parser = study_parser(__doc__)
    parser.add_argument("--patients", nargs="+", metavar="NAME", help="Patient1, phantom, or folders")
    parser.add_argument("--noise", type=float, default=25.0, help="standard deviation in HU")
    parser.add_argument("--vessel-hu", type=float, default=40.0, help="150 to 450 with contrast medium")
    parser.add_argument("--repeats", type=int, default=1, help="of the timing; 0 leaves SimpleITK out")
    return parser.parse_args(arguments)


def main(arguments: list[str] | None = None) -> None:
    """Run the study and store its result."""
    options = parse(arguments)
    spacing_mm = QUICK_SPACING_MM if options.quick else 0.7
    look = CtLook(
        noise_hu=options.noise, vessel_hu=options.vessel_hu, spacing_mm=spacing_mm, seed=options.seed
    )
    result = Result(
        name="fu2018_cost_map",
        title="Cost map from CT: F1 of vessels on rendered CT",
        source="Fu2018, sec. V-A",
        setting=setting_of(options),
        seeds=[options.seed],
        not_reproduced=list(NOT_REPRODUCED),
        conditions={
            "CT": f"rendered at {spacing_mm:g} mm, noise {look.noise_hu:g} HU, vessels {look.vessel_hu:g} HU",
            "points": f"{scores.POINTS}, {scores.VESSEL_POINTS} in vessels, half of the others within "
            f"{scores.NEAR_MM:g} mm of a vessel, an airway's wall or a fissure; {DRAWS} draws",
        },
    )
    names = options.patients or ((PHANTOM,) if options.quick else default_anatomies())
    result.figure = draw([measure(result, name, look, options.repeats) for name in names])
    write_result(result, options.results)


if __name__ == "__main__":
    main()

"""How well nodules are outlined from one point: on phantoms with drawn nodules, and beside four readers.

    python -m experiments.nodules [--quick] [--results FOLDER] [--seed N]

The thresholds were chosen on the phantoms of the seeds 31 to 33; 34 and 35 are others.
"""

from __future__ import annotations

import json
import time

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float, Mask
from anatomy.grid import Volume
from anatomy.io import read_volume
from anatomy.nodule_size import nodule_size
from anatomy.phantom import make_phantom
from anatomy.segmentation.canonical import canonical
from anatomy.segmentation.lungs import segment_lungs
from anatomy.segmentation.nodules import annotation_mask, centre_of, nodule_from_contours
from anatomy.segmentation.outlining import outline_nodule
from experiments.support.anatomies import data_folder, require_data
from experiments.support.results import Result, setting_of, study_parser, write_result
from experiments.support.segmentation.nodule_cases import KINDS, Places, dice, nodule_case

SEEDS, SPACING_MM = (31, 32, 33, 34, 35), 0.9
DIAMETERS_MM = (6.0, 10.0, 16.0, 22.0, 30.0)
LOOKS = ((0.9, 20.0), (1.8, 30.0), (0.9, 30.0), (2.7, 15.0), (1.8, 45.0))
"""Slices in mm and noise in HU, which go around."""
READ_CTS = ("lidc-0314", "lidc-0001")
CLICKS = 6


def add_phantoms(result: Result, seed: int, quick: bool) -> None:
    """Add the Dice of each kind on one phantom."""
    places = Places(make_phantom(seed=seed, spacing_mm=SPACING_MM, size="small", noise_hu=0.0))
    for shift, kind in enumerate(KINDS):
        scores, refused, cpu = [], 0, 0.0
        for n, diameter_mm in enumerate(DIAMETERS_MM[:2] if quick else DIAMETERS_MM):
            # One look is left out from each kind to the next, so that sizes meet all of them.
            slice_mm, noise_hu = LOOKS[(n + shift * (len(DIAMETERS_MM) + 1)) % len(LOOKS)]
            case = nodule_case(places, kind, diameter_mm, slice_mm, noise_hu, seed)
            start = time.process_time()
            try:
                scores.append(dice(outline_nodule(case.ct, case.lungs, case.click_lps), case.truth))
            except AnatomyError:
                refused += 1
            cpu = max(cpu, time.process_time() - start)
        result.add(
            f"phantom {seed}, {kind}: Dice of those outlined",
            float(np.mean(scores)) if scores else 0.0,
            note=f"least {min(scores, default=0.0):.2f}, {refused} refused, at most {cpu:.2f} s of CPU",
        )


def add_readers(result: Result, name: str) -> None:
    """Add Dice and sizes on a CT whose nodule was outlined by readers."""
    ct = canonical(read_volume(require_data(f"ct/{name}/ct.nii.gz")))
    contours = require_data(f"ct/{name}/nodule_contours.json")
    truth = nodule_from_contours(contours, ct.grid)
    readers = [
        annotation_mask(each, ct.grid, contours) for each in json.loads(contours.read_text())["annotations"]
    ]
    lungs, inner = segment_lungs(ct).mask, ct.grid.lps(np.argwhere(truth))
    chosen = np.random.default_rng(0).choice(len(inner), CLICKS - 1)
    clicks = [centre_of(truth, ct.grid), *inner[chosen]]
    found = [outline_nodule(ct, lungs, click) for click in clicks]
    _add_masks(result, f"{name}, clicks", found, truth, ct)
    _add_masks(result, f"{name}, readers", readers, truth, ct)


def _add_masks(result: Result, name: str, masks: list[Mask], truth: Mask, ct: Volume) -> None:
    scores: Float = np.array([dice(mask, truth) for mask in masks])
    sizes = [nodule_size(np.argwhere(mask), ct.grid) for mask in masks]
    words = "; ".join(
        f"{s.volume_ml:.2f} ml, {s.long_axis_mm:.1f} x {s.perpendicular_mm:.1f} mm" for s in sizes
    )
    note = f"{scores.min():.2f} to {scores.max():.2f}; {words}"
    result.add(f"{name}: Dice with the readers' majority", float(scores.mean()), note=note)


def main() -> None:
    """Run the study and store its result."""
    options = study_parser(__doc__).parse_args()
    result = Result(
        name="nodules", title="Nodules outlined from a point",
        setting=setting_of(options), seeds=list(SEEDS), conditions={"phantoms": f"small, {SPACING_MM:g} mm"},
    )  # fmt: skip
    for seed in SEEDS[:1] if options.quick else SEEDS:
        add_phantoms(result, seed, options.quick)
    if data_folder() is not None:
        for name in READ_CTS:
            add_readers(result, name)
    print(write_result(result, options.results))


if __name__ == "__main__":
    main()

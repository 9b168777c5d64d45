"""Lobes and fissures of CTs whose truth is known: overlap of lobes, and distances between fissures.

    python -m experiments.lobes [--quick] [--seed 0] [--results FOLDER] [--patients NAME ...]

CTs are rendered from masks.  Those of a synthetic patient have true lobes, and parts of the fissures can be
left out.  Those of a real patient have true fissures alone: their masks have gaps, and part no lobes.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from anatomy.errors import AnatomyError
from anatomy.grid import Volume
from anatomy.io import load_patient
from anatomy.lobes import LOBES
from anatomy.phantom import make_phantom
from anatomy.records import frozen_record
from anatomy.segmentation.airway import segment_airway
from anatomy.segmentation.lobes import SEEN, Lobes, segment_lobes
from anatomy.segmentation.lungs import segment_lungs
from anatomy.segmentation.vessels import segment_vessels
from anatomy.typed import Array, Float, Mask
from experiments.support.anatomies import PATIENTS, data_folder, require_data
from experiments.support.results import Result, setting_of, study_parser, write_result
from experiments.support.segmentation.synthetic_ct import CtLook, SyntheticCt, render_ct

ASKED_DICE, ASKED_MM = 0.95, 1.5
SPACING_MM, QUICK_SPACING_MM = 0.8, 1.25
MISSING_SHARES = (0.0, 0.4)
"""Share of the fissures that is left out, from the hilum outwards, where they are incomplete most often."""


@frozen_record
class Case:
    """A rendered CT and its true lobes `(ni, nj, nk)`, 0 everywhere where only its fissures are known."""

    name: str
    made: SyntheticCt
    fissures: Mask
    lobes: Array


def phantom_case(seed: int, missing: float, look: CtLook) -> Case:
    """Return a synthetic patient; a share of its fissures, what is nearest to the carina, is not drawn."""
    phantom = make_phantom(seed=seed)
    truth = phantom.mask("fissure")
    places = np.argwhere(truth)
    far_mm = np.linalg.norm(phantom.grid.lps(places), axis=1)
    drawn = np.zeros_like(truth)
    drawn[tuple(places[far_mm >= np.quantile(far_mm, missing)].T)] = True
    images = replace(phantom.images, fissures=Volume(grid=phantom.grid, array=drawn))
    made = render_ct(images, look)
    words = f", {missing:.0%} of the fissures missing" if missing else ""
    whole, lobes = (_nearest(each, phantom.images.lung, made.ct) for each in (truth, phantom.lobes.array))
    return Case(name=f"phantom {seed}{words}", made=made, fissures=whole, lobes=lobes)


def _nearest(array: Array, source: Volume, target: Volume) -> Array:
    """Return what an array on one grid holds at the voxels of another whose axes are parallel."""
    start, step = source.grid.ijk(target.grid.lps((0, 0, 0))), target.grid.spacing_mm / source.grid.spacing_mm
    axes = [
        np.rint(first + each * np.arange(n)).astype(int)
        for first, each, n in zip(start, step, target.grid.shape, strict=True)
    ]
    inside = [(at >= 0) & (at < n) for at, n in zip(axes, array.shape, strict=True)]
    found = np.zeros(target.grid.shape, dtype=array.dtype, order="F")
    found[np.ix_(*inside)] = array[np.ix_(*(at[ok] for at, ok in zip(axes, inside, strict=True)))]
    return found


def patient_case(name: str, look: CtLook) -> Case:
    """Return a patient of Med-RAD."""
    made = render_ct(load_patient(require_data(f"med-rad/{name}")), look)
    return Case(name=name, made=made, fissures=made.fissures, lobes=np.zeros(made.lung.shape, dtype=np.uint8))


def segmented(case: Case) -> tuple[Lobes, Mask, float]:
    """Return the lobes of a CT, its lungs, and the CPU time of the lobes alone in s."""
    ct = case.made.ct
    lungs = segment_lungs(ct)
    airways = segment_airway(ct, lungs)
    vessels = segment_vessels(ct, lungs.mask, airways)
    began = time.process_time()
    found = segment_lobes(ct, lungs, airways, vessels.mask)
    return found, lungs.mask, time.process_time() - began


def dices(found: Array, truth: Array, where: Mask) -> dict[str, float]:
    """Return the Dice of each lobe within the lungs that both have."""
    scores = {}
    for number, name in LOBES.items():
        one, other = (found == number) & where, (truth == number) & where
        scores[name] = (
            2.0 * np.count_nonzero(one & other) / max(np.count_nonzero(one) + np.count_nonzero(other), 1)
        )
    return scores


def distances_mm(of: Mask, to: Mask, spacing_mm: Float) -> Float:
    """Return the distance from each voxel of one mask to the nearest of another."""
    from anatomy.segmentation.closing import distance_mm

    if not to.any():
        raise AnatomyError("No fissure was found", expected="a mask that is not empty")
    return np.asarray(distance_mm(~to, spacing_mm)[of], dtype=np.float64)


def add_rows(result: Result, case: Case) -> None:
    """Segment a case, and add its scores."""
    found, lungs, cpu_s = segmented(case)
    spacing = case.made.ct.grid.spacing_mm
    both = lungs & case.made.lung
    if case.lobes.any():
        scores = dices(found.lobes, case.lobes, both & (case.lobes > 0))
        least = min(scores, key=lambda name: scores[name])
        result.add(f"{case.name}: Dice of the worst lobe", scores[least], note=f"{least}; asked {ASKED_DICE}")
    for words, of, to in (
        ("from the true to the found border", case.fissures & both, found.fissures > 0),
        ("from fissures seen to the truth", found.fissures == SEEN, case.fissures),
    ):
        at = np.percentile(distances_mm(of, to, spacing), [50, 90, 95])
        note = f"90 %: {at[1]:.1f} mm, 95 %: {at[2]:.1f} mm; asked {ASKED_MM} mm"
        result.add(f"{case.name}: median distance {words}", float(at[0]), unit="mm", note=note)
    for name, share in found.seen.items():
        result.add(f"{case.name}: {name} seen", 100.0 * share, unit="%")
    result.add(f"{case.name}: CPU time of lobes and fissures", cpu_s, unit="s")


def main() -> None:
    """Measure, print, and write the result."""
    parser = study_parser(__doc__)
    patients = () if data_folder() is None else PATIENTS
    parser.add_argument("--patients", nargs="*", default=patients, metavar="NAME")
    options = parser.parse_args()
    look = CtLook(spacing_mm=QUICK_SPACING_MM if options.quick else SPACING_MM, seed=options.seed)
    result = Result(
        name="lobes", title="Lobes and fissures where the truth is known", setting=setting_of(options),
        conditions={
            "CT": f"rendered from masks: {look.spacing_mm:g} mm, noise {look.noise_hu:g} HU, texture "
            f"{look.texture_hu:g} HU, point spread {look.psf_mm:g} mm, fissures of {look.fissure_mm:g} mm",
            "lungs, airways, vessels": "segmented from the same CT",
        },
        seeds=[options.seed],
    )  # fmt: skip
    for missing in MISSING_SHARES:
        add_rows(result, phantom_case(options.seed + 1, missing, look))
    for name in options.patients:
        add_rows(result, patient_case(name, look))
    print(write_result(result, options.results))


if __name__ == "__main__":
    main()

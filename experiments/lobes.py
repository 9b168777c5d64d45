"""Lobes and fissures of CTs whose truth is known: overlap of lobes, and distances between fissures.

    python -m experiments.lobes [--quick] [--seed 1] [--results FOLDER] [--patients NAME ...]

CTs are rendered from masks.  Those of synthetic patients have true lobes, and parts of the fissures can be
left out.  Those of Med-RAD have true fissures alone, with gaps, or true lobes alone.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Array, Float, Mask
from anatomy.grid import Volume
from anatomy.io import load_patient
from anatomy.io.masks import place
from anatomy.lobes import LOBES
from anatomy.phantom import make_phantom
from anatomy.phantom.patient import Size
from anatomy.segmentation.airway import Airways, segment_airway
from anatomy.segmentation.canonical import canonical
from anatomy.segmentation.lobes import FISSURES, OF_LUNG, SEEN, Lobes, segment_lobes
from anatomy.segmentation.lungs import segment_lungs
from anatomy.segmentation.scan_warnings import tree_or_error
from anatomy.segmentation.vessels import segment_vessels
from experiments.support.anatomies import PATIENTS, data_folder, require_data
from experiments.support.results import Result, setting_of, study_parser, write_result
from experiments.support.segmentation.synthetic_ct import CtLook, SyntheticCt, middle_sheet, render_ct

ASKED_DICE, ASKED_MM = 0.95, 1.5
SPACING_MM, COARSE_MM = 0.8, 1.25
MISSING_SHARES = (0.0, 0.2, 0.4, 0.6)
"""Share of the fissures that is left out, from the hilum outwards, where they are incomplete most often."""
WITH_LOBES = "med-rad-respiratory/Patient2"
"""A patient with masks of the lobes, from which fissures are drawn.  The trachea lies above the tissue that
is drawn around the lungs, so that the airways are those of the masks."""


@frozen_record
class Case:
    """A rendered CT and its truth.

    `fissures_lps` are points (N, 3) on the fissures; `lobes` `(ni, nj, nk)` is 0 everywhere where they are
    not known; `drawn` is the share of each fissure that the CT shows, if that is known.  Airways are
    segmented like the rest if they are None.
    """

    name: str
    made: SyntheticCt
    fissures_lps: Float
    lobes: Array
    drawn: Mapping[str, float]
    airways: Airways | None = None


def phantom_case(seed: int, missing: float, look: CtLook, size: Size = "adult") -> Case:
    """Return a synthetic patient; a share of its fissures, what is nearest to the carina, is not drawn."""
    phantom = make_phantom(seed=seed, size=size)
    truth, lobes = phantom.mask("fissure"), phantom.lobes.array
    places = np.argwhere(truth)
    far_mm = np.linalg.norm(phantom.grid.lps(places), axis=1)
    drawn = np.zeros_like(truth)
    drawn[tuple(places[far_mm >= np.quantile(far_mm, missing)].T)] = True
    images = replace(phantom.images, fissures=Volume(grid=phantom.grid, array=drawn))
    made = render_ct(images, look)
    shares = {}
    for name, sides in FISSURES.items():
        one, other = (np.isin(lobes, side) for side in sides)
        shares[name] = float(drawn[truth & binary_dilation(one) & binary_dilation(other)].mean())
    words = f", {missing:.0%} of the fissures missing" if missing else ""
    return Case(
        name=f"{'child' if size == 'small' else 'phantom'} {seed}, {look.spacing_mm:g} mm{words}",
        made=made,
        fissures_lps=phantom.grid.lps(places),
        lobes=_nearest(lobes, phantom.images.lung, made.ct),
        drawn=shares,
    )


def _nearest(array: Array, source: Volume, target: Volume) -> Array:
    """Return what an array on one grid holds at the voxels of another whose axes are parallel."""
    return np.asarray(place(array, source.grid, target.grid).array)


def patient_case(part: str, look: CtLook) -> Case:
    """Return a patient below LUNGACCESS_DATA, whose fissures are a mask or the borders of its lobes."""
    images = load_patient(require_data(part))
    if images.fissures is None:
        raise AnatomyError(f"{part} has no fissures", expected="a patient with fissures or lobes")
    made = upright(render_ct(images, look))
    sheet = middle_sheet(images.fissures.array & images.lung.array, images.grid.spacing_mm)
    lobes = np.zeros(made.lung.shape, dtype=np.uint8)
    if images.lobes is not None:
        lobes = _nearest(images.lobes.array, images.lobes, made.ct)
    return Case(
        name=f"{part}, {look.spacing_mm:g} mm",
        made=made,
        fissures_lps=images.grid.lps(np.argwhere(sheet)),
        lobes=lobes,
        drawn={},
        airways=Airways(lumen=made.lumen, wall=made.wall) if look.convex else None,
    )


def upright(made: SyntheticCt) -> SyntheticCt:
    """Return a rendered CT and its truth in the order of voxels that `segment` brings every CT into."""

    def in_order(mask: Mask) -> Mask:
        return np.asarray(canonical(Volume(grid=made.ct.grid, array=mask)).array)

    names = ("lung", "lumen", "wall", "vessels", "fissures")
    return replace(made, ct=canonical(made.ct), **{name: in_order(getattr(made, name)) for name in names})


def segmented(case: Case) -> tuple[Lobes, Mask, float]:
    """Return the lobes of a CT, its lungs, and the CPU time of the lobes alone in s."""
    ct = case.made.ct
    lungs = segment_lungs(ct)
    airways = case.airways or segment_airway(ct, lungs)
    vessels = segment_vessels(ct, lungs.mask, airways)
    began = time.process_time()
    tree = tree_or_error(Volume(grid=ct.grid, array=airways.lumen))
    found = segment_lobes(ct, lungs, airways, vessels.mask, tree)
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


def distances_mm(of: Float, to: Float) -> Float:
    """Return the distance from each point `(N, 3)` of one set to the nearest of another, mm."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(to).query(of)[0])


def add_rows(result: Result, case: Case) -> None:
    """Segment a case, and add its scores."""
    found, lungs, cpu_s = segmented(case)
    grid, both = case.made.ct.grid, lungs & case.made.lung
    claimed = {side: bool(np.isin(found.lobes, lobes).any()) for side, lobes in OF_LUNG.items()}
    for side, known in claimed.items():
        if not known:
            result.add(f"{case.name}: lobes of the {side} lung", None, note="not claimed, with a warning")
    if case.lobes.any() and all(claimed.values()):
        scores = dices(found.lobes, case.lobes, both & (case.lobes > 0))
        least = min(scores, key=lambda name: scores[name])
        result.add(f"{case.name}: Dice of the worst lobe", scores[least], note=f"{least}; asked {ASKED_DICE}")
    ijk = np.rint(grid.ijk(case.fissures_lps)).astype(np.int64)
    inside = ((ijk >= 0) & (ijk < grid.shape)).all(axis=1)
    inside[inside] = both[tuple(ijk[inside].T)]
    seen, border = (grid.lps(np.argwhere(mask)) for mask in (found.fissures == SEEN, found.fissures > 0))
    for words, of, to in (
        ("from the true to the found border", case.fissures_lps[inside], border),
        ("from fissures seen to the truth", seen, case.fissures_lps),
    ):
        if len(of) and len(to) and all(claimed.values()):
            at = np.percentile(distances_mm(of, to), [50, 75, 90, 95])
            rest = ", ".join(f"{p} %: {value:.1f}" for p, value in zip((75, 90, 95), at[1:], strict=True))
            note = f"{rest} mm; asked {ASKED_MM} mm"
            result.add(f"{case.name}: median distance {words}", float(at[0]), unit="mm", note=note)
    for name, share in found.seen.items():
        truth = f"{case.drawn[name]:.0%} of it are drawn" if name in case.drawn else ""
        result.add(f"{case.name}: {name} seen", 100.0 * share, unit="%", note=truth)
    result.add(f"{case.name}: CPU time of lobes and fissures", cpu_s, unit="s")


def main() -> None:
    """Measure, print, and write the result."""
    parser = study_parser(__doc__)
    real = () if data_folder() is None else (*(f"med-rad/{name}" for name in PATIENTS), WITH_LOBES)
    parser.add_argument("--patients", nargs="*", default=real, metavar="NAME")
    options = parser.parse_args()
    fine, coarse = (CtLook(spacing_mm=mm, seed=options.seed) for mm in (SPACING_MM, COARSE_MM))
    look = coarse if options.quick else fine
    result = Result(
        name="lobes", title="Lobes and fissures where the truth is known", setting=setting_of(options),
        conditions={
            "CT": f"rendered from masks: noise {look.noise_hu:g} HU, texture {look.texture_hu:g} HU, point "
            f"spread {look.psf_mm:g} mm, fissures of {look.fissure_mm:g} mm",
            "lungs, airways, vessels": "segmented from the same CT",
        },
        seeds=[options.seed],
    )  # fmt: skip
    for missing in MISSING_SHARES[::2] if options.quick else MISSING_SHARES:
        add_rows(result, phantom_case(options.seed, missing, look))
    if not options.quick:
        add_rows(result, phantom_case(options.seed + 1, 0.0, coarse))
    add_rows(result, phantom_case(options.seed + 2, 0.0, coarse, "small"))
    for name in options.patients:
        add_rows(result, patient_case(name, replace(look, convex=name == WITH_LOBES)))
    print(write_result(result, options.results))


if __name__ == "__main__":
    main()

"""How often the true fissure lies in its band, and how good lobes are, by slices and by how much is seen.

    python -m experiments.fissure_band [--seed 71] [--seeds N ...] [--slices MM ...] [--fissures MM ...]

A CT is rendered from a phantom whose fissures are as thick as is said, 0 for none that can be seen, averaged
over slices, and segmented like any other.  Seeds 61 and 62 had a part in choosing the widths of the band.
"""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import UInt8
from anatomy.grid import Volume
from anatomy.io.masks import place
from anatomy.lobes import LOBES, UNKNOWN, fissures_between
from anatomy.morphology import largest_piece
from anatomy.phantom.patient import Size
from anatomy.segmentation.airway import segment_airway
from anatomy.segmentation.box import VOXEL_MM, Box
from anatomy.segmentation.canonical import canonical
from anatomy.segmentation.lobes import OF_LUNG, Lobes, segment_lobes
from anatomy.segmentation.lungs import Lungs, segment_lungs
from anatomy.segmentation.scan_warnings import tree_or_error
from anatomy.segmentation.vessels import segment_vessels
from experiments.lobes import SPACING_MM, Case, dices, phantom_case
from experiments.support.results import Result, setting_of, study_parser, write_result
from experiments.support.segmentation.slices import thickened
from experiments.support.segmentation.synthetic_ct import CtLook

SLICES_MM, FISSURES_MM = (1.0, 2.0, 3.0, 5.0), (0.5, 0.05, 0.0)


def segmented(case: Case, slice_mm: float) -> tuple[Lobes, Lungs, UInt8]:
    """Return the lobes of a case in slices, its lungs, and the true lobes on the same voxels."""
    ct = canonical(thickened(case.made.ct, slice_mm))
    found = segment_lungs(ct)
    box = Box.whole(ct.grid, VOXEL_MM).around(found)
    image, lungs = box.image(ct), box.lungs(found)
    airways = segment_airway(image, lungs)
    vessels = segment_vessels(image, lungs.mask, airways).mask
    tree = tree_or_error(Volume(grid=image.grid, array=airways.lumen))
    truth = np.asarray(place(case.lobes, case.made.ct.grid, image.grid).array)
    return segment_lobes(image, lungs, airways, vessels, tree), lungs, truth


def add_rows(result: Result, name: str, case: Case, slice_mm: float) -> None:
    """Segment a case in slices, and add its scores, of each lung by itself."""
    found, lungs, truth = segmented(case, slice_mm)
    scores = dices(found.lobes, truth, lungs.mask & (truth > 0))
    for side, lobes in OF_LUNG.items():
        whole = np.zeros(truth.shape, dtype=np.uint8)
        for lobe in lobes:
            whole[largest_piece(truth == lobe)] = lobe
        fissure, lung = fissures_between(whole) & lungs.mask, np.isin(found.lobes, lobes)
        if not lung.any():
            result.add(f"{name}: {side} lung", None, note="not known, with a warning")
            continue
        band = (found.fissures > 0) & (found.fissures < UNKNOWN)
        shares = {name: f"{share:.0%}" for name, share in found.seen.items() if name.startswith(side)}
        notes = f"seen: {shares}; the band is {band[lung].mean():.0%} of the lung"
        result.add(
            f"{name}: {side} fissures in their band", 100.0 * band[fissure].mean(), unit="%", note=notes
        )
        for lobe in lobes:
            result.add(f"{name}: Dice of the {LOBES[lobe]}", scores[LOBES[lobe]])


def main() -> None:
    """Measure, print, and write the result."""
    parser = study_parser(__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[71, 72, 73])
    parser.add_argument("--slices", type=float, nargs="+", default=SLICES_MM, metavar="MM")
    parser.add_argument("--fissures", type=float, nargs="+", default=FISSURES_MM, metavar="MM")
    parser.add_argument("--size", default="small", choices=("small", "adult"))
    options = parser.parse_args()
    result = Result(
        name="fissure_band", title="The band of the fissures", setting=setting_of(options),
        conditions={"phantoms": f"{options.size}, rendered at {SPACING_MM} mm, averaged over slices"},
        seeds=options.seeds,
    )  # fmt: skip
    size: Size = options.size
    for seed in options.seeds:
        for fissure_mm in options.fissures:
            case = phantom_case(
                seed, 0.0, CtLook(spacing_mm=SPACING_MM, seed=seed, fissure_mm=fissure_mm), size
            )
            for slice_mm in options.slices:
                name = f"phantom {seed}, fissures of {fissure_mm:g} mm, slices of {slice_mm:g} mm"
                add_rows(result, name, case, slice_mm)
    print(write_result(result, options.results))


if __name__ == "__main__":
    main()

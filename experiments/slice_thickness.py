"""What thick slices cost: the share of peripheral targets for which there is a plan, by the slices of the CT.

    python -m experiments.slice_thickness [--quick] [--results FOLDER] [--cts NAME ...] [--system NAME]

Each CT is averaged over thicker slices, segmented, and planned on.  The targets are drawn in the segmentation
of the finest slices and stay at their place in the patient.  A target that lies in an obstacle of a
segmentation has no plan on it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

import lungaccess as la
from anatomy.base.errors import LungaccessError
from anatomy.base.typed import Float
from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.phantom import make_phantom
from anatomy.segmentation.pipeline import read_ct, segment
from anatomy.segmentation.request import SegmentationRequest
from experiments.support.anatomies import PHANTOM, data_folder, require_data
from experiments.support.results import Result, setting_of, study_parser, write_result
from experiments.support.segmentation.slices import thickened
from lungaccess.planning.coupled.atlas import build_atlas
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.system import System
from lungaccess.problem.target import point_target

CTS = ("lidc-0314", "chest-cta")
SLICES_MM: Mapping[str, tuple[float, ...]] = {"lidc-0314": (1.0, 2.0, 3.0), "chest-cta": (1.5, 2.0, 3.0)}
PHANTOM_MM, PHANTOM_SLICES_MM = 0.7, (0.7, 1.0, 2.0, 3.0)
TARGETS_A_LUNG, QUICK_TARGETS_A_LUNG = 20, 4
ITERATIONS = 300
"""Of the search for a first plan; more add one target in twenty or fewer."""
MOST_LOSS = 15.0
"""Asked: so many percent of the share at the finest slices may be lost."""


def cts(name: str, quick: bool, seed: int) -> Iterator[tuple[float, Volume]]:
    """Yield the distance of slices and the CT, the finest first."""
    if name == PHANTOM:
        ct, slices = make_phantom(seed=seed, size="small", spacing_mm=PHANTOM_MM).ct, PHANTOM_SLICES_MM
    else:
        path = Path(name) if Path(name).exists() else require_data(f"ct/{name}/ct.nii.gz")
        ct = read_ct(path)[0]
        finest = round(float(ct.grid.spacing_mm[2]), 2)
        slices = SLICES_MM.get(name, tuple(sorted({finest, 2.0, 3.0})))
    for slice_mm in (slices[0], slices[-1]) if quick else slices:
        yield slice_mm, ct if slice_mm == slices[0] else thickened(ct, slice_mm)


def planned(lung: Lung, system: System, targets: Float, seed: int) -> list[bool]:
    """Tell for each target whether a plan is found."""
    atlas, found = build_atlas(lung, system), []
    for target in targets:
        try:
            next(
                la.plan(
                    lung,
                    system,
                    point_target(lung, target),
                    atlas=atlas,
                    seed=seed,
                    iterations=ITERATIONS,
                    goal="default",
                )
            )
        except LungaccessError:
            found.append(False)
        else:
            found.append(True)
    return found


def add_rows(result: Result, name: str, work: Path, system: System, quick: bool, seed: int) -> None:
    """Segment and plan on one CT at each thickness, and add what came of it."""
    targets, best, title = np.zeros((0, 3)), np.zeros(2), Path(name).stem
    for slice_mm, ct in cts(name, quick, seed):
        folder = work / f"{title}-{slice_mm:g}"
        tree = segment(SegmentationRequest(ct=ct, out=folder, name=title)).parts.tree
        lung = la.load_patient(folder, cache=work / "cache")
        if not len(targets):
            targets = peripheral_targets(lung, QUICK_TARGETS_A_LUNG if quick else TARGETS_A_LUNG, seed)
        counts = np.array(planned(lung, system, targets, seed)).reshape(2, -1).sum(axis=1)
        best = best if best.any() else counts
        words = f"{title}, slices of {slice_mm:g} mm"
        half = targets.shape[0] // 2
        note = f"left {counts[0]}, right {counts[1]} of {half}; asked: at most {MOST_LOSS:g} % lost"
        result.add(f"{words}: targets with a plan", 50.0 * float(counts.sum()) / half, unit="%", note=note)
        if not isinstance(tree, LungaccessError):
            result.add(f"{words}: length of the airway", float(tree.branch_length_mm.sum()), unit="mm")
        print(f"{words}: {note}", flush=True)


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--cts", nargs="+", default=(PHANTOM,) if data_folder() is None else (*CTS, PHANTOM))
    parser.add_argument("--system", default="lung-default")
    options = parser.parse_args()
    system = la.load_system(options.system, fissures_allowed=True)
    result = Result(
        name="slice_thickness", title="Targets with a plan, by the slices of the CT",
        setting=setting_of(options), seeds=[options.seed],
        conditions={
            "system": f"{options.system}, fissures may be crossed",
            "slices": "means of the CT's own; pixels as they are",
            "targets": "random peripheral points of the finest segmentation, at the same place in all",
            "planned": f"a first plan in {ITERATIONS} iterations",
        },
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as work:
        for name in options.cts:
            add_rows(result, name, Path(work), system, options.quick, options.seed)
    print(write_result(result, options.results))


if __name__ == "__main__":
    main()

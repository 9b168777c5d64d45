"""What is at a point of the lung: its tissue, its lobe, and how far every structure is away."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import TargetError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.io.frames import MOST_COORDINATE_MM
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, FISSURE, LUMEN, OUTSIDE, VESSEL, obstacle_bits

CAP_MM = 30.0
"""Distances are measured up to here: farther structures do not limit a needle."""
TISSUES = (
    (OUTSIDE, "outside the lung"), (LUMEN, "airway lumen"), (AIRWAY, "airway wall"), (VESSEL, "vessel"),
    (FISSURE, "fissure"),
)  # fmt: skip
"""The first one of a voxel names its tissue."""


@frozen_record
class Place:
    """A point of the lung.

    Args:
        lps_mm: (3,) float64, LPS mm.
        tissue: What its voxel is: one of `TISSUES`, "nodule" or "lung tissue".
        lobe: Its lobe, or the nearest within 10 mm; "" if not known.
        distance_mm: Distance to the nearest voxel of "airway", "vessel", "pleura" and, where the patient has
            a mask of them, "fissure", voxels as solid boxes; `CAP_MM` where it is that or more, 0 inside.
        generation: Of the airway branch nearest to the point.
        may_be_target: Whether a needle may end here, as far as the voxel goes.
    """

    lps_mm: Float
    tissue: str
    lobe: str
    distance_mm: Mapping[str, float]
    generation: int
    may_be_target: bool


def describe_place(lung: Lung, lps_mm: ArrayLike) -> Place:
    """Return what is at a point `(3,)` LPS mm.

    Raises:
        TargetError: If the point is not three finite numbers.
    """
    point = np.array(lps_mm, dtype=np.float64)
    if point.shape != (3,) or not (np.abs(point) <= MOST_COORDINATE_MM).all():
        raise TargetError(
            f"The place {point.tolist()} is not a point", expected="three finite numbers, LPS mm"
        )
    label = lung.label_at(point)
    structures = {"airway": AIRWAY | LUMEN, "vessel": VESSEL, "pleura": OUTSIDE}
    if lung.has_fissures:
        structures["fissure"] = FISSURE
    nearest = int(np.argmin(np.linalg.norm(lung.tree.points_lps - point, axis=1)))
    return Place(
        lps_mm=point,
        tissue=next((name for bit, name in TISSUES if label & bit), _free_tissue(lung, point)),
        lobe=lung.lobe_at(point),
        distance_mm={
            name: float(lung.exact_clearance_mm(point[None], bits, cap_mm=CAP_MM)[0])
            for name, bits in structures.items()
        },
        generation=int(lung.tree.generation[lung.tree.branch_of_point[nearest]]),
        may_be_target=label & obstacle_bits(False) == 0,
    )


def _free_tissue(lung: Lung, point: Float) -> str:
    """Name tissue that is no structure."""
    nodules = lung.nodules
    in_nodule = nodules is not None and bool(nodules.at(point, False))
    return "nodule" if in_nodule else "lung tissue"

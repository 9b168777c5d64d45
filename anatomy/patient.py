"""Everything that was read from disk for one patient, on one voxel grid."""

from collections.abc import Mapping
from dataclasses import field
from types import MappingProxyType

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import Grid, Volume, read_only
from anatomy.motion.source import MotionSource

MASKS = ("lumen", "wall", "vessels", "lung", "fissures", "nodules")


@frozen_record
class PatientImages:
    """Masks, poses and points of one patient.

    Args:
        name, kind: What reports call it; where the images come from: "med-rad", "totalsegmentator", "masks"
            or "phantom".
        grid: The voxel grid that all volumes share.
        lumen, vessels, lung: Bool masks: the airway lumen, the union of arteries and veins, both lungs
            filled.
        wall, fissures, nodules: Bool masks; None when the patient has none.
        fissure_band: uint8 values of `anatomy.lobes.UNKNOWN`: where a fissure may lie, and with what chance.
        lobes: uint8 numbers of `anatomy.lobes.LOBES`; 0 is no lobe.
        nodule_labels: uint16 numbers of the nodules by the patient's files, if these tell more than one
            apart; else 0.
        cost: float32 cost of passing a voxel, in [0, 1], or infinity where passing is forbidden.
        starts (tuple of (4, 4) float64): Poses `lps_from_tip` of needle starts, +z in the direction of
            insertion, LPS mm.
        targets_lps (tuple of (3,) float64): Target points, LPS mm.
        start_names, target_names: How users name them; "start1", "target1", ... if not given.
        breath_hold: In which state of breathing the image was taken, if that is stated.
        motion: What is known of the breathing.
        vessel_border_mm: Mean and standard deviation of how far the true vessels reach out of their mask, as
            far as that is known; empty if not, as for masks that came without their CT.
        sources: File name to the SHA-256 of its bytes.
        warnings: What was unusual about the input but did not prevent reading it.
        accepted: Checks of `anatomy.plausibility.CHECKS` whose failure a person has accepted.

    Raises:
        AnatomyError: If a mask is not bool, or the cost is not in [0, 1] or infinite.
        GridMismatchError: If a volume lies on another grid.
    """

    name: str
    kind: str
    grid: Grid
    lumen: Volume
    vessels: Volume
    lung: Volume
    wall: Volume | None = None
    fissures: Volume | None = None
    nodules: Volume | None = None
    fissure_band: Volume | None = None
    lobes: Volume | None = None
    nodule_labels: Volume | None = None
    cost: Volume | None = None
    starts: tuple[Float, ...] = ()
    targets_lps: tuple[Float, ...] = ()
    start_names: tuple[str, ...] = ()
    target_names: tuple[str, ...] = ()
    breath_hold: str | None = None
    motion: MotionSource | None = None
    vessel_border_mm: tuple[float, ...] = ()
    sources: Mapping[str, str] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    accepted: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for role in MASKS:
            mask: Volume | None = getattr(self, role)
            if mask is not None:
                self.grid.require_same(mask.grid, f"the mask {role}")
                if mask.array.dtype != np.bool_:
                    found = f"The mask {role} has the type {mask.array.dtype}"
                    raise AnatomyError(found, expected="bool voxels")
        for name in ("lobes", "fissure_band", "nodule_labels"):
            numbers = getattr(self, name)
            if numbers is not None:
                self.grid.require_same(numbers.grid, f"the {name.replace('_', ' ')}")
        border_mm = self.vessel_border_mm
        # No border that is known lies a centimetre off; so far off the mask is of something else.
        mean, spread = border_mm or (0.0, 0.0) if len(border_mm) in (0, 2) else (np.nan, np.nan)
        if not (abs(mean) <= 10.0 and 0.0 <= spread <= 10.0):
            raise AnatomyError(
                f"The border of the vessels is {list(border_mm)}",
                expected="two numbers in mm: a mean from -10 to 10, and a standard deviation from 0 to 10",
                remedy="Correct vessel_border_mm in patient.toml, or leave it out",
            )
        if self.cost is not None:
            _require_cost(self.cost, self.grid)
        object.__setattr__(self, "starts", tuple(read_only(np.array(p, float)) for p in self.starts))
        points = tuple(read_only(np.array(p, float)) for p in self.targets_lps)
        object.__setattr__(self, "targets_lps", points)
        for what, given in (("start", self.starts), ("target", self.targets_lps)):
            names = getattr(self, f"{what}_names") or tuple(f"{what}{n + 1}" for n in range(len(given)))
            object.__setattr__(self, f"{what}_names", names)
        object.__setattr__(self, "sources", MappingProxyType(dict(self.sources)))


def _require_cost(cost: Volume, grid: Grid) -> None:
    grid.require_same(cost.grid, "the cost map")
    values = cost.array
    if values.dtype != np.float32:
        raise AnatomyError(f"The cost map has the type {values.dtype}", expected="float32 voxels")
    # In slabs, which stay in the caches of the processor.
    for first in range(0, values.shape[2], 8):
        part = values[:, :, first : first + 8]
        allowed = (part >= 0) & ((part <= 1) | (part == np.inf))
        if not allowed.all():
            raise AnatomyError(
                f"The cost map holds voxels that are not allowed, such as {part[~allowed][0]:g}",
                expected="costs in [0, 1], and 1000 or infinity where passing is forbidden",
                remedy="Scale the cost map to [0, 1]",
            )

"""What a segmentation makes, also where it ends early because the result is refused."""

from __future__ import annotations

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float32, Mask, UInt8
from anatomy.grid import Volume
from anatomy.segmentation.lungs import Lungs


@frozen_record
class Parts:
    """The images of a segmentation, `(ni, nj, nk)` on the voxels of its box, and the airway's tree or why
    there is none.

    `ct` is the CT on these voxels, in Hounsfield units.

    The nodule is empty if none was given.  Lobes have numbers of `anatomy.lobes.LOBES`; fissures are 1 where
    they are inferred and 2 where they are seen; both are 0 where nothing is known.  Vesselness is in [0, 1],
    cost too, or infinite in obstacles, which the large vessels are.
    """

    ct: Volume
    left: Mask
    right: Mask
    central_airway: Mask
    lumen: Mask
    wall: Mask
    tree: AirwayTree | AnatomyError
    nodule: Mask
    vesselness: Float32
    large_vessels: Mask
    all_vessels: Mask
    lobes: UInt8
    fissures: UInt8
    cost: Float32

    @classmethod
    def begun(
        cls, ct: Volume, lungs: Lungs, lumen: Mask, wall: Mask, tree: AirwayTree | AnatomyError
    ) -> Parts:
        """Return the images of a segmentation that ended with the airway."""
        none = np.zeros(lumen.shape, dtype=np.bool_, order="F")
        return cls(
            ct=ct,
            left=lungs.left,
            right=lungs.right,
            central_airway=lungs.central_airway,
            lumen=lumen,
            wall=wall,
            tree=tree,
            nodule=none,
            vesselness=none.astype(np.float32),
            large_vessels=none,
            all_vessels=none,
            lobes=none.astype(np.uint8),
            fissures=none.astype(np.uint8),
            cost=none.astype(np.float32),
        )


class RefusedError(AnatomyError):
    """What was segmented cannot be the lungs and airways of a patient; `parts` show why."""

    def __init__(self, error: AnatomyError, parts: Parts) -> None:
        super().__init__(error.found, expected=error.expected, remedy=error.remedy)
        self.parts = parts

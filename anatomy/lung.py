"""The patient as the devices see it: one immutable `Lung`."""

from __future__ import annotations

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.fields import DistanceField
from anatomy.grid import Volume
from anatomy.lobes import LOBES
from anatomy.morphology import voxels_in
from anatomy.organ import Organ
from anatomy.records import frozen_record
from anatomy.typed import Float

NEAREST_LOBE_MM = 10.0
"""A place in no lobe, such as a bronchus or vessel, is named after a lobe that is as near as this."""


@frozen_record
class Lung(Organ):
    """The lungs of one patient with their airways, in LPS mm, immutable.

    Parameters
    ----------
    lumen_depth : DistanceField
        Distance from a point in the lumen to the nearest voxel that is not lumen; 0 outside.
    tree : AirwayTree
    lobes : Volume or None
        uint8 numbers of `anatomy.lobes.LOBES` on `grid`, if the patient came with lobes.
    """

    lumen_depth: DistanceField
    tree: AirwayTree
    lobes: Volume | None = None

    def _repr_html_(self) -> str:
        """Return the lung as HTML: what it is, its tree, and the warnings that came with it."""
        from anatomy.display import bullets, side_by_side, table

        rows = [
            ("kind", self.kind),
            ("grid", self.grid.describe()),
            ("breath hold", self.breath_hold or "not stated"),
            ("fissures", "given" if self.has_fissures else "not given"),
            ("nodule mask", "not given" if self.nodules is None else "given"),
            ("cost map", "not given" if self.cost is None else "given"),
            ("start poses, targets", f"{len(self.starts)}, {len(self.targets_lps)}"),
            *self.tree.figures(),
            ("content", self.key[:16]),
        ]
        facts = table(rows, f"Lung of {self.name}") + bullets("Warnings", self.warnings)
        return side_by_side(facts, self.tree.drawing())

    def lobe_at(self, point_lps: Float) -> str:
        """Return the name of the lobe that holds a point `(3,)` LPS mm or is near it; "" if not known."""
        if self.lobes is None:
            return ""
        window = self.grid.window(point_lps, NEAREST_LOBE_MM)
        voxels = voxels_in(window, self.lobes.array[window] > 0)
        if not len(voxels):
            return ""
        distance = np.linalg.norm(self.grid.lps(voxels) - point_lps, axis=1)
        nearest = int(np.argmin(distance))
        number = int(self.lobes.array[tuple(voxels[nearest])])
        return LOBES[number] if distance[nearest] <= NEAREST_LOBE_MM else ""

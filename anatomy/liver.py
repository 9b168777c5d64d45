"""A liver as a needle sees it: the liver is where it may go, veins and artery are what it avoids."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Mask
from anatomy.build import AS_READ, WorkingBox, clearance_fields, lung_key
from anatomy.grid import Grid, Volume
from anatomy.morphology import voxels_in
from anatomy.organ import Organ
from anatomy.structures import AIRWAY, BRANCH_SHIFT, OUTSIDE, VESSEL, close_border

ENTRY_BRANCH = 0
"""The branch of the labels that stands for the surface a needle pierces; a liver has no other."""


@frozen_record
class LiverImages:
    """What was read from disk for one liver, on one grid; shared fields are those of `PatientImages`.

    Liver and nodules are bool masks; the nodules are None if there is no mask of them.  The vessels by name,
    such as "portal-vein", are obstacles of a needle, and what a catheter moves in.
    """

    name: str
    kind: str
    grid: Grid
    liver: Volume
    lumens: Mapping[str, Volume]
    nodules: Volume | None
    starts: tuple[Float, ...]
    start_names: tuple[str, ...]
    targets_lps: tuple[Float, ...]
    target_names: tuple[str, ...]
    sources: Mapping[str, str]
    warnings: tuple[str, ...]

    @property
    def vessels(self) -> Mask:
        """The voxels of all vessels together."""
        return np.asarray(np.logical_or.reduce([volume.array for volume in self.lumens.values()]))

    @property
    def inside(self) -> Mask:
        """The voxels of liver, nodules and vessels: masks of a liver leave the other two out."""
        inside = self.liver.array | self.vessels
        return inside if self.nodules is None else inside | self.nodules.array


def build_liver(images: LiverImages) -> Organ:
    """Make the `Organ` of a liver: what is not inside is an obstacle, and so are the vessels."""
    inside = images.inside
    box = WorkingBox(inside, images.grid)
    labels = np.zeros(box.grid.shape, dtype=np.uint16, order="F")
    labels[~box.cut(inside)] = OUTSIDE
    close_border(labels)
    labels[box.cut(images.vessels)] |= VESSEL
    nodules = images.nodules
    taken: dict[str, Any] = {name: getattr(images, name) for name in AS_READ}
    return Organ(
        **taken,
        key=lung_key(images.sources),
        grid=box.grid,
        labels=labels,
        fields=clearance_fields(labels, box.grid),
        nodules=None if nodules is None else Volume(grid=box.grid, array=box.cut(nodules.array)),
        cost=None,
        breath_hold=None,
        warnings=images.warnings,
    )


def with_entry(organ: Organ, start_lps: Float, radius_mm: float) -> Organ:
    """Return an organ whose surface near a start counts as a wall that the needle pierces there.

    What is outside within `radius_mm` of the start `(3,)` LPS mm gets the labels of an airway branch,
    `ENTRY_BRANCH`, so that it is exempt for the first millimetres of a needle and an obstacle after them.
    """
    window = organ.grid.window(start_lps, radius_mm)
    outside = voxels_in(window, (organ.labels[window] & OUTSIDE) != 0)
    at = tuple(outside[organ.grid.box_distance_mm(outside, start_lps) <= radius_mm].T)
    labels = organ.labels.copy(order="F")
    labels[at] = (labels[at] & ~np.uint16(OUTSIDE)) | AIRWAY | ((ENTRY_BRANCH + 1) << BRANCH_SHIFT)
    return replace(organ, labels=labels, fields=clearance_fields(labels, organ.grid))

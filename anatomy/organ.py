"""An organ as a needle sees it: labels of every voxel, clearances, and what came with the patient."""

from collections.abc import Mapping
from dataclasses import field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from anatomy import structures
from anatomy.base.errors import AnatomyError, GridMismatchError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Labels
from anatomy.fields import DistanceField, corner_geometry
from anatomy.grid import Grid, Volume, read_only
from anatomy.kernels import field as kernel
from anatomy.plausibility import Finding

if TYPE_CHECKING:
    from anatomy.meshes import SurfaceMesh


@frozen_record
class Organ:
    """A lung or a liver, in LPS mm, immutable; a lung with airways is a `anatomy.lung.Lung`.

    Args:
        name, kind: The patient, and the kind of folder it was read from.
        key: Hash of the content of the inputs and of the way they were processed.
        grid: The working grid: the box of organ, airways and vessels, at least one voxel wider all around.
        labels ((ni, nj, nk) uint16, Fortran-contiguous): Structures and airway branch of every voxel, see
            `anatomy.structures`.
        fields: Clearance to "airway", "vessel", "pleura", "fissure" (if any), and to the nearest of them:
            "obstacle" without fissures, "obstacle_fissure" with them.  The "pleura" of a liver is its
            capsule.
        nodules, cost: Nodule mask; cost map in [0, 1] or infinite.  Both on `grid`.
        nodule_labels: As in `PatientImages`, on `grid`; starts, targets and their names, `breath_hold`,
            `vessel_border_mm` and `sources` are those of it, too.
        warnings: What was assumed or repaired on the way in.
        findings: What the checks of the masks found, see `anatomy.plausibility`; none for masks that were not
            checked.
        folder: Where it is stored; None for one in memory alone, as a changed copy of a stored one is.

    Raises:
        GridMismatchError: If the labels or a field do not fit the grid.
    """

    name: str
    kind: str
    key: str
    grid: Grid
    labels: Labels
    fields: Mapping[str, DistanceField]
    nodules: Volume | None
    cost: Volume | None
    starts: tuple[Float, ...]
    targets_lps: tuple[Float, ...]
    start_names: tuple[str, ...] = ()
    target_names: tuple[str, ...] = ()
    nodule_labels: Volume | None = None
    breath_hold: str | None
    vessel_border_mm: tuple[float, ...] = ()
    sources: Mapping[str, str]
    warnings: tuple[str, ...]
    findings: tuple[Finding, ...] = ()
    folder: Path | None = field(init=False, default=None)

    def __post_init__(self) -> None:
        corners = tuple(n + 1 for n in self.grid.shape)
        wrong = [name for name, each in self.fields.items() if each.corners.shape != corners]
        if self.labels.shape != self.grid.shape or wrong:
            raise GridMismatchError(
                f"The grid does not fit the {wrong[0] + ' field' if wrong else 'labels'} of {self.name}",
                expected=f"labels of the shape {self.grid.shape}, fields of {corners}",
            )
        object.__setattr__(self, "labels", read_only(np.asarray(self.labels)))
        object.__setattr__(self, "fields", MappingProxyType(dict(self.fields)))
        object.__setattr__(self, "sources", MappingProxyType(dict(self.sources)))

    @property
    def has_fissures(self) -> bool:
        """Whether a fissure mask came with the patient."""
        return "fissure" in self.fields

    @cached_property
    def geometry(self) -> Float:
        """The `(3, 6)` array that maps LPS mm to voxel corners, for kernels."""
        return corner_geometry(self.grid)

    def obstacle_field(self, *, with_fissures: bool) -> DistanceField:
        """Return the clearance to everything forbidden."""
        return self.fields["obstacle_fissure" if with_fissures and self.has_fissures else "obstacle"]

    def mask(self, name: str) -> Volume:
        """Return a structure as a bool volume: airway, lumen, vessel, outside, fissure or nodule.

        "lung" is what is not outside: the lungs with all that lies in them, or the liver.
        """
        if name == "lung":
            return Volume(grid=self.grid, array=(self.labels & structures.OUTSIDE) == 0)
        if name == "nodule":
            if self.nodules is None:
                raise AnatomyError(
                    f"Patient {self.name} has no nodule mask", remedy="Name a target point instead"
                )
            return self.nodules
        if name not in structures.BITS:
            raise AnatomyError(
                f"There is no structure {name!r}",
                expected=f"one of {', '.join(structures.BITS)}, lung, nodule",
            )
        return Volume(grid=self.grid, array=(self.labels & structures.BITS[name]) != 0)

    def surface(self, name: str) -> "SurfaceMesh":
        """Return the mesh of the faces of the voxels of a structure (see `mask`), made anew at each call."""
        from anatomy.meshes import box_surface

        mask = self.mask(name)
        return box_surface(mask.array, mask.grid)

    def label_at(self, point_lps: Float) -> int:
        """Return the label of the voxel that holds a point; OUTSIDE beyond the grid."""
        x, y, z = (float(c) for c in point_lps)
        return int(kernel.label_at(self.labels, self.geometry, x, y, z))

    def labels_at(self, points_lps: Float) -> Labels:
        """Return the labels of the voxels that hold points `(..., 3)` LPS mm; OUTSIDE beyond the grid."""
        return self.grid.values_at(self.labels, points_lps, structures.OUTSIDE)

    def exact_clearance_mm(
        self, points_lps: Float, bits: int, *, cap_mm: float, exempt_branch: int = -1
    ) -> Float:
        """Return exact distances in mm to the nearest voxel with any of `bits`, at most `cap_mm`.

        The points are `(N, 3)` LPS mm, the bits structures of `anatomy.structures`.  The cost grows with the
        third power of the cap.  Airway voxels of `exempt_branch` are passed over; -1 for none.
        """
        points = np.ascontiguousarray(np.asarray(points_lps, dtype=np.float64).reshape(-1, 3))
        out = np.zeros(len(points))
        kernel.exact_at(self.labels, self.geometry, points, bits, exempt_branch, float(cap_mm), out)
        return out

    def least_clearance_mm(
        self, points_lps: Float, field: str, bits: int, *, cap_mm: float, exempt_branch: int = -1
    ) -> float:
        """Return the least of the distances of points to structures: exact below a cap, else a lower bound.

        The points, at least one, are `(N, 3)` LPS mm, `field` is the distance field of the structures, and
        the others are as in `exact_clearance_mm`.
        """
        points = np.ascontiguousarray(np.asarray(points_lps, dtype=np.float64).reshape(-1, 3))
        bounds = self.fields[field].lower_bound_mm(points)
        order = np.argsort(bounds, kind="stable")
        if bounds[order[0]] >= cap_mm:
            return float(bounds[order[0]])
        least = kernel.least_exact(
            self.labels, self.geometry, points, order, bounds, bits, exempt_branch, float(cap_mm)
        )
        return float(least)

"""From images to a `Lung`: working grid, labels, airway tree, clearance fields."""

import hashlib
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from anatomy import structures
from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Array, Float, Int, Int32, Mask, UInt16
from anatomy.fields import MAX_STORED, DistanceField, corner_geometry, distance_corners, distance_field
from anatomy.grid import Grid, Volume
from anatomy.lobes import FISSURES_UNKNOWN, UNKNOWN
from anatomy.lung import Lung
from anatomy.mask_findings import mask_findings
from anatomy.morphology import bounds, window
from anatomy.patient import PatientImages
from anatomy.plausibility import warnings_of_findings, with_accepted
from anatomy.sides import border_of, coarse_sides, points_of_sides

Progress = Callable[[str], None]
Keep = Callable[[str, Array], Array]

FORMAT = 5
"""Version of the processing: raise it when the same images give another lung."""

PAD_VOXELS = 2
"""One voxel around the lungs must be outside of them, and the fields look one farther."""


SINGLE_FIELDS = ("airway", "vessel", "pleura", "fissure")
"""The clearance fields that are made of a structure; the others are made of these."""

CUT = ("nodules", "nodule_labels", "cost", "lobes", "fissure_band")
"""The images that a lung holds as they were read, cut to its box."""
AS_READ = ("name", "kind", "starts", "targets_lps", "start_names", "target_names", "sources")
"""The values that an organ holds as they were read; none of them depends on the working grid."""


def lung_key(sources: Mapping[str, str]) -> str:
    """Return the key of the lung made from input files with these hashes."""
    text = json.dumps({"format": FORMAT, "sources": dict(sorted(sources.items()))})
    return hashlib.sha256(text.encode()).hexdigest()[:24]


class Reused:
    """What was made last, and from which arrays: it is made again only where one of these has changed.

    So a patient of which a person corrects a mask is built anew within a second or two, and is the very
    lung that is built without what was made before.
    """

    def __init__(self) -> None:
        self._kept: dict[str, tuple[tuple[Array | None, ...], Any]] = {}

    @classmethod
    def of(cls, images: PatientImages, lung: Lung) -> "Reused":
        """Return what was made when a lung was built from images."""
        reused = cls()
        reused._kept["tree"] = (images.lumen.array,), lung.tree
        reused._kept["lumen_depth"] = (images.lumen.array,), lung.lumen_depth
        for name in CUT:
            volume, cut = getattr(images, name), getattr(lung, name)
            if cut is not None:
                reused._kept[name] = (volume.array, lung.grid.lps_from_ijk), cut.array
        for name in SINGLE_FIELDS:
            if name in lung.fields:
                solid = (lung.labels & structures.FIELD_BITS[name]) != 0
                reused._kept[name] = (solid, lung.grid.spacing_mm), lung.fields[name].corners
        return reused

    def get(self, name: str, sources: tuple[Array | None, ...], make: Callable[[], Any]) -> Any:
        """Return what was made of the same sources, or make and keep it."""
        known = self._kept.get(name)
        if known is None or not all(map(_are_same, known[0], sources)):
            self._kept[name] = known = sources, make()
        return known[1]


def _are_same(one: Array | None, other: Array | None) -> bool:
    if one is None or other is None:
        return one is other
    return one is other or np.array_equal(one, other)


class WorkingBox:
    """The box of some tissue, such as lungs and airways, plus a border, and how to cut images to it."""

    def __init__(self, tissue: Mask, grid: Grid) -> None:
        low, high = bounds(tissue)
        self._start = low - PAD_VOXELS
        self._stop = high + PAD_VOXELS
        self.grid: Grid = grid.crop(self._start, self._stop)

    def cut(self, array: Array) -> Array:
        """Copy the part of `array` in the box; 0 beyond the image."""
        out = np.zeros(self.grid.shape, dtype=array.dtype, order="F")
        source = tuple(
            slice(max(a, 0), min(b, n)) for a, b, n in zip(self._start, self._stop, array.shape, strict=True)
        )
        target = tuple(slice(s.start - a, s.stop - a) for s, a in zip(source, self._start, strict=True))
        out[target] = array[source]
        return out


def build_lung(
    images: PatientImages,
    *,
    key: str | None = None,
    keep: Keep | None = None,
    progress: Progress | None = None,
    reused: Reused | None = None,
) -> Lung:
    """Make the `Lung` of a patient.

    Args:
        key: Key of the inputs; made from `images.sources` if None.
        keep: Takes the name, as of `plain_values`, and values of each large array as soon as it is made and
            returns the array to use, for instance the same values mapped from a file.
        progress: Told each step as it begins.
        reused: What was made for images that differ little; it is kept for the next ones.

    Raises:
        AnatomyError: If lung or airway are empty, or the airway has no trachea.
    """
    from anatomy.tree import tree_from_mask

    keep, tell = keep or (lambda _name, array: array), progress or (lambda _step: None)
    reused = reused or Reused()
    warnings = list(images.warnings)
    if images.fissures is None:
        warnings.append(f"Fissures are not checked: {FISSURES_UNKNOWN}.")
    for name, volume in (("lung", images.lung), ("airway lumen", images.lumen)):
        if not volume.array.any():
            raise AnatomyError(
                f"The {name} mask of {images.name} is empty",
                expected="at least one voxel",
                remedy="Check that the file holds the structure and was written with labels above 0",
            )
    tell("airway tree")
    lumen = images.lumen
    tree: AirwayTree = reused.get("tree", (lumen.array,), lambda: tree_from_mask(lumen))
    tell("labels")
    box = WorkingBox(images.lung.array | images.lumen.array, images.grid)
    labels, lungs_lps = _labels(images, box, tree, warnings, reused)
    labels = keep("labels", labels)
    tell("plausibility of the masks")
    findings = with_accepted(mask_findings(images, tree, lungs_lps), images.accepted)
    motion = None
    if images.motion is not None:
        from anatomy.motion.prepare import prepare_motion

        tell("motion of breathing")
        motion = prepare_motion(images.motion, labels, box.grid, float(tree.carina_lps[0]))
        warnings += motion.warnings
        motion = replace(motion, nodes=keep("motion.nodes", motion.nodes))
    taken: dict[str, Any] = {name: _cut_volume(images, name, box, keep, reused) for name in CUT}
    taken |= {name: getattr(images, name) for name in AS_READ}
    depth: DistanceField = reused.get("lumen_depth", (lumen.array,), lambda: _depth_of(lumen))
    return Lung(
        **taken,
        key=key or lung_key(images.sources),
        grid=box.grid,
        labels=labels,
        fields=clearance_fields(
            labels, box.grid, fissures=images.fissures is not None, keep=keep, tell=tell, reused=reused
        ),
        lumen_depth=replace(depth, corners=keep("lumen_depth.corners", depth.corners)),
        tree=tree,
        motion=motion,
        breath_hold=images.breath_hold,
        vessel_border_mm=images.vessel_border_mm,
        warnings=(*warnings, *warnings_of_findings(findings)),
        findings=findings,
    )


def _labels(
    images: PatientImages, box: WorkingBox, tree: AirwayTree, warnings: list[str], reused: Reused
) -> tuple[UInt16, tuple[Float, Float]]:
    """Set the bits of every structure and the branch of airway voxels; also return points of both lungs."""
    lumen = box.cut(images.lumen.array)
    airway = lumen if images.wall is None else lumen | box.cut(images.wall.array)
    if images.wall is None:
        warnings.append("No airway wall mask: the wall is covered by the margins alone.")
    vessels = box.cut(images.vessels.array)
    overlap = int((vessels & lumen).sum())
    if overlap:
        warnings.append(f"{overlap} voxels were both airway lumen and vessel; they are kept as lumen.")
        vessels &= ~lumen
    lung = box.cut(images.lung.array)
    inside = lung | airway | vessels
    if images.nodules is not None:
        inside |= box.cut(images.nodules.array)
    labels = np.zeros(box.grid.shape, dtype=np.uint16, order="F")
    labels[~inside] = structures.OUTSIDE
    structures.close_border(labels)
    tissue = lung & ~airway
    sides: tuple[Int32, tuple[int, ...]] | None = reused.get(
        "sides", (tissue,), lambda: coarse_sides(tissue, box.grid)
    )
    if sides is None:
        warnings.append("The mask could not be split into two lungs: taken as one lung.")
    else:
        septum = border_of(*sides, tissue)
        count = int(septum.sum())
        if count:
            warnings.append(
                f"Left and right lung touch in the mask: a septum of {count} voxels keeps them apart."
            )
        labels[septum] |= structures.OUTSIDE
    labels[vessels] |= structures.VESSEL
    if images.fissures is not None:
        fissures = box.cut(images.fissures.array)
        if images.fissure_band is not None:
            band = box.cut(images.fissure_band.array)
            fissures |= (band > 0) & (band < UNKNOWN)
        fissures &= ~airway
        labels[fissures] |= structures.FISSURE
    at, codes = reused.get(
        "branches",
        (airway, lumen, box.grid.lps_from_ijk),
        lambda: _airway_codes(airway, lumen, tree, box.grid),
    )
    labels[at] |= codes
    empty = np.zeros((0, 3))
    return labels, (empty, empty) if sides is None else points_of_sides(*sides, box.grid)


def _airway_codes(airway: Mask, lumen: Mask, tree: AirwayTree, grid: Grid) -> tuple[tuple[Int, ...], UInt16]:
    """Return where airways are and what labels say there: AIRWAY, LUMEN and the branch.

    It is of the branches nearest by their centreline the one nearest by its surface.
    """
    if tree.n_branches > structures.MAX_BRANCHES:
        raise AnatomyError(
            f"The airway tree has {tree.n_branches} branches",
            expected=f"at most {structures.MAX_BRANCHES}",
            remedy="Remove noise from the airway mask",
        )
    voxels = np.argwhere(airway)
    # Centreline points that are looked at to find the branch of an airway voxel.
    distance, index = tree.nearest_point_index.query(grid.lps(voxels), k=min(8, tree.n_points))
    distance, index = distance.reshape(len(voxels), -1), index.reshape(len(voxels), -1)
    nearest = np.argmin(distance - tree.radius_mm[index], axis=1)
    branch = tree.branch_of_point[index[np.arange(len(voxels)), nearest]]
    at = tuple(voxels.T)
    code = structures.AIRWAY | ((branch + 1) << structures.BRANCH_SHIFT) | structures.LUMEN * lumen[at]
    return at, code.astype(np.uint16)


def clearance_fields(
    labels: UInt16,
    grid: Grid,
    *,
    fissures: bool = False,
    keep: Keep = lambda _name, array: array,
    tell: Progress = lambda _step: None,
    reused: Reused | None = None,
) -> dict[str, DistanceField]:
    """Return the fields of the clearance to each structure and to all of them, by name.

    `labels` `(ni, nj, nk)` are those of `anatomy.structures`; there are fields of fissures if these are
    known.  `keep`, `tell` and `reused` are `keep`, `progress` and `reused` of `build_lung`.
    """
    geometry = corner_geometry(grid)
    return {
        name: DistanceField(name=name, corners=keep(f"fields.{name}.corners", corners), geometry=geometry)
        for name, corners in _field_arrays(labels, grid, fissures, tell, reused or Reused())
    }


def _field_arrays(
    labels: UInt16, grid: Grid, has_fissures: bool, tell: Progress, reused: Reused
) -> Iterator[tuple[str, UInt16]]:
    """Yield the clearance fields one after the other; the unions are minima of the parts."""
    union: UInt16 = np.full(tuple(n + 1 for n in grid.shape), MAX_STORED, dtype=np.uint16, order="F")

    def corners_of(name: str) -> UInt16:
        tell(f"clearance to {name}")
        solid = (labels & structures.FIELD_BITS[name]) != 0
        return np.asarray(
            reused.get(name, (solid, grid.spacing_mm), lambda: distance_corners(solid, grid.spacing_mm))
        )

    for name in SINGLE_FIELDS[:3]:
        corners = corners_of(name)
        np.minimum(union, corners, out=union)
        yield name, corners
    yield "obstacle", union
    if has_fissures:
        corners = corners_of("fissure")
        yield "fissure", corners
        yield "obstacle_fissure", np.minimum(union, corners)


def _depth_of(lumen: Volume) -> DistanceField:
    """Make the field of the depth inside the lumen, on the lumen's own box."""
    low, high = bounds(lumen.array)
    grid = lumen.grid.crop(low - 1, high + 1)
    solid = np.ones(grid.shape, dtype=bool, order="F")
    solid[1:-1, 1:-1, 1:-1] = ~lumen.array[window(low, high)]
    return distance_field("lumen_depth", solid, grid)


def _cut_volume(
    images: PatientImages, name: str, box: WorkingBox, keep: Keep, reused: Reused
) -> Volume | None:
    volume: Volume | None = getattr(images, name)
    if volume is None:
        return None
    array = volume.array
    cut = reused.get(name, (array, box.grid.lps_from_ijk), lambda: box.cut(array))
    return Volume(grid=box.grid, array=keep(f"{name}.array", cut))

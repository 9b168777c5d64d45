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
from anatomy.base.typed import Array, Float, Int, Mask, UInt16
from anatomy.fields import DistanceField, corner_geometry, distance_corners, distance_field, renewed_corners
from anatomy.grid import Grid, Volume
from anatomy.lobes import FISSURES_UNKNOWN, UNKNOWN
from anatomy.lung import Lung
from anatomy.mask_findings import mask_findings
from anatomy.morphology import Window, bounds, window
from anatomy.patient import PatientImages
from anatomy.plausibility import warnings_of_findings, with_accepted
from anatomy.sides import border_of, coarse_sides, points_of_sides

Progress = Callable[[str], None]
Keep = Callable[[str, Array], Array]

FORMAT = 6
"""Version of the processing: raise it when the same images give another lung."""

PAD_VOXELS = 2
"""One voxel around the lungs must be outside of them, and the fields look one farther."""


SINGLE_FIELDS = ("airway", "vessel", "pleura", "fissure")
"""The clearance fields that are made of a structure; the others are made of these."""

AROUND = ("lung", "lumen", "wall", "fissure_band")
"""The images that say of far voxels what they are: tree, branches and septum follow from them."""
MARKED = ("vessels", "nodules", "fissures")
"""The images that say in labels what their own voxels are, and nothing of others."""
CUT = ("nodules", "nodule_labels", "cost", "lobes", "fissure_band")
"""The images that a lung holds as they were read, cut to its box."""
AS_READ = ("name", "kind", "starts", "targets_lps", "start_names", "target_names", "sources")
"""The values that an organ holds as they were read; none of them depends on the working grid."""


def lung_key(sources: Mapping[str, str]) -> str:
    """Return the key of the lung made from input files with these hashes."""
    text = json.dumps({"format": FORMAT, "sources": dict(sorted(sources.items()))})
    return hashlib.sha256(text.encode()).hexdigest()[:24]


class Reused:
    """The images and the lung that were made last: what has not changed since is taken from them.

    So a patient of which a person corrects a mask is built anew within a second or so, and is the very lung
    that is built without what was made before.
    """

    def __init__(self, images: PatientImages | None = None, lung: Lung | None = None) -> None:
        self._kept: dict[str, tuple[tuple[Array | None, ...], Any]] = {}
        self.lung: Lung | None = None
        self._images: PatientImages | None = None
        if images is not None and lung is not None:
            self.take(images, lung)

    def take(self, images: PatientImages, lung: Lung) -> None:
        """Take what was made when a lung was built from images."""
        self._images, self.lung = images, lung
        self._kept["tree"] = (images.lumen.array,), lung.tree
        self._kept["lumen_depth"] = (images.lumen.array,), lung.lumen_depth
        for name in CUT:
            volume, cut = getattr(images, name), getattr(lung, name)
            if cut is not None:
                self._kept[name] = (volume.array, lung.grid.lps_from_ijk), cut.array

    def get(self, name: str, sources: tuple[Array | None, ...], make: Callable[[], Any]) -> Any:
        """Return what was made of the same sources, or make and keep it."""
        known = self._kept.get(name)
        if known is None or not all(map(_are_same, known[0], sources)):
            self._kept[name] = known = sources, make()
        return known[1]

    def changed(self, images: PatientImages) -> Window | None:
        """Return the box of voxels in which vessels, nodules or fissures alone have changed.

        It is None if something else has changed, or nothing is known of before.
        """
        old = self._images
        same = old is not None and np.array_equal(old.grid.lps_from_ijk, images.grid.lps_from_ijk)
        if old is None or not same or (old.fissures is None) != (images.fissures is None):
            return None
        if not all(_are_same(_array_of(old, name), _array_of(images, name)) for name in AROUND):
            return None
        found = np.zeros(images.grid.shape, dtype=np.bool_, order="F")
        for name in MARKED:
            one, other = _array_of(old, name), _array_of(images, name)
            if one is not other:
                found |= np.not_equal(False if one is None else one, False if other is None else other)
        return window(*bounds(found))


def _array_of(images: PatientImages, name: str) -> Array | None:
    volume: Volume | None = getattr(images, name)
    return None if volume is None else volume.array


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
        self.whole = window(low * 0, high - low + 2 * PAD_VOXELS)

    def cut(self, array: Array, part: Window | None = None) -> Array:
        """Copy what of `array` lies in the box, or in a window of it; 0 beyond the image."""
        part = part or self.whole
        start = self._start + [axis.start for axis in part]
        out = np.zeros([axis.stop - axis.start for axis in part], dtype=array.dtype, order="F")
        low, high = np.maximum(start, 0), np.minimum(start + out.shape, array.shape)
        out[window(low - start, high - start)] = array[window(low, high)]
        return out

    def window(self, part: Window) -> Window:
        """Return what of a window of the image lies in the box, as a window of the box."""
        ends = np.array([[axis.start, axis.stop] for axis in part]) - self._start[:, None]
        return window(*np.clip(ends.T, 0, self.grid.shape))


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
    lung, wall = images.lung.array, _array_of(images, "wall")
    box = reused.get("box", (lung, lumen.array), lambda: WorkingBox(lung | lumen.array, images.grid))
    lungs_lps, septum = reused.get("sides", (lung, lumen.array, wall), lambda: _sides(images, box))
    part = reused.changed(images)
    before, changed = (None, None) if part is None else (reused.lung, box.window(part))
    labels = keep("labels", _labels(images, box, tree, septum, before, changed))
    warnings += _warnings(images, septum)
    tell("plausibility of the masks")
    findings = with_accepted(mask_findings(images, tree, lungs_lps, reused.get), images.accepted)
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
        fields=clearance_fields(labels, box.grid, images.fissures is not None, keep, tell, before, changed),
        lumen_depth=replace(depth, corners=keep("lumen_depth.corners", depth.corners)),
        tree=tree,
        motion=motion,
        breath_hold=images.breath_hold,
        vessel_border_mm=images.vessel_border_mm,
        warnings=(*warnings, *warnings_of_findings(findings)),
        findings=findings,
    )


def _sides(images: PatientImages, box: WorkingBox) -> tuple[tuple[Float, Float], Mask | None]:
    """Return points of both lungs, and the septum where they touch; none if they cannot be told apart."""
    tissue = box.cut(images.lung.array & ~images.lumen.array)
    if images.wall is not None:
        tissue &= ~box.cut(images.wall.array)
    sides = coarse_sides(tissue, box.grid)
    if sides is None:
        return (np.zeros((0, 3)), np.zeros((0, 3))), None
    return points_of_sides(*sides, box.grid), border_of(*sides, tissue)


def _warnings(images: PatientImages, septum: Mask | None) -> Iterator[str]:
    """Yield what labels make of masks that are not as they should be."""
    if images.wall is None:
        yield "No airway wall mask: the wall is covered by the margins alone."
    overlap = int(np.count_nonzero(images.vessels.array & images.lumen.array))
    if overlap:
        yield f"{overlap} voxels were both airway lumen and vessel; they are kept as lumen."
    if septum is None:
        yield "The mask could not be split into two lungs: taken as one lung."
    elif count := int(np.count_nonzero(septum)):
        yield f"Left and right lung touch in the mask: a septum of {count} voxels keeps them apart."


def _labels(
    images: PatientImages, box: WorkingBox, tree: AirwayTree, septum: Mask | None,
    before: Lung | None, changed: Window | None,
) -> UInt16:  # fmt: skip
    """Return the labels: those of before but for the window that has changed, if that is known."""
    if before is not None and changed is not None:
        labels = np.array(before.labels, order="F")
        airway = labels[changed] & ~np.uint16(structures.VESSEL | structures.FISSURE | structures.OUTSIDE)
        labels[changed] = airway | _without_airway(images, box, septum, changed)
    else:
        labels = _without_airway(images, box, septum, box.whole)
        at, codes = _airway_codes(images, box, tree)
        labels[at] |= codes
    structures.close_border(labels)
    return labels


def _without_airway(images: PatientImages, box: WorkingBox, septum: Mask | None, part: Window) -> UInt16:
    """Return what labels say of vessels, fissures and the outside, in a window of the box."""

    def cut(name: str) -> Mask:
        return box.cut(getattr(images, name).array, part)

    lumen = cut("lumen")
    airway = lumen if images.wall is None else lumen | cut("wall")
    vessels = cut("vessels") & ~lumen
    outside = ~(cut("lung") | airway | vessels)
    if images.nodules is not None:
        outside &= ~cut("nodules")
    if septum is not None:
        outside |= septum[part]
    labels: UInt16 = outside * np.uint16(structures.OUTSIDE)
    labels |= vessels * np.uint16(structures.VESSEL)
    if images.fissures is not None:
        fissures = cut("fissures")
        if images.fissure_band is not None:
            band = cut("fissure_band")
            fissures |= (band > 0) & (band < UNKNOWN)
        labels |= (fissures & ~airway) * np.uint16(structures.FISSURE)
    return labels


def _airway_codes(images: PatientImages, box: WorkingBox, tree: AirwayTree) -> tuple[tuple[Int, ...], UInt16]:
    """Return where airways are and what labels say there: AIRWAY, LUMEN and the branch.

    It is of the branches nearest by their centreline the one nearest by its surface.
    """
    if tree.n_branches > structures.MAX_BRANCHES:
        raise AnatomyError(
            f"The airway tree has {tree.n_branches} branches",
            expected=f"at most {structures.MAX_BRANCHES}",
            remedy="Remove noise from the airway mask",
        )
    lumen = box.cut(images.lumen.array)
    voxels = np.argwhere(lumen if images.wall is None else lumen | box.cut(images.wall.array))
    # Centreline points that are looked at to find the branch of an airway voxel.
    distance, index = tree.nearest_point_index.query(box.grid.lps(voxels), k=min(8, tree.n_points))
    distance, index = distance.reshape(len(voxels), -1), index.reshape(len(voxels), -1)
    nearest = np.argmin(distance - tree.radius_mm[index], axis=1)
    branch = tree.branch_of_point[index[np.arange(len(voxels)), nearest]]
    at = tuple(voxels.T)
    code = structures.AIRWAY | ((branch + 1) << structures.BRANCH_SHIFT) | structures.LUMEN * lumen[at]
    return at, code.astype(np.uint16)


def clearance_fields(
    labels: UInt16, grid: Grid, fissures: bool = False, keep: Keep = lambda _name, array: array,
    tell: Progress = lambda _step: None, before: Lung | None = None, changed: Window | None = None,
) -> dict[str, DistanceField]:  # fmt: skip
    """Return the fields of the clearance to each structure and to all of them, by name.

    `labels` `(ni, nj, nk)` are those of `anatomy.structures`; there are fields of fissures if these are
    known.  `keep` and `tell` are `keep` and `progress` of `build_lung`.  The labels of the lung `before`, on
    the same grid, differ in the window `changed` alone.
    """
    known = {} if before is None else before.fields
    geometry, whole = corner_geometry(grid), (slice(None), slice(None), slice(None))
    fields: dict[str, DistanceField] = {}
    differs: dict[str, list[Window]] = {}

    def add(name: str, corners: UInt16, *boxes: Window) -> None:
        kept = keep(f"fields.{name}.corners", corners)
        fields[name] = DistanceField(name=name, corners=kept, geometry=geometry)
        differs[name] = list(boxes)

    def add_single(name: str) -> None:
        tell(f"clearance to {name}")
        bits = structures.FIELD_BITS[name]

        def solid(part: Window) -> Mask:
            return np.asarray((labels[part] & bits) != 0)

        if name not in known or before is None or changed is None:
            add(name, distance_corners(solid(whole), grid.spacing_mm), whole)
        elif np.array_equal(solid(changed), (before.labels[changed] & bits) != 0):
            add(name, known[name].corners)
        else:
            add(name, *renewed_corners(known[name].corners, solid, changed, grid.spacing_mm))

    def add_union(name: str, *parts: str) -> None:
        corners = known[name].corners if name in known else fields[parts[0]].corners
        boxes = [box for part in parts for box in differs[part]] if name in known else [whole]
        corners = np.array(corners, order="F") if boxes else corners
        for box in boxes:
            corners[box] = fields[parts[0]].corners[box]
            for part in parts[1:]:
                np.minimum(corners[box], fields[part].corners[box], out=corners[box])
        add(name, corners, *boxes)

    for name in SINGLE_FIELDS[:3]:
        add_single(name)
    add_union("obstacle", *SINGLE_FIELDS[:3])
    if fissures:
        add_single("fissure")
        add_union("obstacle_fissure", "obstacle", "fissure")
    return fields


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

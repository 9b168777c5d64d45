"""The target: a stated point, or a point in the nodule mask; and what is at a point of the lung."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import TargetError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.base.words import point_in_words
from anatomy.grid import read_only
from anatomy.io.frames import MOST_COORDINATE_MM, parse_point
from anatomy.lung import Lung
from anatomy.organ import Organ
from anatomy.structures import AIRWAY, FISSURE, LUMEN, OUTSIDE, VESSEL, obstacle_bits
from lungaccess.problem.nodules import find_nodule


@frozen_record
class Target:
    """Where the needle has to end, (3,) LPS mm; `origin` starts with "nodule" if that is in the mask."""

    lps_mm: Float
    origin: str


@frozen_record
class StatedTarget:
    """A target as a user states it, before any lung is looked at.

    Args:
        lps_mm ((3,) float64 or None): A point, LPS mm; None for a nodule.
        nodule: Number of a nodule, 0 for the largest one, if there is no point.
        origin: What the user wrote.
        name: Name of a target that came with the patient, if there is neither a point nor a nodule.
    """

    lps_mm: Float | None
    nodule: int
    origin: str
    name: str = ""

    def resolve(self, lung: Organ) -> Target:
        """Return the target in a lung; see `resolve_target`."""
        if self.name:
            return point_target(lung, _named_target(lung, self.name), origin=self.origin)
        if self.lps_mm is None:
            return nodule_target(lung, self.nodule)
        return point_target(lung, self.lps_mm, origin=self.origin)

    def centre_lps(self, lung: Organ) -> Float:
        """Return the point `(3,)` LPS mm, wherever it lies, or that of the nodule."""
        if self.name:
            return _named_target(lung, self.name)
        return nodule_target(lung, self.nodule).lps_mm if self.lps_mm is None else self.lps_mm


def stated_target(text: str | None, nodule: int | None) -> StatedTarget:
    """Return what a user states.

    Args:
        text: A point with its frame, ``ras:x,y,z`` or ``lps:x,y,z``, mm; a point that 3D Slicer saved, such
            as ``scene.mrml#target``, see `anatomy.io.markups`; or the name or number of a target that came
            with the patient, such as ``target1``.

    Raises:
        FrameError: If the text states no frame, or the point of 3D Slicer has none that is plain.
        FileError: If the file of 3D Slicer cannot be read, or has no such point.
        TargetError: If there is not exactly one of the two.
    """
    if (text is None) == (nodule is None):
        raise TargetError(
            "No target was given" if text is None else "Both a target and a nodule were given",
            expected="either --target ras:x,y,z (or lps:x,y,z) or --nodule",
            remedy="Add --nodule for the largest nodule, or a point such as --target ras:-41.5,22,-110",
        )
    if text is None:
        origin = f"nodule {nodule}" if nodule else "the largest nodule"
        return StatedTarget(lps_mm=None, nodule=nodule or 0, origin=origin)
    from anatomy.io.markups import parse_reference, read_named_point

    saved = parse_reference(text)
    if saved is not None:
        return StatedTarget(lps_mm=read_named_point(saved).lps_mm, nodule=0, origin=f"point {saved}")
    if text and not set(text) & set(":,;[( "):
        return StatedTarget(lps_mm=None, nodule=0, origin=f"published {text}", name=text)
    return StatedTarget(lps_mm=parse_point(text), nodule=0, origin=f"point {text}")


def _named_target(lung: Organ, name: str) -> Float:
    """Return the point `(3,)` LPS mm of the patient's target of a name or number; TargetError without one."""
    names = [known.lower() for known in lung.target_names]
    if name.lower() in names:
        return lung.targets_lps[names.index(name.lower())]
    if name.isdecimal() and 1 <= int(name) <= len(names):
        return lung.targets_lps[int(name) - 1]
    raise TargetError(
        f"{lung.name} came with no target {name!r}",
        expected=f"one of {', '.join(lung.target_names)}" if names else "a point: it came without targets",
        remedy="A point is stated with its frame, as --target ras:-41.5,22,-110",
    )


def resolve_target(lung: Organ, text: str | None = None, nodule: int | None = None) -> Target:
    """Return the target that a user names.

    Args:
        text: A point with its frame: ``ras:x,y,z`` or ``lps:x,y,z``, mm; or as `stated_target` takes it.
        nodule: Its label in the files, else its rank by size; 0, the default, for the largest.  The target is
            its centroid where a needle may end there, else its voxel farthest from every obstacle.

    Raises:
        FrameError: If the text states no frame.
        TargetError: If there is no such nodule, or the point lies outside the lung or inside an obstacle.
    """
    return stated_target(text, (nodule or 0) if text is None else None).resolve(lung)


def point_target(lung: Organ, lps_mm: Float, *, origin: str = "point") -> Target:
    """Return a target at a point `(3,)` LPS mm; TargetError unless it is finite and in free lung."""
    point = _point(lps_mm, "target")
    require_free(lung, point, origin)
    return Target(lps_mm=read_only(point), origin=origin)


def _point(lps_mm: ArrayLike, what: str) -> Float:
    point = np.array(lps_mm, dtype=np.float64)
    if point.shape != (3,) or not (np.abs(point) <= MOST_COORDINATE_MM).all():
        raise TargetError(
            f"The {what} {point.tolist()} is not a point",
            expected="three finite numbers, LPS mm",
            remedy="State a point such as lps:-57,131,-520",
        )
    return point


def nodule_target(lung: Organ, number: int) -> Target:
    """Return a target in a nodule, by number, 0 for the largest; TargetError if none of it can be entered."""
    nodule = find_nodule(lung, number)
    centres = lung.grid.lps(nodule.voxels)
    clearance = lung.obstacle_field(with_fissures=True).lower_bound_mm(centres)
    nearest = centres[np.argmin(np.linalg.norm(centres - centres.mean(axis=0), axis=1))]
    is_free = lung.label_at(nearest) & (OUTSIDE | VESSEL | AIRWAY) == 0
    point = nearest if is_free else centres[int(np.argmax(clearance))]
    require_free(lung, point)
    return Target(lps_mm=read_only(point), origin=f"nodule {nodule.number}")


def require_free(lung: Organ, point: Float, origin: str = "") -> None:
    """Raise a TargetError that says where a point `(3,)` LPS mm lies, unless it is in free lung tissue.

    Where the same numbers in the other frame lie in the lung, the error says so; `origin` holds the numbers
    as they were typed.
    """
    label = lung.label_at(point)
    if label & OUTSIDE:
        raise _outside(lung, point, origin)
    for bit, name in ((VESSEL, "a vessel"), (AIRWAY, "an airway")):
        if label & bit:
            raise TargetError(
                f"The target at {point_in_words(point)} lies inside {name}",
                expected=f"a point in {_word_of(lung)} tissue",
                remedy="Move the target, or remove the nodule from that mask",
            )


def _outside(lung: Organ, point: Float, origin: str) -> TargetError:
    """Return the error for a target outside the lung, with the frame that was meant if that is plain."""
    flipped = point * np.array([-1.0, -1.0, 1.0])
    organ = _word_of(lung)
    where = organ if lung.grid.contains(point).all() else "images"
    if lung.label_at(flipped) & OUTSIDE:
        corners = [lung.grid.lps(np.zeros(3)), lung.grid.lps(np.array(lung.grid.shape) - 1.0)]
        ranges = (f"{a:.0f} to {b:.0f}" for a, b in zip(np.min(corners, 0), np.max(corners, 0), strict=True))
        return TargetError(
            f"The target at {point_in_words(point)} lies outside the {where}",
            expected=f"a point in {organ} tissue; the box of the {organ} is LPS {', '.join(ranges)} mm",
            remedy="Read the point off the images again",
        )
    frame, _, numbers = origin.removeprefix("point ").partition(":")
    other = {"ras": "lps", "lps": "ras"}.get(frame.strip().lower(), "")
    typed = f"--target {other}:{numbers}" if other else f"the point {point_in_words(flipped)}"
    inside = f"in {other.upper()} the same numbers lie" if other else "with x and y negated it lies"
    return TargetError(
        f"The target at {point_in_words(point)} lies outside the {where}; {inside} inside",
        expected=f"a point in {organ} tissue, in the frame that is stated",
        remedy=f"If that is meant, state {typed}",
    )


def _word_of(organ: Organ) -> str:
    return "lung" if isinstance(organ, Lung) else "liver"


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
    """Return what is at a point `(3,)` LPS mm; TargetError if it is not three finite numbers."""
    point = _point(lps_mm, "place")
    label = lung.label_at(point)
    structures = {"airway": AIRWAY | LUMEN, "vessel": VESSEL, "pleura": OUTSIDE}
    if lung.has_fissures:
        structures["fissure"] = FISSURE
    nearest = int(np.argmin(np.linalg.norm(lung.tree.points_lps - point, axis=1)))
    in_nodule = lung.nodules is not None and lung.nodules.at(point, False)
    return Place(
        lps_mm=point,
        tissue=next((name for bit, name in TISSUES if label & bit), "nodule" if in_nodule else "lung tissue"),
        lobe=lung.lobe_at(point),
        distance_mm={
            name: float(lung.exact_clearance_mm(point[None], bits, cap_mm=CAP_MM)[0])
            for name, bits in structures.items()
        },
        generation=int(lung.tree.generation[lung.tree.branch_of_point[nearest]]),
        may_be_target=label & obstacle_bits(False) == 0,
    )

"""Proof that no deployment of a system has a target in its needle's workspace.

docs/explanation/unreachable.md derives it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from anatomy.errors import TargetError
from anatomy.fields import distance_corners
from anatomy.kernels.field import UNITS_PER_MM
from anatomy.lung import Lung
from anatomy.records import frozen_record
from anatomy.structures import BRANCH_SHIFT, FISSURE, LUMEN, OUTSIDE, VESSEL, obstacle_bits
from anatomy.typed import Float, Int32, Mask
from lungaccess.problem.system import System
from lungaccess.reachability.kernels.blocked import ProofEnvironment
from lungaccess.reachability.kernels.deployment_boxes import BOX_COLUMNS, PLACE_X
from lungaccess.reachability.kernels.unreachable import (
    INSERTION_STEP_MM,
    MOST_WAITING,
    RULED_OUT,
    greatest_insertions,
    rule_out,
)
from lungaccess.reachability.tip_places import place_pieces, places_of_tips
from stages.needle import needle_environment
from stages.tube import tube_constants
from stages.tube.kernels import MAX_EXTENSION

INSERTION_SPACING_MM = 0.02
"""Spacing of the insertions that are tried; the bound between two of them is loose by about as much."""
MOST_BOXES = 3_000_000
"""Boxes looked at for one piece of the airway before it is given up, after about a second."""


@frozen_record
class ReachVerdict:
    """Whether a target is proved unreachable.

    Parameters
    ----------
    proved : bool
        If not, nothing is known.
    boxes : int
        Boxes of deployments that were looked at.
    open_lps : (3,) float64 or None
        A place of the scope tip, LPS mm, from which the first deployments start that could not be ruled out.
    """

    proved: bool
    boxes: int
    open_lps: Float | None = None


class UnreachableProof:
    """Tries to prove targets of one patient unreachable for one system, with fissures as obstacles or not.

    What is ruled out is every place of the scope tip near the medial axis where the scope fits, every
    direction that it can have there (`stages.scope.in_tip_region`), and every rotation and insertion of the
    tubes, such that the tubes leave an airway outside the mediastinum, keep clear of vessels and pleura from
    there on, and sweep little, and a needle from their tip reaches the target.  That needle heeds no
    obstacle, but its tip and the target must lie in the same free region.

    Parameters
    ----------
    between : callable, optional
        Called between the steps of the preparation, which takes some ten seconds; it may raise to end it.

    Raises
    ------
    SettingsError
        If the tubes are not planar.
    """

    def __init__(
        self, lung: Lung, system: System, *, with_fissures: bool, between: Callable[[], None] | None = None
    ) -> None:
        system.tubes.require_planar("A proof that no deployment reaches a target")
        pause = between or (lambda: None)
        self._lung = lung
        self._tubes = tube_constants(system.tubes, system.margins)
        needle = system.require_needle("The proof that no needle reaches a target")
        self._limits = needle_environment(lung, needle, system.margins, with_fissures=with_fissures).limits
        longest = float(self._tubes[MAX_EXTENSION])
        self._insertions = np.zeros(int(longest / INSERTION_STEP_MM) + 1)
        greatest_insertions(self._tubes, longest, INSERTION_SPACING_MM, self._insertions)
        pause()
        spacing_mm = lung.grid.spacing_mm
        hazards = VESSEL | OUTSIDE | (FISSURE if with_fissures else 0)
        self._hazard_bits = hazards
        leaving = _may_be_left(lung)
        masks = []
        lumen = (lung.labels & LUMEN) != 0
        self._not_lumen = np.asfortranarray(~lumen).view(np.uint8)
        for mask in (lumen, leaving, (lung.labels & hazards) != 0):
            pause()
            masks.append(distance_corners(mask, spacing_mm))
        self._masks = tuple(masks)
        pause()
        # Corners are rounded down, and between them a bound lacks at most a diagonal of a voxel: on the half
        # to the nearest corner the distance may grow, and from there on the bound falls.
        self._loss_mm = float(np.linalg.norm(spacing_mm)) + 1.0 / UNITS_PER_MM
        self._free = _free_regions(lung, self._limits.required_mm, self._loss_mm, with_fissures)
        self._least_depth_mm = system.scope.radius_mm + system.scope.lumen_margin_mm
        tips, centres = places_of_tips(lung, self._not_lumen, self._least_depth_mm)
        self._tips = distance_corners(tips, spacing_mm)
        pause()
        self._pieces = place_pieces(lung, centres, leaving, float(self._insertions.max()))

    def prove(
        self,
        target_lps: Float,
        *,
        most_boxes: int = MOST_BOXES,
        progress: Callable[[float], None] | None = None,
    ) -> ReachVerdict:
        """Try to prove that no deployment has the target in its workspace.

        Parameters
        ----------
        target_lps : (3,) float64
            LPS mm.
        most_boxes : int
            To look at for one piece of the airway before it is given up.
        progress : callable, optional
            Told the share of the pieces that is done.

        Returns
        -------
        ReachVerdict
            It ends with the first piece that cannot be ruled out.

        Raises
        ------
        TargetError
            If the target is not a finite point of the image.
        """
        target = np.asarray(target_lps, dtype=np.float64)
        environment = self._environment(target)
        boxes = np.zeros((MOST_WAITING, BOX_COLUMNS))
        looked_at = 0
        away = [np.linalg.norm(piece.cones[0, :3] - target) for piece in self._pieces]
        order = np.argsort(away, kind="stable")
        for done, n in enumerate(order):
            piece = self._pieces[n]
            outcome, looked = rule_out(
                environment, self._tubes, self._insertions, self._limits, target,
                piece.frame, piece.places, piece.cones, piece.wide, most_boxes, boxes,
            )  # fmt: skip
            looked_at += looked
            if outcome != RULED_OUT:
                place = boxes[0, PLACE_X : PLACE_X + 3] @ piece.frame
                return ReachVerdict(proved=False, boxes=looked_at, open_lps=place)
            if progress is not None:
                progress((done + 1) / len(order))
        return ReachVerdict(proved=True, boxes=looked_at)

    def _environment(self, target: Float) -> ProofEnvironment:
        lung = self._lung
        if not np.isfinite(target).all() or not lung.grid.contains(target):
            raise TargetError(
                f"The target {np.round(target, 1).tolist()} (LPS mm) is not in the image",
                expected="a point of the image",
                remedy="Check the frame of the point",
            )
        lumen, leaving, hazards = self._masks
        depth = lung.lumen_depth
        near = _near(lung, target, self._limits.goal_tolerance_mm + self._loss_mm)
        regions = np.unique(self._free[near])
        passable = np.isin(self._free, regions[regions > 0])
        return ProofEnvironment(
            lumen=lumen,
            may_be_left=leaving,
            hazards=hazards,
            depth=depth.corners,
            tips=self._tips,
            passable=distance_corners(passable, lung.grid.spacing_mm),
            labels=lung.labels,
            not_lumen=self._not_lumen,
            geometry=lung.geometry,
            depth_geometry=depth.geometry,
            hazard_bits=self._hazard_bits,
            loss_mm=self._loss_mm,
            least_depth_mm=self._least_depth_mm,
        )


def _may_be_left(lung: Lung) -> Mask:
    """Return the lumen of the airways that tubes may leave."""
    branch = (lung.labels >> BRANCH_SHIFT).astype(np.int64) - 1
    inside = ((lung.labels & LUMEN) != 0) & (branch >= 0)
    return np.asarray(inside & ~lung.tree.mediastinal[np.maximum(branch, 0)])


def _free_regions(lung: Lung, required_mm: float, loss_mm: float, with_fissures: bool) -> Int32:
    """Return the number of the region, joined by faces, edges and corners, where a needle may be; 0 for none.

    A voxel is left out only if the clearance is less than required everywhere in it.
    """
    from scipy import ndimage

    corners = lung.obstacle_field(with_fissures=with_fissures).corners
    greatest = ndimage.maximum_filter(corners, size=2, origin=-1)[:-1, :-1, :-1]
    bits = obstacle_bits(with_fissures)
    free = (greatest / UNITS_PER_MM + loss_mm >= required_mm) & ((lung.labels & bits) == 0)
    labels, _ = ndimage.label(free, structure=np.ones((3, 3, 3)))
    return np.asarray(labels, dtype=np.int32)


def _near(lung: Lung, target: Float, distance_mm: float) -> tuple[slice, ...]:
    """Return the window of voxels that may hold a point so near to the target."""
    at = lung.grid.ijk(target)
    reach = distance_mm / lung.grid.spacing_mm + 1.0
    low = np.maximum(np.floor(at - reach).astype(int), 0)
    high = np.ceil(at + reach).astype(int) + 1
    return tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))

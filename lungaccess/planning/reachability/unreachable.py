"""Proof that no deployment of a system reaches a target, or what of the deployments it leaves open.

docs/theory/unreachable.md derives it.
"""

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from anatomy.base.errors import TargetError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int, Int32, Mask
from anatomy.fields import distance_corners
from anatomy.kernels.field import UNITS_PER_MM
from anatomy.lung import Lung
from anatomy.structures import BRANCH_SHIFT, FISSURE, LUMEN, OUTSIDE, VESSEL, obstacle_bits
from lungaccess.planning.coupled.kernels.box_of_tubes import HALF, INNER, OUTER
from lungaccess.planning.reachability import deployment_space
from lungaccess.planning.reachability.kernels.blocked import ProofEnvironment
from lungaccess.planning.reachability.kernels.deployment_boxes import BOX_COLUMNS, PLACE_X
from lungaccess.planning.reachability.kernels.unreachable import (
    RULED_OUT,
    TOO_MANY,
    UNDECIDED,
    Found,
    rule_out,
)
from lungaccess.planning.reachability.layers import THREADS
from lungaccess.problem.system import System
from stages.needle import NOT_BOUNDED, backward_reach, needle_environment
from stages.needle.infeasibility.kernels import BackwardReach
from stages.needle.kernels import Limits
from stages.tube import tube_constants
from stages.tube.kernels import INSERTION_STEP_MM, MAX_EXTENSION, greatest_insertions


@frozen_record
class OpenPlace:
    """A stretch of an airway branch from which deployments could not be ruled out.

    Args:
        name: The number of the branch, with its lobe if that is known.
        points_lps ((N, 3) float64): Its tree points, LPS mm.
        tip_lps, insertions_mm: Place of the scope tip, LPS mm, and insertions of the outer and the inner tube
            in the middle of a part that was left.
        share: Of the deployment space that is open here.
        narrowest: Whether such a part was too small to halve; else the budget ended before.
    """

    branch: int
    generation: int
    name: str
    points_lps: Float
    tip_lps: Float
    insertions_mm: tuple[float, float]
    share: float
    narrowest: bool


def open_places(lung: Lung, space: deployment_space.DeploymentSpace, found: Found) -> tuple[OpenPlace, ...]:
    """Merge what is open into places, the largest share of the deployment space first."""
    tree = lung.tree
    rows = np.flatnonzero(found.outcome != RULED_OUT)
    open_measure = space.measures[rows] * (1.0 - found.share[rows])
    total = float(space.measures.sum())
    groups: list[tuple[int, list[int], Float]] = []
    for piece in np.unique(space.owners[rows]):
        first = tree.nearest_point_index.query(space.pieces[piece].cones[0, :3])[1]
        branch = int(tree.branch_of_point[first])
        start = space.pieces[piece].cones[0, :3]
        # Open pieces of a branch that begin so near to each other are one place: a piece has 8 mm.
        if groups and groups[-1][0] == branch and np.linalg.norm(groups[-1][2] - start) <= 12.0:
            groups[-1] = branch, [*groups[-1][1], int(piece)], start
        else:
            groups.append((branch, [int(piece)], start))
    places = []
    for branch, pieces, _start in groups:
        mine = np.isin(space.owners[rows], pieces)
        # A part that is too small to halve tells more than one that was not looked at to the end.
        best = rows[mine][np.lexsort((-open_measure[mine], found.outcome[rows[mine]] == TOO_MANY))[0]]
        left = found.left[best] if found.left[best, HALF + PLACE_X] > 0.0 else space.boxes[best]
        frame = space.pieces[space.owners[best]].frame
        cones = np.concatenate([space.pieces[piece].cones for piece in pieces])
        places.append(
            OpenPlace(
                branch=branch,
                generation=int(tree.generation[branch]),
                name=lung.branch_words(branch),
                points_lps=cones[cones[:, 6] > 0.0, :3],
                tip_lps=left[PLACE_X : PLACE_X + 3] @ frame,
                insertions_mm=(float(left[OUTER]), float(left[INNER])),
                share=float(open_measure[mine].sum()) / total,
                narrowest=bool(found.outcome[best] != TOO_MANY),
            )
        )
    return tuple(sorted(places, key=lambda place: -place.share))


MOST_BOXES = 20_000_000
"""Boxes looked at for a target before it is given up, after half a minute or so."""


NO_NEEDLE = Limits(**dict.fromkeys(Limits._fields, 0.0) | {"kappa": 1.0})
"""Limits of a needle of no length at the tip of the tubes."""


@frozen_record
class ReachVerdict:
    """Whether a target is proved unreachable; if not, nothing is known of it but what is left.

    Args:
        share_ruled_out: Share of the deployment space that is proved not to reach the target.
        finished: Whether every box is ruled out or has a part that is too small to halve; else the budget
            ended.
        open_places: Where the deployments start that could not be ruled out, the largest share first.
        rests_on: On which masks a proof rests, and what of them is in doubt.
    """

    proved: bool
    boxes: int
    share_ruled_out: float = 0.0
    finished: bool = False
    open_places: tuple[OpenPlace, ...] = ()
    rests_on: str = ""

    @property
    def open_lps(self) -> Float | None:
        """A place of the scope tip, LPS mm, from which a deployment starts that could not be ruled out."""
        return self.open_places[0].tip_lps if self.open_places else None


class UnreachableProof:
    """Tries to prove targets of one patient unreachable for one system, with fissures as obstacles or not.

    What is ruled out is every place of the scope tip near the medial axis where the scope fits, every
    direction that it can have there (`stages.scope.in_tip_region`), and every rotation and insertion of the
    tubes, such that the tubes leave an airway outside the mediastinum, keep clear of vessels and pleura from
    there on, and sweep little, and a needle from their tip reaches the target.  That needle heeds no
    obstacle, but its tip and the target must lie in the same free region.  Without a needle the tip of the
    tubes itself must come to the target.

    Deployments that no target needs to look at are ruled out once, with the first target.  SettingsError is
    raised if the tubes are not planar.

    Args:
        between: Called between the steps of the preparation, in patients tens of seconds; it may raise to end
            it.
    """

    def __init__(
        self, lung: Lung, system: System, *, with_fissures: bool, between: Callable[[], None] | None = None
    ) -> None:
        system.tubes.require_planar("A proof that no deployment reaches a target")
        pause = between or (lambda: None)
        self._lung = lung
        self._tubes = tube_constants(system.tubes, system.margins)
        self._needle = (
            None
            if system.needle is None
            else needle_environment(lung, system.needle, system.margins, with_fissures=with_fissures)
        )
        self._limits = NO_NEEDLE if self._needle is None else self._needle.limits
        longest = float(self._tubes[MAX_EXTENSION])
        self._insertions = np.zeros(int(longest / INSERTION_STEP_MM) + 1)
        # Spacing of the insertions that are tried; the bound between two of them is loose by about as much.
        greatest_insertions(self._tubes, longest, 0.02, self._insertions)
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
        self._loss_mm = float(np.linalg.norm(spacing_mm)) + 2.0 / UNITS_PER_MM
        # The tip of the tubes alone needs no free region.
        self._free = (
            None
            if self._needle is None
            else _free_regions(lung, self._limits.required_mm, self._loss_mm, with_fissures)
        )
        self._passable: dict[bytes, np.ndarray] = {}
        self._least_depth_mm = system.scope.radius_mm + system.scope.lumen_margin_mm
        tips, centres = deployment_space.places_of_tips(lung, self._not_lumen, self._least_depth_mm)
        self._tips = distance_corners(tips, spacing_mm)
        pause()
        pieces = deployment_space.place_pieces(lung, centres, leaving, float(self._insertions.max()))
        self._space = deployment_space.divided_space(
            self._surroundings(self._masks[0]), self._tubes, self._insertions, pieces, between=pause
        )

    @property
    def space(self) -> deployment_space.DeploymentSpace:
        """The deployments that there may be, whatever the target."""
        return self._space

    def prove(
        self,
        target_lps: Float,
        *,
        most_boxes: int = MOST_BOXES,
        time_s: float | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> ReachVerdict:
        """Try to prove that no deployment reaches the target.

        The places nearest to the target are looked at first.  After one that is left open the search goes on
        with the others, then with what else can be ruled out around the open ones.  TargetError is raised if
        the target is not a finite point of the image.

        Args:
            target_lps ((3,) float64): LPS mm.
            most_boxes: To look at, about.
            time_s: After so much time nothing more is begun; the same time need not give the same verdict.
        """
        target = np.asarray(target_lps, dtype=np.float64)
        environment = self._environment(target)
        space = self._space
        count = len(space.boxes)
        found = Found(
            outcome=np.full(count, TOO_MANY, dtype=np.uint8),
            share=np.zeros(count),
            looked=np.zeros(count, dtype=np.int64),
            left=np.zeros((count, BOX_COLUMNS)),
        )
        ends = math.inf if time_s is None else time.monotonic() + time_s
        shares = space.measures / max(float(space.measures.sum()), 1e-300)
        looked = 0
        for rows in self._rounds(environment, target, found):
            looked += int(found.looked[rows].sum())
            if progress is not None:
                progress(1.0 - float((1.0 - found.share) @ shares))
            if looked >= most_boxes or time.monotonic() >= ends:
                break
        proved = bool((found.outcome == RULED_OUT).all())
        return ReachVerdict(
            proved=proved,
            boxes=looked,
            share_ruled_out=1.0 - float((1.0 - found.share) @ shares),
            finished=bool((found.outcome != TOO_MANY).all()),
            open_places=() if proved else open_places(self._lung, space, found),
            rests_on=self._lung.mask_words,
        )

    def _rounds(self, environment: ProofEnvironment, target: Float, found: Found) -> Iterator[Int]:
        """Look at all boxes, then longer and longer at what is left; yield rows that were looked at."""
        space = self._space
        away = np.array([np.linalg.norm(piece.cones[0, :3] - target) for piece in space.pieces])
        nearest = np.argsort(away[space.owners], kind="stable")
        devices = self._tubes, self._insertions, self._limits
        about = environment, *devices, target, space.arrays, space.boxes, space.owners
        with ThreadPoolExecutor(THREADS) as pool:
            for left, to_the_end in ((TOO_MANY, False), (UNDECIDED, True)):
                most = 1
                while len(rows := nearest[found.outcome[nearest] == left]):

                    def work(some: Int, most: int = most, to_the_end: bool = to_the_end) -> None:
                        rule_out(*about, some, most, to_the_end, found)

                    # Looks that a thread may take at a time.
                    yield from deployment_space.in_tasks(pool, work, rows, max(16384 // most, 1))
                    # A box is given so many times as many looks as in the round before, so that rounds repeat
                    # little.
                    most *= 16

    def _environment(self, target: Float) -> ProofEnvironment:
        lung = self._lung
        if not np.isfinite(target).all() or not lung.grid.contains(target):
            raise TargetError(
                f"The target {np.round(target, 1).tolist()} (LPS mm) is not in the image",
                expected="a point of the image",
                remedy="Check the frame of the point",
            )
        if self._free is None:
            return self._surroundings(np.zeros_like(self._masks[0]))
        # The window of voxels that may hold a point so near to the target.
        distance_mm = self._limits.goal_tolerance_mm + self._loss_mm
        at = lung.grid.ijk(target)
        reach = distance_mm / lung.grid.spacing_mm + 1.0
        low = np.maximum(np.floor(at - reach).astype(int), 0)
        high = np.ceil(at + reach).astype(int) + 1
        window = tuple(slice(int(a), int(b)) for a, b in zip(low, high, strict=True))
        regions = np.unique(self._free[window])
        regions = regions[regions > 0]
        if regions.tobytes() not in self._passable:
            passable = np.isin(self._free, regions)
            self._passable = {regions.tobytes(): distance_corners(passable, lung.grid.spacing_mm)}
        if self._needle is None:
            return self._surroundings(self._passable[regions.tobytes()])
        # Where the needle's paths to a target come from: the middle is where most tips are.
        starts = np.array([piece.cones[0, :3] for piece in self._space.pieces]).reshape(-1, 3) - target
        near = starts[np.linalg.norm(starts, axis=1) <= 2.0 * self._limits.max_length_mm]
        middle = near.mean(axis=0) if len(near) else np.array([0, 0, 1.0])
        backward = backward_reach(self._needle, target, middle)
        return self._surroundings(self._passable[regions.tobytes()], backward)

    def _surroundings(self, passable: np.ndarray, backward: BackwardReach = NOT_BOUNDED) -> ProofEnvironment:
        lung = self._lung
        lumen, leaving, hazards = self._masks
        depth = lung.lumen_depth
        return ProofEnvironment(
            lumen=lumen,
            may_be_left=leaving,
            hazards=hazards,
            depth=depth.corners,
            tips=self._tips,
            passable=passable,
            labels=lung.labels,
            not_lumen=self._not_lumen,
            geometry=lung.geometry,
            depth_geometry=depth.geometry,
            backward=backward,
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

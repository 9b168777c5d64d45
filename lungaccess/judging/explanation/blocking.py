"""What stops the direct arcs to a target, where, and the arc that comes nearest to being allowed."""

import math
from collections.abc import Iterator, Mapping
from types import MappingProxyType

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, BRANCH_SHIFT
from lungaccess.judging.explanation import kernels
from lungaccess.planning.coupled import DirectArcs
from lungaccess.plans.evaluator import blocker_name
from lungaccess.problem.preset_order import presets_by_invasiveness
from stages.needle import Needle, direct_path

MOST_ARCS = 4000
"""Arcs that are looked along, evenly chosen: enough for shares of a few percent, in about half a second."""
NEAR_MM = 5.0
"""Points that are so near to each other belong to one place of a structure."""


@frozen_record
class Structure:
    """Something that devices must not touch, at one place.

    Args:
        kind: "a vessel", "the pleura", "a fissure" or "an airway".
        name: What is known of it besides: the branch of an airway, the side of the lung.
        lps_mm ((3,) float64, LPS mm): Where it is met.
    """

    kind: str
    name: str
    lps_mm: Float
    from_target_mm: float

    def __str__(self) -> str:
        x, y, z = self.lps_mm
        return (
            f"{self.kind} {self.name} at LPS ({x:.1f}, {y:.1f}, {z:.1f}) mm, {self.from_target_mm:.1f} mm "
            "from the target"
        )


@frozen_record
class Blocking:
    """How many of the direct arcs one kind of structure stops first, and where most of them are stopped.

    Args:
        arcs, arcs_at_place, of: Arcs that it stops; those within `NEAR_MM` of the place; arcs that were
            looked along in all.
    """

    place: Structure
    arcs: int
    arcs_at_place: int
    of: int


@frozen_record
class BlockedArc:
    """The direct arc to the target, within the needle's limits, that violates least.

    Args:
        points_lps ((N, 3) float64, LPS mm): From the tip of the tubes to the target; where the clearance was
            looked up.
        length_mm, blocked_mm: Length of the arc, and of those parts of it that are too near to something.
        required_mm, shortfall_mm: Clearance that the needle's axis must keep, and how much of it is lacking
            at the worst place.
        structure: What it is too near to, at the first such place.
    """

    points_lps: Float
    length_mm: float
    blocked_mm: float
    required_mm: float
    shortfall_mm: float
    structure: Structure

    @property
    def violation(self) -> str:
        """By how much it violates the required clearance, in words."""
        of = f"{self.blocked_mm:.1f} of its {self.length_mm:.1f} mm are nearer than {self.required_mm:.2f} mm"
        if self.shortfall_mm >= self.required_mm:
            return f"{of}; it passes through"
        return f"{of}; {self.shortfall_mm:.2f} mm are lacking at the worst place"


@frozen_record
class ArcBeyondLimits:
    """The direct arc to the target that exceeds the needle's limits least; obstacles are not looked at.

    Args:
        points_lps: (N, 3) float64, LPS mm.
        radius_mm, length_mm, turn_deg: Radius of curvature, length and turning that it needs.
        least_radius_mm, most_length_mm, most_turn_deg: What the needle can do.
    """

    points_lps: Float
    radius_mm: float
    length_mm: float
    turn_deg: float
    least_radius_mm: float
    most_length_mm: float
    most_turn_deg: float

    @property
    def needs(self) -> str:
        """What it needs beyond the limits, in words."""
        needs = [
            (self.radius_mm < self.least_radius_mm, "a radius of curvature", self.radius_mm,
             f"at least {self.least_radius_mm:.0f} mm", "mm"),
            (self.length_mm > self.most_length_mm, "a length", self.length_mm,
             f"at most {self.most_length_mm:.0f} mm", "mm"),
            (self.turn_deg > self.most_turn_deg, "a turn", self.turn_deg,
             f"at most {self.most_turn_deg:.0f}°", "°"),
        ]  # fmt: skip
        words = " and ".join(
            f"{what} of {value:.0f}{'' if unit == '°' else ' '}{unit} (the needle allows {limit})"
            for exceeded, what, value, limit, unit in needs
            if exceeded
        )
        return f"needs {words}"


def look_along(arcs: DirectArcs) -> tuple[tuple[Blocking, ...], BlockedArc | None]:
    """Return what stops the direct arcs that keep the needle's limits, most first, and the least violating.

    At most `MOST_ARCS` arcs are looked along, evenly chosen from all with the target in their workspace.
    """
    chosen = arcs.in_workspace
    if len(chosen) > MOST_ARCS:
        chosen = chosen[np.linspace(0, len(chosen) - 1, MOST_ARCS).astype(np.int64)]
    if not len(chosen):
        return (), None
    entries, environment = arcs.atlas.deployments, arcs.evaluator.environment
    found, labels = np.zeros((len(chosen), kernels.N_COLUMNS)), np.zeros((len(chosen), 2), dtype=np.int64)
    x, y, z = arcs.task.target.lps_mm.tolist()
    starts = (entries.positions, entries.tangents, entries.branch)
    poses = (np.ascontiguousarray(each[chosen]) for each in starts)
    kernels.look_along_arcs(environment.obstacles, environment.limits, *poses, (x, y, z), found, labels)
    blocked = np.flatnonzero(found[:, kernels.SHORTFALL] > 0.0)
    if not len(blocked):
        return (), None
    rank = np.lexsort(
        # Shortfalls that differ by less count as equal, and the shorter blocked length decides.
        (found[blocked, kernels.BLOCKED], np.floor(found[blocked, kernels.SHORTFALL] / 0.05))
    )
    best = int(blocked[rank[0]])
    return (
        tuple(_blockings(arcs, found[blocked], labels[blocked, kernels.FIRST_LABEL])),
        BlockedArc(
            points_lps=_points(arcs, int(chosen[best])),
            length_mm=float(found[best, kernels.LENGTH]),
            blocked_mm=float(found[best, kernels.BLOCKED]),
            required_mm=environment.required_clearance_mm,
            shortfall_mm=float(found[best, kernels.SHORTFALL]),
            structure=_structure(arcs, _first(found)[best], int(labels[best, kernels.FIRST_LABEL])),
        ),
    )


def arc_beyond_limits(arcs: DirectArcs) -> ArcBeyondLimits | None:
    """Return the direct arc that exceeds the needle's limits least; None if one keeps them, or there is none.

    By how much a limit is exceeded is measured as a share of it, and these shares are added.  An arc that
    exceeds what every needle of the presets can do, too, is no near miss and is left out.
    """
    entries, needle = arcs.atlas.deployments, arcs.evaluator.environment.needle
    if not entries.count:
        return None
    offset = arcs.task.target.lps_mm - entries.positions
    ahead = (offset * entries.tangents).sum(axis=1)
    chord = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    aside = np.sqrt(np.maximum(chord**2 - ahead**2, 0.0))
    curvature, turn = 2.0 * aside / chord**2, 2.0 * np.arctan2(aside, ahead)
    length = np.where(turn > 1e-6, turn / np.maximum(curvature, 1e-12), chord)
    most_turn = _most_turn(needle)
    shares = (curvature / needle.max_curvature_per_mm, length / needle.max_length_mm, turn / most_turn)
    excess = np.sum([np.maximum(share - 1.0, 0.0) for share in shares], axis=0)
    possible = np.zeros(len(chord), dtype=bool)
    for each in (needle, *(system.needle for system in presets_by_invasiveness())):
        if each is not None:
            short = (length <= each.max_length_mm) & (turn <= _most_turn(each))
            possible |= (curvature <= each.max_curvature_per_mm) & short
    best = int(np.argmin(np.where(possible, excess, np.inf)))
    if excess.min() <= 0.0 or not possible[best]:
        return None
    return ArcBeyondLimits(
        points_lps=_points(arcs, best),
        radius_mm=float(1.0 / max(curvature[best], 1e-12)),
        length_mm=float(length[best]),
        turn_deg=math.degrees(float(turn[best])),
        least_radius_mm=needle.min_radius_of_curvature_mm,
        most_length_mm=needle.max_length_mm,
        most_turn_deg=math.degrees(most_turn),
    )


def _most_turn(needle: Needle) -> float:
    """Return the angle in rad by which a needle may turn from its start, on one arc."""
    return math.radians(min(needle.max_angle_from_start_deg, needle.max_accumulated_turn_deg))


def region_of(lung: Lung, point: Float) -> str:
    """Return the lobe that holds a point (3,) LPS mm, or the side of the carina where lobes are not known."""
    return lung.lobe_at(point) or ("left lung" if point[0] > lung.tree.carina_lps[0] else "right lung")


def _first(found: Float) -> Float:
    return found[:, kernels.FIRST : kernels.FIRST + 3]


def _blockings(arcs: DirectArcs, found: Float, labels: Int) -> Iterator[Blocking]:
    """Yield the kinds of structures that stop arcs, most first, each at its fullest place."""
    names = np.array([blocker_name(int(label)) for label in labels])
    kinds, counts = np.unique(names, return_counts=True)
    for n in np.argsort(-counts, kind="stable"):
        mine = np.flatnonzero(names == kinds[n])
        points = _first(found)[mine]
        cells = np.floor(points / NEAR_MM).astype(np.int64)
        _cells, of_point, sizes = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
        centre = points[np.flatnonzero(of_point.ravel() == np.argmax(sizes))].mean(axis=0)
        away = np.linalg.norm(points - centre, axis=1)
        nearest = int(np.argmin(away))
        yield Blocking(
            place=_structure(arcs, points[nearest], int(labels[mine[nearest]])),
            arcs=int(counts[n]),
            arcs_at_place=int(np.count_nonzero(away <= NEAR_MM)),
            of=len(found),
        )


def _structure(arcs: DirectArcs, point: Float, label: int) -> Structure:
    lung = arcs.task.lung
    segment = lung.segment_at(point)
    name = f"in {segment}, {region_of(lung, point)}" if segment else f"in the {region_of(lung, point)}"
    kind = blocker_name(label)
    branch = (label >> BRANCH_SHIFT) - 1
    if kind == "an airway" and label & AIRWAY and branch >= 0:
        name = f"(branch {lung.branch_words(branch)}, generation {int(lung.tree.generation[branch])}) {name}"
    away = float(np.linalg.norm(point - arcs.task.target.lps_mm))
    return Structure(kind=kind, name=name, lps_mm=np.array(point), from_target_mm=away)


def _points(arcs: DirectArcs, entry: int) -> Float:
    """Return points of the direct arc of an entry of the atlas."""
    from anatomy import poses

    entries = arcs.atlas.deployments
    frame = poses.pose(entries.positions[entry], entries.tangents[entry])
    return direct_path(frame, arcs.task.target.lps_mm).sample(kernels.STEP_MM)[0]


CLEAR, LIMITS, OUT_OF_REACH = "clear", "needs several arcs", "out of reach"
FAILS = MappingProxyType(
    {
        CLEAR: "a single arc reaches the target",
        "a vessel": "blocked by a vessel",
        "a fissure": "blocked by a fissure",
        "an airway": "blocked by an airway",
        "the pleura": "blocked by the pleura",
        LIMITS: "reaches the target with several arcs only",
        OUT_OF_REACH: "out of the needle's reach",
    }
)
"""Why a start fails, in words; the nearest to success first."""


@frozen_record
class StartMap:
    """Where a needle can start, cell by cell, and why it does not reach the target from there.

    Args:
        points_lps ((C, 3) float64, LPS mm): The middle of the starts of a cell.
        why ((C,) int64): Index into `FAILS` of the best of the starts of a cell.
        counts: How many starts fail for each reason of `FAILS`, all starts counted.
    """

    points_lps: Float
    why: Int
    counts: Mapping[str, int]


def map_starts(arcs: DirectArcs) -> StartMap:
    """Return the starts of an atlas with the reason why each one's direct arc fails."""
    entries, names = arcs.atlas.deployments, list(FAILS)
    why = np.full(entries.count, names.index(OUT_OF_REACH), dtype=np.int64)
    labels, of_arc = np.unique(arcs.blockers(arcs.in_workspace)[0], return_inverse=True)
    reasons = {"nothing": CLEAR, "the needle's limits": LIMITS}
    blockers = [blocker_name(int(label)) for label in labels]
    codes = np.array([names.index(reasons.get(name, name)) for name in blockers], dtype=np.int64)
    why[arcs.in_workspace] = codes[of_arc.ravel()] if len(labels) else why[arcs.in_workspace]
    counted = np.bincount(why, minlength=len(names))
    # Starts in one cube of this side are shown as one: about the distance at which two dots are still two.
    cells = np.floor(entries.positions / 4.0).astype(np.int64)
    _cells, of_start = np.unique(cells, axis=0, return_inverse=True)
    of_start = of_start.ravel()
    count = int(of_start.max(initial=-1)) + 1
    best = np.full(count, len(names), dtype=np.int64)
    np.minimum.at(best, of_start, why)
    chosen = np.flatnonzero(why == best[of_start]) if count else np.zeros(0, dtype=np.int64)
    sizes = np.maximum(np.bincount(of_start[chosen], minlength=count), 1)
    middle = [
        np.bincount(of_start[chosen], entries.positions[chosen, axis], minlength=count) / sizes
        for axis in range(3)
    ]
    return StartMap(
        points_lps=np.stack(middle, axis=1),
        why=best,
        counts=MappingProxyType({FAILS[name]: int(n) for name, n in zip(names, counted, strict=True)}),
    )

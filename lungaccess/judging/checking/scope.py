"""Second part of the check: the bronchoscope can move as stated, in the lumen, and its tip ends as stated.

Its kinematics are products of exponentials of screws, one for every state of a motion.  The bending section
is a screw: forward at unit speed, turning towards where twist and bend point.  The base follows the section
when the scope advances, and stays where it is when it twists or bends.
"""

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from lungaccess.judging.checking.boxes import Boxes, Environment, not_lumen
from lungaccess.judging.checking.findings import (
    ANGLE_TOLERANCE_RAD,
    POSITION_TOLERANCE_MM,
    Findings,
    angle_between,
    check_rigid,
    check_same_pose,
)
from lungaccess.plans.parts import ScopeInsertion
from lungaccess.problem.system import System
from stages.scope.device import Bronchoscope

TINY_MM = 1e-9
TINY_RAD = 1e-9
"""A smaller change between two states is rounding."""


@frozen_record
class Motion:
    """The bases of a bending section in all states of a motion, re-derived; M states.

    Args:
        states ((M, 3) float64): Advance in mm, twist in rad, bend in rad.
        bends ((M, 2) float64): Curvature of the section in the x and y directions of its base, 1/mm.
        bases ((M, 4, 4) float64): `lps_from_base`; none is rolled by the twist.
    """

    states: Float
    bends: Float
    bases: Float
    section_mm: float

    @property
    def advances(self) -> Float:
        """Advance from each state to the next, `(M - 1,)` mm."""
        return np.asarray(np.diff(self.states[:, 0]))

    @property
    def turns(self) -> Bool:
        """Tell between which states twist or bend change, `(M - 1,)`."""
        return np.asarray((np.abs(np.diff(self.states[:, 1:], axis=0)) > TINY_RAD).any(axis=1))

    @property
    def moves(self) -> Bool:
        """Tell between which states the scope advances, `(M - 1,)`."""
        return np.asarray(np.abs(self.advances) > TINY_MM)

    @property
    def tip(self) -> Float:
        """Frame of the tip in the last state, rolled by the twist, `(4, 4)`."""
        end = self.bases[-1] @ screws(self.bends[-1:], np.array([self.section_mm]))[0]
        twist = self.states[-1, 1]
        roll = np.eye(4)
        roll[:2, :2] = [[np.cos(twist), -np.sin(twist)], [np.sin(twist), np.cos(twist)]]
        return np.asarray(end @ roll)

    def points(self, states: Int, along_mm: Float, bends: Float | None = None) -> Float:
        """Return points `(N, 3)`, LPS mm, on the arcs that begin at the bases of some states.

        Args:
            states: (N,) int64.
            along_mm ((N,) float64): Lengths from the bases.
            bends ((N, 2) float64): Curvatures, if not those of the states.
        """
        local = screws(self.bends[states] if bends is None else bends, along_mm)[:, :3, 3]
        return np.asarray(
            (self.bases[states, :3, :3] @ local[:, :, None])[:, :, 0] + self.bases[states, :3, 3]
        )

    def body_pieces(self) -> tuple[Int, Float]:
        """Return the arcs of the body in the last state: their states `(P,)` and lengths `(P,)` in mm.

        What draws back, which a motion must not, lays none.
        """
        moved = np.flatnonzero(self.advances > TINY_MM)
        return np.append(moved, len(self.states) - 1), np.append(self.advances[moved], self.section_mm)

    def body(self, step_mm: float) -> tuple[Float, Float]:
        """Return points `(N, 3)` of the body in the last state and their distances `(N,)` from the entry."""
        states, lengths = self.body_pieces()
        counts = np.maximum(np.ceil(lengths / step_mm).astype(np.int64), 1)
        which = np.repeat(states, counts)
        number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
        along = np.repeat(lengths / counts, counts) * (number + 1)
        begin = np.repeat(np.cumsum(lengths) - lengths, counts)
        points = np.concatenate([self.bases[:1, :3, 3], self.points(which, along)])
        return points, np.append(0.0, begin + along)


def motion_of(lps_from_entry: Float, states: Float, section_mm: float) -> Motion:
    """Follow the states of a motion from its entry."""
    bends = states[:, 2:] / section_mm * np.stack([np.cos(states[:, 1]), np.sin(states[:, 1])], axis=1)
    bases = [np.asarray(lps_from_entry, dtype=np.float64)]
    for step in screws(bends[:-1], np.diff(states[:, 0])):
        bases.append(bases[-1] @ step)
    return Motion(states=states, bends=bends, bases=np.array(bases), section_mm=section_mm)


def screws(bends: Float, lengths_mm: Float) -> Float:
    """Return the exponentials `(N, 4, 4)` of screws that go forward along +z and turn towards a direction.

    They follow Rodrigues' formula for rigid motions [Rucker2010, twist exponentials].

    Args:
        bends ((N, 2) float64): Curvature in the x and y directions, 1/mm.
        lengths_mm: (N,) float64.
    """
    s = np.asarray(lengths_mm, dtype=np.float64)
    spin = np.zeros((len(s), 3, 3))
    # The axis of rotation is z x bend; its cross matrix takes z to the bend.
    spin[:, 0, 2], spin[:, 1, 2] = bends[:, 0], bends[:, 1]
    spin[:, 2, 0], spin[:, 2, 1] = -bends[:, 0], -bends[:, 1]
    angle = np.hypot(bends[:, 0], bends[:, 1]) * s
    # Below this angle the coefficients of a screw come from their series, whose next term is below 1e-12.
    small = np.abs(angle) < 1e-2
    safe = np.where(small, 1.0, angle)
    square = angle**2
    first = np.where(small, 1.0 - square / 6.0 + square**2 / 120.0, np.sin(safe) / safe)
    second = np.where(small, 0.5 - square / 24.0 + square**2 / 720.0, (1.0 - np.cos(safe)) / safe**2)
    third = np.where(small, 1.0 / 6.0 - square / 120.0 + square**2 / 5040.0, (safe - np.sin(safe)) / safe**3)
    twice = spin @ spin
    out = np.zeros((len(s), 4, 4))
    out[:, :3, :3] = np.eye(3) + (first * s)[:, None, None] * spin + (second * s**2)[:, None, None] * twice
    along = s[:, None, None] * np.eye(3)
    along = along + (second * s**2)[:, None, None] * spin + (third * s**3)[:, None, None] * twice
    out[:, :3, 3] = along[:, :, 2]
    out[:, 3, 3] = 1.0
    return out


MAX_ANGLE_RAD = np.deg2rad(45.0)
"""A scope looks along the airway, within so much: more means sideways."""
MARGIN_TOLERANCE_MM = 0.05
"""The stated margin may be so much too large."""
CURVATURE_TOLERANCE_PER_MM = 1e-9
"""Rounding of an angle divided by a length."""


def check_scope(scope: ScopeInsertion, system: System, environment: Environment, found: Findings) -> None:
    """Record everything about the bronchoscope."""
    if not (check_rigid("scope.entry", scope.lps_from_entry, found) & _check_order(scope.states, found)):
        return
    motion = motion_of(scope.lps_from_entry, scope.states, system.scope.bending_length_mm)
    _check_limits(motion, system, found)
    _check_start(motion, environment, found)
    _check_fit(scope, motion, system.scope, environment, found)
    if check_rigid("scope.tip", scope.lps_from_scope_tip, found):
        check_same_pose("scope.tip", scope.lps_from_scope_tip, motion.tip, found)
    _check_end(motion, environment, found)
    _check_statements(scope, motion, environment, found)


def _check_order(states: Float, found: Findings) -> bool:
    """The scope begins at its entry, never draws back, and turns only where it does not advance."""
    if not found.true("scope.states", len(states) > 0, f"{len(states)} states"):
        return False
    steps = np.diff(states, axis=0)
    found.at_most("scope.states.first", abs(float(states[0, 0])), TINY_MM, "mm", "advance of the first state")
    forward = found.at_least(
        "scope.states.forward", float(steps[:, 0].min(initial=0.0)), -TINY_MM, "mm", "smallest advance"
    )
    turns = (np.abs(steps[:, 1:]) > TINY_RAD).any(axis=1)
    both = int((turns & (np.abs(steps[:, 0]) > TINY_MM)).sum())
    return forward & found.true(
        "scope.states.one_at_a_time", both == 0, f"{both} steps advance and turn at once"
    )


def _check_limits(motion: Motion, system: System, found: Findings) -> None:
    """Bends are within those of the device, with the scope standing still and while it lays its shaft."""
    scope, bends = system.scope, motion.states[:, 2]
    up, down = np.deg2rad([scope.bend_up_deg, scope.bend_down_deg])
    found.at_most("scope.bend.up", float(bends.max()), float(up), "rad", "largest bend", TINY_RAD)
    found.at_most("scope.bend.down", float(-bends.min()), float(down), "rad", "largest bend down", TINY_RAD)
    of_section = float(np.abs(bends).max()) / motion.section_mm
    found.at_most(
        "scope.bend.radius", of_section, 1.0 / scope.min_bending_radius_mm, "1/mm",
        "largest curvature of the bending section", CURVATURE_TOLERANCE_PER_MM,
    )  # fmt: skip
    led = np.abs(bends[:-1][motion.moves]).max(initial=0.0) / motion.section_mm
    found.at_most(
        "scope.shaft.radius", float(led), 1.0 / scope.min_shaft_radius_mm, "1/mm",
        "largest curvature of the shaft behind the section", CURVATURE_TOLERANCE_PER_MM,
    )  # fmt: skip


def _check_start(motion: Motion, environment: Environment, found: Findings) -> None:
    """The motion begins on the axis of the trachea, near its beginning, and looks down it."""
    tree, entry = environment.lung.tree, motion.bases[0]
    nearest = int(environment.nearest_tree_points(entry[:3, 3], 1)[0])
    found.true("scope.start.trachea", tree.branch_of_point[nearest] == 0, "branch at the entry")
    gap = float(np.linalg.norm(entry[:3, 3] - tree.points_lps[nearest]))
    # Entries are points of the airway tree, so that only rounding lies between them.
    found.at_most("scope.start", gap, 0.01, "mm", "entry to the axis of the trachea")
    depth = float(tree.distance_from_root_mm[nearest])
    # A motion begins at most so far from the root of the airway tree: a trachea is about 100 mm long.
    found.at_most("scope.start.depth", depth, 30.0, "mm", "root of the airway tree to the entry")
    tilt = float(angle_between(entry[:3, 2], tree.tangents[nearest]))
    found.at_most("scope.start.direction", tilt, float(MAX_ANGLE_RAD), "rad", "entry to the trachea")


def _check_fit(
    scope: ScopeInsertion, motion: Motion, device: Bronchoscope, environment: Environment, found: Findings
) -> None:
    """The lumen is wide enough for the body in every state and between them, and by as much as stated."""
    radius = 0.5 * device.outer_diameter_mm
    needed = radius + device.lumen_margin_mm
    stated = scope.min_lumen_margin_mm + radius
    # Distances are measured so far beyond what is needed: as far as the first cells of a motion reach.
    boxes = environment.boxes(not_lumen, max(needed, stated) + 1.0)
    gap = least_gap_mm(motion, boxes, needed - POSITION_TOLERANCE_MM, stated - MARGIN_TOLERANCE_MM)
    found.at_least(
        "scope.fits", gap, needed, "mm",
        "smallest lumen radius, in all states and between them; needed: radius of the scope plus its margin",
        POSITION_TOLERANCE_MM,
    )  # fmt: skip
    found.at_most(
        "scope.margin", stated - gap, 0.0, "mm", "stated beyond recomputed margin", MARGIN_TOLERANCE_MM
    )
    detail = "stated margin between scope and wall"
    found.at_least("scope.margin.limit", scope.min_lumen_margin_mm, device.lumen_margin_mm, "mm", detail)


def _check_end(motion: Motion, environment: Environment, found: Findings) -> None:
    """The tip lies where tips may be: beside the axis of the airway, looking on along it."""
    tree, tip = environment.lung.tree, motion.tip
    nearest = int(environment.nearest_tree_points(tip[:3, 3], 1)[0])
    gap = float(np.linalg.norm(tip[:3, 3] - tree.points_lps[nearest]))
    # Proofs that a target is unreachable rule out tips up to here from the nearest point of the airway tree.
    found.at_most("scope.tip.off_axis", gap, 3.0, "mm", "tip to the airway tree", POSITION_TOLERANCE_MM)
    tilt = float(angle_between(tip[:3, 2], tree.tangents[nearest]))
    found.at_most(
        "scope.tip.forward", tilt, float(MAX_ANGLE_RAD), "rad", "tip to the airway", ANGLE_TOLERANCE_RAD
    )


def _check_statements(
    scope: ScopeInsertion, motion: Motion, environment: Environment, found: Findings
) -> None:
    """Branches, generation, lengths and curvature are what tree and motion say."""
    tree = environment.lung.tree
    nearest = environment.nearest_tree_points(motion.tip[:3, 3], 3)
    last = int(scope.branches[-1]) if len(scope.branches) else -1
    near = sorted({int(branch) for branch in tree.branch_of_point[nearest]})
    if found.true("scope.branch", last in near, f"{last} against {near} at the tip"):
        way = branches_to(tree, last)
        found.true("scope.branches", way == scope.branches.tolist(), "branches from the trachea to the tip")
        generation = int(tree.generation[last])
        detail = f"{scope.generation} against {generation}"
        found.true("scope.generation", scope.generation == generation, detail)
    states, lengths = motion.body_pieces()
    found.agrees("scope.length", scope.length_mm, float(lengths.sum()), POSITION_TOLERANCE_MM, "mm")
    beyond = beyond_carina_mm(motion, tree)
    # The place of the body that is nearest to a point, by two samplings, agrees to less than this.
    found.agrees("scope.length_from_carina", scope.length_from_carina_mm, beyond, 0.1, "mm")
    most = float(np.hypot(*motion.bends[states].T).max())
    found.agrees("scope.curvature", scope.max_curvature_per_mm, most, CURVATURE_TOLERANCE_PER_MM, "1/mm")


def branches_to(tree: AirwayTree, branch: int) -> list[int]:
    """Return the branches from the trachea to one of them."""
    way = [branch]
    while tree.branch_parent[way[0]] >= 0:
        way.insert(0, int(tree.branch_parent[way[0]]))
    return way


def beyond_carina_mm(motion: Motion, tree: AirwayTree) -> float:
    """Return the length of the body beyond the place of it that is nearest to the carina."""
    # Spacing of the points of the body among which the nearest to the carina is looked for.
    points, along = motion.body(0.1)
    passed = float(along[np.linalg.norm(points - tree.carina_lps, axis=1).argmin()])
    return float(along[-1]) - passed


@frozen_record
class Cells:
    """Places of a moving section: C cells, pieces of arc, or also of time where the section twists or bends.

    A cell is measured at its middle: no other place of it is farther from there than its length and its
    motion say, so that a cell that may come too near is cut in two, until it is seen whether it does.

    Args:
        state ((C,) int64): State from which on the scope moves.
        along_mm, half_mm ((C,) float64): Middle and half length of the piece of arc, from the base of that
            state.
        time, half_time ((C,) float64): Middle and half length of the share of the way to the next state; 0
            where the section slides.
    """

    state: Int
    along_mm: Float
    half_mm: Float
    time: Float
    half_time: Float

    def pick(self, which: Bool | Int) -> "Cells":
        """Return some of the cells."""
        return Cells(**{name: value[which] for name, value in vars(self).items()})

    def halves(self, in_time: Bool) -> "Cells":
        """Cut every cell in two, along time where asked for, else along the arc."""
        twice = self.pick(np.repeat(np.arange(len(self.state)), 2))
        side = np.tile([-0.5, 0.5], len(self.state))
        over = np.repeat(in_time, 2)
        return Cells(
            state=twice.state,
            along_mm=np.where(over, twice.along_mm, twice.along_mm + side * twice.half_mm),
            half_mm=np.where(over, 1.0, 0.5) * twice.half_mm,
            time=np.where(over, twice.time + side * twice.half_time, twice.time),
            half_time=np.where(over, 0.5, 1.0) * twice.half_time,
        )


def least_gap_mm(motion: Motion, boxes: Boxes, needed_mm: float, stated_mm: float) -> float:
    """Return a distance of the axis of the body from a structure that occurs during a motion.

    It is below `needed_mm` if any is, and below `stated_mm` if any is; else there may be smaller ones.
    """
    cells, least = _first_cells(motion), np.inf
    while len(cells.state):
        gaps = boxes.distance_mm(places(motion, cells))
        least = min(least, float(gaps.min()))
        kept = [limit for limit in (needed_mm, stated_mm) if limit <= least]
        if not kept:
            break
        arc, swept = cells.half_mm, _swept_mm(motion, cells)
        # A cell whose places differ by less is not cut further.
        open_ = (gaps - arc - swept < max(kept)) & (arc + swept > 1e-3)
        cells = cells.pick(open_).halves(swept[open_] > arc[open_])
    return least


def _first_cells(motion: Motion) -> Cells:
    """Return cells that cover all places of the section: it slides, twists and bends, and stays at the end.

    The shaft lies on what the section has slid along.
    """
    # From which states the section slides on, and the lengths of the arcs that it covers.
    moves = motion.moves
    begins = np.flatnonzero(moves & ~np.append(False, moves[:-1]))
    ends = np.flatnonzero(moves & ~np.append(moves[1:], False)) + 1
    advance = motion.states[:, 0]
    slides, lengths = begins, advance[ends] - advance[begins] + motion.section_mm
    in_place = np.flatnonzero(motion.turns)
    states = np.concatenate([slides, in_place, [len(motion.states) - 1]])
    total = np.concatenate([lengths, np.full(len(in_place) + 1, motion.section_mm)])
    half_time = np.concatenate([np.zeros(len(slides)), np.full(len(in_place), 0.5), [0.0]])
    order = np.argsort(states, kind="stable")
    states, total, half_time = states[order], total[order], half_time[order]
    # Half the length of cells to begin with: about the room that a scope has in the airways it fits into.
    counts = np.maximum(np.ceil(0.5 * total / 1.0).astype(np.int64), 1)
    half = np.repeat(0.5 * total / counts, counts)
    number = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
    return Cells(
        state=np.repeat(states, counts),
        along_mm=(2 * number + 1) * half,
        half_mm=half,
        time=np.repeat(half_time, counts),
        half_time=np.repeat(half_time, counts),
    )


def places(motion: Motion, cells: Cells) -> Float:
    """Return the middles of cells, `(C, 3)` LPS mm."""
    after = np.minimum(cells.state + 1, len(motion.states) - 1)
    begin, end = motion.states[cells.state, 1:], motion.states[after, 1:]
    time = np.where(cells.half_time == 0.0, 0.0, cells.time)[:, None]
    twist, bend = (begin + time * (end - begin)).T
    curvature = bend / motion.section_mm
    bends = curvature[:, None] * np.stack([np.cos(twist), np.sin(twist)], axis=1)
    return motion.points(cells.state, cells.along_mm, bends)


def _swept_mm(motion: Motion, cells: Cells) -> Float:
    """Return how far `(C,)` a place of a cell moves at most from the middle of its time, mm.

    A curvature that changes by d turns the section at the arc length s by no more than d s, and so moves it
    by no more than d s^2 / 2.
    """
    after = np.minimum(cells.state + 1, len(motion.states) - 1)
    change = motion.states[after, 1:] - motion.states[cells.state, 1:]
    most = np.maximum(np.abs(motion.states[after, 2]), np.abs(motion.states[cells.state, 2]))
    rate = np.hypot(change[:, 1], most * change[:, 0]) / motion.section_mm
    return np.asarray(rate * cells.half_time * 0.5 * (cells.along_mm + cells.half_mm) ** 2)

"""The exits of lesions [Pan2025, eqs. 1 and 2], the part of the tree that leads to them, and its circuits."""

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import SettingsError, TargetError
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from stages.scope.tour.kernels.circuit import all_resistances

ExitTest = Callable[[int, int], bool]
"""Tells whether a lesion, given by its number, can be reached from a tree point, given by its index."""


@settings
class ExitRule:
    """How target positions are chosen.

    The reach is the paper's 40 mm, the length of common needles; k of eq. 2 is 0.5 to 2 there.  L / S is how
    deep a biopsy goes, over the diameter of the lesion.  The sphere that grows is the one around the lesion.
    """

    reach_mm: Annotated[float, quantity("largest distance from the lesion", above=0.0, at_most=200.0)] = 40.0
    step_mm: Annotated[float, quantity("growth of the sphere", above=0.0, at_most=10.0)] = 0.2
    calibration: Annotated[float, quantity("k of eq. 2", at_least=0.0, at_most=100.0)] = 1.0
    depth_over_diameter: Annotated[float, quantity("L / S of eq. 2", at_least=0.0, at_most=100.0)] = 1.0

    @property
    def angle_weight(self) -> float:
        """W_theta of eq. 2, read as `k L / S / (1 + k L / S)`; W_l is what it lacks to 1."""
        ratio = self.calibration * self.depth_over_diameter
        return ratio / (1.0 + ratio)


@frozen_value
class Exit:
    """A point of the airway from where a lesion is taken.

    Args:
        roles: Which of "P1", "P2", "P3" it is; "inside" for a lesion in the airway.
        distance_mm: To the lesion.
        angle_rad: Between the airway, away from its root, and the line to the lesion.
        weighted: Eq. 1 with both terms as shares of their largest value; 0 inside.
    """

    lesion: int
    tree_point: int
    roles: tuple[str, ...]
    distance_mm: float
    angle_rad: float
    weighted: float


def find_exits(
    tree: AirwayTree, lesions_lps: ArrayLike, *, rule: ExitRule | None = None, accepts: ExitTest | None = None
) -> tuple[tuple[Exit, ...], ...]:
    """Return up to three exits for each lesion `(M, 3)` LPS mm: P1, P2 and P3 of [Pan2025].

    P1 has the smallest angle, P2 the smallest distance, P3 the smallest weighted sum of both; the paper says
    largest, which would be the worst point.  Where two are the same point, it is listed once.  A lesion whose
    centre lies in the lumen has one exit, the nearest point.  Tree points that are not accepted are no
    candidates.  Raises TargetError if a lesion has no candidate within reach.
    """
    chosen = rule or ExitRule()
    lesions = np.asarray(lesions_lps, dtype=np.float64).reshape(-1, 3)
    return tuple(exits_of(tree, number, lesion, chosen, accepts) for number, lesion in enumerate(lesions))


def exits_of(
    tree: AirwayTree, number: int, lesion: Float, rule: ExitRule, accepts: ExitTest | None
) -> tuple[Exit, ...]:
    """Return the exits of one lesion, `(3,)` LPS mm, which is given a number; see `find_exits`."""
    offset = lesion - tree.points_lps
    distance = np.linalg.norm(offset, axis=1)
    nearest = int(np.argmin(distance))
    inside = distance[nearest] <= tree.radius_mm[nearest]
    # The sphere that first reaches a point; points met in the same step are equally far.
    grown = np.ceil(distance / rule.step_mm) * rule.step_mm
    points = np.array([nearest]) if inside else np.flatnonzero(grown <= rule.reach_mm)
    if accepts is not None:
        points = np.array([point for point in points.tolist() if accepts(number, point)], dtype=np.int64)
    if not len(points):
        why = "no point of the airway within reach is accepted"
        if distance[nearest] > rule.reach_mm:
            why = f"the nearest point of the airway is {distance[nearest]:.1f} mm away"
        raise TargetError(
            f"The lesion at LPS ({', '.join(f'{x:.1f}' for x in lesion)}) has no exit: {why}",
            expected=f"a point of the airway within {rule.reach_mm:g} mm"
            + ("" if accepts is None else " that is accepted"),
            remedy="Leave the lesion out, or allow a longer reach",
        )
    line = offset[points] / np.maximum(distance[points], 1e-12)[:, None]
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", line, tree.tangents[points]), -1.0, 1.0))
    weight = rule.angle_weight
    weighted = (1.0 - weight) * distance[points] / rule.reach_mm + weight * angle / np.pi
    depth = tree.distance_from_root_mm[points]
    sizes = {"inside": angle} if inside else {"P1": angle, "P2": grown[points], "P3": weighted}
    roles: dict[int, tuple[str, ...]] = {}
    for role, size in sizes.items():
        at = int(np.lexsort((depth, size))[0])
        roles[at] = (*roles.get(at, ()), role)
    return tuple(
        Exit(
            lesion=number,
            tree_point=int(points[at]),
            roles=names,
            distance_mm=float(distance[points[at]]),
            angle_rad=float(angle[at]),
            weighted=0.0 if inside else float(weighted[at]),
        )
        for at, names in roles.items()
    )


MAIN, LEFT, RIGHT = 0, 1, 2
"""Sides of a stretch: above the carina, of the left lung, of the right lung."""

MOST_LESIONS = 62
"""A set of lesions is an int64 with one bit a lesion, and the next larger power of two must fit as well."""


@frozen_record
class Subtree:
    """The stretches from the root to all exits; K vertices, parents first, and X exits of M lesions.

    A vertex is the root, a fork of paths to different exits, an exit, or the carina.  Where more than two
    paths part, the vertex has more than two children; that is the same as a chain of binary forks with
    stretches of no length and no resistance between them.

    Args:
        tree_point ((K,) int64): Index into the airway tree.
        parent ((K,) int64): -1 for the root.
        length_mm, resistance ((K,) float64): Of the stretch from the parent; 0 for the root.
        side ((K,) int64): Of the stretch: 0 above the carina, 1 left, 2 right.
        exits: Ordered by lesion.
        exit_vertex: (X,) int64.
        exit_resistance ((X,) float64): Of lesion and needle: eta, and outside the airway the weighted sum.
        exit_cost_mm ((X,) float64): What taking this exit costs besides the length of the tour, as a length.
    """

    tree_point: Int
    parent: Int
    length_mm: Float
    resistance: Float
    side: Int
    exits: tuple[Exit, ...]
    exit_vertex: Int
    exit_resistance: Float
    exit_cost_mm: Float

    @property
    def n_vertices(self) -> int:
        """Number of vertices, K."""
        return len(self.parent)

    @property
    def n_lesions(self) -> int:
        """Number of lesions, M."""
        return self.exits[-1].lesion + 1

    @property
    def exit_lesion(self) -> Int:
        """The lesion of each exit, `(X,)`."""
        return np.array([e.lesion for e in self.exits], dtype=np.int64)

    @property
    def depth_mm(self) -> Float:
        """Distance from the root to each vertex along the tree, `(K,)`."""
        depth = np.zeros(self.n_vertices)
        for v in range(1, self.n_vertices):
            depth[v] = depth[self.parent[v]] + self.length_mm[v]
        return depth


def subtree_to(
    tree: AirwayTree,
    exits: Sequence[Sequence[Exit]],
    *,
    weights: "Resistances | None" = None,
    exit_cost_mm: Sequence[Sequence[float]] | None = None,
) -> Subtree:
    """Return the part of a tree that leads from the root to the exits of each lesion; costs are 0 if None.

    Raises:
        SettingsError: If there are no lesions, one without exits, or more than 62.
    """
    if not exits or not all(len(of_one) for of_one in exits) or len(exits) > MOST_LESIONS:
        raise SettingsError(
            f"A tour was asked for {len(exits)} lesions with {[len(e) for e in exits]} exits",
            expected=f"1 to {MOST_LESIONS} lesions with at least one exit each",
        )
    chosen = weights or Resistances()
    flat = tuple(e for of_one in exits for e in of_one)
    vertices = _vertices(tree, np.array([e.tree_point for e in flat], dtype=np.int64))
    at = np.full(tree.n_points, -1, dtype=np.int64)
    at[vertices] = np.arange(len(vertices))
    parent, length, resistance = _stretches(tree, vertices, at, branch_resistances(tree, chosen))
    outside = np.array([0.0 if e.roles == ("inside",) else e.weighted for e in flat])
    costs = [[0.0] * len(of_one) for of_one in exits] if exit_cost_mm is None else exit_cost_mm
    cost = np.array([c for of_one in costs for c in of_one])
    if cost.shape != (len(flat),) or not (cost >= 0).all():
        raise SettingsError("The costs of the exits do not fit", expected="one number of at least 0 for each")
    return Subtree(
        tree_point=read_only(vertices),
        parent=read_only(parent),
        length_mm=read_only(length),
        resistance=read_only(resistance),
        side=read_only(_sides(tree)[tree.branch_of_point[vertices]]),
        exits=flat,
        exit_vertex=read_only(at[[e.tree_point for e in flat]]),
        exit_resistance=read_only(chosen.eta + outside),
        exit_cost_mm=read_only(np.asarray(cost, dtype=np.float64)),
    )


def _vertices(tree: AirwayTree, points: Int) -> Int:
    """Return root, carina, exits and forks between them, parents first."""
    used = np.zeros(tree.n_points, dtype=bool)
    for point in np.unique(points).tolist():
        while point >= 0 and not used[point]:
            used[point] = True
            point = int(tree.parent_point[point])
    kept = used & (np.bincount(tree.parent_point[1:][used[1:]], minlength=tree.n_points) > 1)
    kept[points] = kept[0] = True
    kept[tree.carina_point] |= bool(used[tree.carina_point])
    return np.flatnonzero(kept)


def _stretches(tree: AirwayTree, vertices: Int, at: Int, z: Float) -> tuple[Int, Float, Float]:
    """Return parent, length and resistance of each vertex; a part of a branch has its share of it."""
    per_mm = z / np.maximum(tree.branch_length_mm, 1e-9)
    parent = np.full(len(vertices), -1, dtype=np.int64)
    length, resistance = np.zeros(len(vertices)), np.zeros(len(vertices))
    for v, here in enumerate(vertices.tolist()):
        while parent[v] < 0 and (above := int(tree.parent_point[here])) >= 0:
            step = float(tree.distance_from_root_mm[here] - tree.distance_from_root_mm[above])
            length[v] += step
            resistance[v] += step * float(per_mm[tree.branch_of_point[here]])
            here, parent[v] = above, at[above]
    return parent, length, resistance


def _sides(tree: AirwayTree) -> Int:
    """Return the side of each branch, from where its main bronchus ends relative to the carina (+x left)."""
    side = np.zeros(tree.n_branches, dtype=np.int64)
    for branch in range(1, tree.n_branches):
        above = int(tree.branch_parent[branch])
        if above == 0:
            end = tree.points_lps[tree.branch_start[branch + 1] - 1]
            side[branch] = LEFT if end[0] > tree.carina_lps[0] else RIGHT
        else:
            side[branch] = side[above]
    return side


EXAMPLE_BETA = 2.5
"""With this weight the paper's worked example gives what it prints; with its stated 0.2 it does not."""


@settings
class Resistances:
    """Weights of the equivalent resistance [Pan2025, eq. 3], with the values that the paper states.

    Its worked example needs beta = 2.5, see `EXAMPLE_BETA`.  Angles are those with the preceding branch, in
    rad.  Down to which generation branches have cartilage is a reading: the paper tells it case by case.
    """

    alpha: Annotated[float, quantity("weight of length over diameter", at_least=0.0, at_most=1e3)] = 1.0
    beta: Annotated[float, quantity("weight of the angle", at_least=0.0, at_most=1e3)] = 0.2
    gamma: Annotated[float, quantity("weight of cartilage", at_least=0.0, at_most=1e3)] = 0.5
    eta: Annotated[float, quantity("resistance of a lesion", above=0.0, at_most=1e6)] = 1.0
    cartilage_generations: Annotated[int, quantity("generations with cartilage", at_least=0, at_most=30)] = 10

    def of(self, length_mm: float, diameter_mm: float, angle_rad: float, cartilage: float) -> float:
        """Return Z = alpha L / D + beta C + gamma B of one branch [Pan2025, eq. 3]."""
        return self.alpha * length_mm / diameter_mm + self.beta * angle_rad + self.gamma * cartilage


def branch_resistances(tree: AirwayTree, weights: Resistances) -> Float:
    """Return the resistance of every branch `(B,)` of a tree, by angles of chords with the parent's."""
    first, last = tree.branch_start[:-1], tree.branch_start[1:] - 1
    hook = np.where(tree.parent_point[first] < 0, first, tree.parent_point[first])
    chord = tree.points_lps[last] - tree.points_lps[hook]
    size = np.linalg.norm(chord, axis=1)
    direction = np.where(size[:, None] > 0, chord / np.maximum(size, 1e-12)[:, None], tree.tangents[last])
    parent = np.where(tree.branch_parent < 0, 0, tree.branch_parent)
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", direction, direction[parent]), -1.0, 1.0))
    angle[0] = 0.0
    diameter = 2.0 * np.maximum(tree.branch_mean_radius_mm, 1e-3)
    cartilage = tree.generation <= weights.cartilage_generations
    z = weights.alpha * tree.branch_length_mm / diameter + weights.beta * angle + weights.gamma * cartilage
    return read_only(np.asarray(z, dtype=np.float64))


Reading = Literal["printed", "reduced"]


SAME_RESISTANCE = 1e-9
"""Relative difference up to which two resistances count as equal; sums in another order differ by less."""


@frozen_record
class Circuits:
    """The circuits of all combinations of exits; C combinations, M lesions.

    Args:
        first ((M + 1,) int64): The exits of lesion m are `first[m]` to `first[m + 1] - 1`.
        printed ((C,) float64): Resistance by the steps of section II-C and algorithm 1: resistors in as many
            loops are summed, even if they lie in different branches.
        reduced ((C,) float64): Resistance by merging layer by layer from the ends, as the last lines of
            section II-D have it: the true resistance of the tree.
    """

    first: Int
    printed: Float
    reduced: Float

    @property
    def count(self) -> int:
        """Number of combinations, C."""
        return len(self.printed)

    def distinct(self, reading: Reading = "printed") -> int:
        """Return the number of circuits with different resistances."""
        values = np.sort(self.values(reading))
        return 1 + int((np.diff(values) > SAME_RESISTANCE * values[:-1]).sum())

    def values(self, reading: Reading) -> Float:
        """Return the resistances by one of the two readings."""
        if reading not in ("printed", "reduced"):
            raise SettingsError(f"There is no reading {reading!r}", expected="printed or reduced")
        return self.printed if reading == "printed" else self.reduced

    def choice(self, reading: Reading = "printed") -> tuple[int, ...]:
        """Return the exits, one a lesion, of the circuit with the least resistance; the first of equals."""
        places = np.unravel_index(np.argmin(self.values(reading)), np.diff(self.first))
        return tuple((self.first[:-1] + places).tolist())


def combinations(subtree: Subtree) -> int:
    """Return the number of choices of one exit a lesion."""
    return math.prod(np.bincount(subtree.exit_lesion).tolist())


MOST_COMBINATIONS = 5_000_000
"""Every combination is computed and stored in two arrays: this many take seconds and 80 MB."""


def circuits(subtree: Subtree) -> Circuits:
    """Compute the resistances of all combinations of exits.

    Raises SettingsError if there are more than 5 million combinations.
    """
    sizes = np.bincount(subtree.exit_lesion, minlength=subtree.n_lesions)
    count = combinations(subtree)
    if count > MOST_COMBINATIONS:
        raise SettingsError(
            f"{subtree.n_lesions} lesions have {count} combinations of exits",
            expected=f"at most {MOST_COMBINATIONS} for the method of least resistance",
            remedy="Use the exact tour alone",
        )
    first = np.concatenate(((0,), np.cumsum(sizes)))
    printed, reduced = np.zeros(count), np.zeros(count)
    all_resistances(
        subtree.parent, subtree.resistance, subtree.side, subtree.exit_vertex, subtree.exit_resistance,
        first, printed, reduced,
    )  # fmt: skip
    return Circuits(first=read_only(first), printed=read_only(printed), reduced=read_only(reduced))

"""The exits of a lesion: the target positions P1, P2 and P3 of [Pan2025], with eqs. 1 and 2."""

from collections.abc import Callable
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import TargetError
from anatomy.base.records import frozen_value
from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float, Int

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
    """Return up to three exits for each lesion: the target positions P1, P2 and P3 of [Pan2025].

    P1 has the smallest angle, P2 the smallest distance, P3 the smallest weighted sum of both; the paper
    says largest, which would be the worst point.  Where two are the same point, it is listed once.  A lesion
    whose centre lies in the lumen has one exit, the nearest point.

    Args:
        lesions_lps: (M, 3) float64, LPS mm.
        accepts: Tree points that it refuses are no candidates.

    Raises:
        TargetError: If a lesion has no candidate within reach.
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
    if inside:
        points = np.array([nearest])
    else:
        # The sphere that first reaches a point; points met in the same step are equally far.
        grown = np.ceil(distance / rule.step_mm) * rule.step_mm
        points = np.flatnonzero(grown <= rule.reach_mm)
    if accepts is not None:
        points = np.array([point for point in points.tolist() if accepts(number, point)], dtype=np.int64)
    if not len(points):
        raise TargetError(
            f"The lesion at LPS ({', '.join(f'{x:.1f}' for x in lesion)}) has no exit: "
            + (
                f"the nearest point of the airway is {distance[nearest]:.1f} mm away"
                if distance[nearest] > rule.reach_mm
                else "no point of the airway within reach is accepted"
            ),
            expected=f"a point of the airway within {rule.reach_mm:g} mm"
            + ("" if accepts is None else " that is accepted"),
            remedy="Leave the lesion out, or allow a longer reach",
        )
    line = offset[points] / np.maximum(distance[points], 1e-12)[:, None]
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", line, tree.tangents[points]), -1.0, 1.0))
    if inside:
        return (_exit(number, points, distance, angle, np.zeros(1), 0, ("inside",)),)
    weight = rule.angle_weight
    weighted = (1.0 - weight) * distance[points] / rule.reach_mm + weight * angle / np.pi
    depth = tree.distance_from_root_mm[points]
    best = {
        "P1": int(np.lexsort((depth, angle))[0]),
        "P2": int(np.lexsort((depth, grown[points]))[0]),
        "P3": int(np.lexsort((depth, weighted))[0]),
    }
    roles: dict[int, tuple[str, ...]] = {}
    for role, at in best.items():
        roles[at] = (*roles.get(at, ()), role)
    return tuple(_exit(number, points, distance, angle, weighted, at, names) for at, names in roles.items())


def _exit(
    lesion: int, points: Int, distance: Float, angle: Float, weighted: Float, at: int, roles: tuple[str, ...]
) -> Exit:
    return Exit(
        lesion=lesion,
        tree_point=int(points[at]),
        roles=roles,
        distance_mm=float(distance[points[at]]),
        angle_rad=float(angle[at]),
        weighted=float(weighted[at]),
    )

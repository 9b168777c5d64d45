"""NF1 and the clearance-based NF1 (eq. 2): navigation functions on the lumen [Rosell2012, sec. V-A].

Eq. 2 revisits a voxel whenever a neighbour offers a lower potential: that is the shortest-path problem whose
edges cost what entering a voxel costs, and it is solved as such.  All edges cost more than 0, so a voxel
without a lower neighbour can only be the goal.
"""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import TargetError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float
from anatomy.grid import read_only
from stages.scope.advisor.kernels.voxel_graph import shortest_paths
from stages.scope.advisor.lumen import Lumen

Metric = Literal["mm", "voxels"]
Kind = Literal["clearance", "plain"]

THRESHOLD = 0.9


@frozen_record
class Goal:
    """The voxel where the tip has to end, by its number, its centre and that of the lesion, `(3,)` LPS mm.

    `distance_mm` is that between the two centres; if the voxel is not in the lesion, it is the lumen voxel
    nearest to it.
    """

    voxel: int
    centre_lps: Float
    lesion_lps: Float
    lesion_radius_mm: float
    distance_mm: float
    in_lesion: bool


def goal_at(
    lumen: Lumen, lesion_lps: ArrayLike, lesion_radius_mm: float = 0.0, *, preferred: Bool | None = None
) -> Goal:
    """Return the goal for a lesion, a sphere about a point `(3,)` LPS mm: the nearest interior voxel.

    It is chosen as in [Rosell2012, IV-B], but voxels of the lesion that are `preferred` `(N,)`, such as those
    where a scope fits, come before all others.

    Raises:
        TargetError: If centre or radius are not finite, or the radius is negative.
    """
    lesion = np.array(lesion_lps, dtype=np.float64)
    if lesion.shape != (3,) or not np.isfinite(lesion).all() or not 0.0 <= lesion_radius_mm < np.inf:
        raise TargetError(
            f"A lesion at {lesion.tolist()} with a radius of {lesion_radius_mm} mm is no sphere",
            expected="three finite mm and a finite radius, 0 or above",
            remedy="Correct the target or the radius",
        )
    voxel, distance = lumen.nearest_voxel(lesion)
    if preferred is not None and preferred.any():
        numbers = np.flatnonzero(preferred)
        away = np.linalg.norm(lumen.centres(numbers) - lesion, axis=1)
        if away.min() <= lesion_radius_mm:
            voxel, distance = int(numbers[np.argmin(away)]), float(away.min())
    return Goal(
        voxel=voxel,
        centre_lps=read_only(lumen.centres(voxel)),
        lesion_lps=read_only(lesion),
        lesion_radius_mm=float(lesion_radius_mm),
        distance_mm=distance,
        in_lesion=distance <= lesion_radius_mm,
    )


@frozen_record
class NavigationField:
    """Potential of every interior voxel, 0 at the goal and without any other local minimum.

    Args:
        goal: Number of the goal voxel.
        kind: "clearance": NF1 lowered where there is clearance (eq. 2); "plain": NF1.
        clearance ((N,) float64): L1 distance to the wall.
        largest_clearance: C_max of eq. 2: half the largest clearance in the lumen.
        potential: (N,) float64.
    """

    lumen: Lumen
    goal: int
    kind: Kind
    clearance: Float
    largest_clearance: float
    potential: Float

    def route(self, voxel: int) -> Float:
        """Return the centres `(M, 3)` LPS mm of the steepest descent from a voxel to the goal."""
        route = [int(voxel)]
        while route[-1] != self.goal:
            others = self.lumen.neighbours[route[-1]]
            others = others[others >= 0]
            route.append(int(others[np.argmin(self.potential[others])]))
        return self.lumen.centres(route)


def navigation_field(
    lumen: Lumen, goal: int, *, kind: Kind = "clearance", metric: Metric = "mm"
) -> NavigationField:
    """Compute NF1, or the clearance-based NF1 [Rosell2012, eq. 2], from the number of the goal's voxel.

    A step counts its length ("mm", right for any voxel size) or 1 ("voxels", the paper's).
    """
    if not 0 <= goal < lumen.count:
        raise TargetError(
            f"The lumen has no interior voxel {goal}", expected=f"a number from 0 to {lumen.count - 1}"
        )
    steps = np.ones(3) if metric == "voxels" else np.array(lumen.grid.spacing_mm)
    clearance = lumen.clearance(steps)
    most = 0.5 * float(clearance.max())
    weights = entering_costs(clearance, most) if kind == "clearance" else np.ones(lumen.count)
    potential = np.zeros(lumen.count)
    extremes = np.array([steps.min() * weights.min(), steps.max() * weights.max()])
    shortest_paths(lumen.neighbours, steps, weights, extremes, goal, potential)
    return NavigationField(
        lumen=lumen,
        goal=int(goal),
        kind=kind,
        clearance=clearance,
        largest_clearance=most,
        potential=read_only(potential),
    )


def entering_costs(clearance: Float, largest_clearance: float) -> Float:
    """Return what entering each voxel costs by eq. 2, `(N,)`, for a step that counts 1."""
    share = clearance / largest_clearance
    # Eq. 2: from this share of C_max on, entering a voxel costs the least.
    return np.where(share < THRESHOLD, 1.0 - share, 0.1)

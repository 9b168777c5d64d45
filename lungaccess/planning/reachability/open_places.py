"""Where a proof of unreachability is open: stretches of airway from which deployments were not ruled out."""

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.planning.coupled.kernels.box_of_tubes import HALF, INNER, OUTER
from lungaccess.planning.reachability.deployment_space import DeploymentSpace
from lungaccess.planning.reachability.kernels.deployment_boxes import PLACE_X
from lungaccess.planning.reachability.kernels.unreachable import RULED_OUT, TOO_MANY, Found

TOGETHER_MM = 12.0
"""Open pieces of a branch that begin so near to each other are one place: a piece has 8 mm."""


@frozen_record
class OpenPlace:
    """A stretch of an airway branch from which deployments could not be ruled out.

    Args:
        branch, generation: See `anatomy.airway_tree.AirwayTree`.
        name: The number of the branch, with its lobe if that is known.
        points_lps ((N, 3) float64): Its tree points, LPS mm.
        tip_lps ((3,) float64): Place of the scope tip, LPS mm, in the middle of a part that was left.
        insertions_mm: Of the outer and the inner tube there.
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


def open_places(lung: Lung, space: DeploymentSpace, found: Found) -> tuple[OpenPlace, ...]:
    """Merge what is open into places, the largest share of the deployment space first."""
    tree = lung.tree
    rows = np.flatnonzero(found.outcome != RULED_OUT)
    open_measure = space.measures[rows] * (1.0 - found.share[rows])
    total = float(space.measures.sum())
    groups: list[tuple[int, list[int]]] = []
    for piece in np.unique(space.owners[rows]):
        first = tree.nearest_point_index.query(space.pieces[piece].cones[0, :3])[1]
        branch = int(tree.branch_of_point[first])
        if groups and groups[-1][0] == branch and _near(space, groups[-1][1][-1], int(piece)):
            groups[-1][1].append(int(piece))
        else:
            groups.append((branch, [int(piece)]))
    places = []
    for branch, pieces in groups:
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


def _near(space: DeploymentSpace, one: int, other: int) -> bool:
    away = space.pieces[one].cones[0, :3] - space.pieces[other].cones[0, :3]
    return float(np.linalg.norm(away)) <= TOGETHER_MM

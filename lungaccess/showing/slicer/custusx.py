"""The route as CustusX and Fraxinus write it: `x y z flag`, from the target back to the trachea."""

from __future__ import annotations

import numpy as np

from anatomy.airway_tree import AirwayTree
from lungaccess.plans.curves import DeviceCurve, DeviceCurves
from lungaccess.plans.plan import Plan

ROUTE, BRANCHING, BEYOND = 0, 1, 2
_HEADING = (
    "# [xPos yPos zPos BranchingPoint (0=Normal, 1=Branching position, 2=Extended from airway to target)] "
    "Number of positions: {count}"
)


def route_text(plan: Plan, curves: DeviceCurves, tree: AirwayTree) -> str:
    """Return the route of a plan through an airway tree as text, LPS mm, one point a line.

    Flags are 0 along the airway, 1 where one branch ends and the next begins, 2 for tubes and needle.
    """
    scope, tubes, needle = curves
    inside = _with_flags(scope, plan, tree)
    beyond = [(point, BEYOND) for curve in (tubes, needle) for point in curve.points_lps[1:].tolist()]
    rows = [*inside, *beyond][::-1]
    lines = [_HEADING.format(count=len(rows))]
    lines += [f"{x:.4f} {y:.4f} {z:.4f} {flag}" for (x, y, z), flag in rows]
    return "\n".join([*lines, ""])


def _with_flags(scope: DeviceCurve, plan: Plan, tree: AirwayTree) -> list[tuple[list[float], int]]:
    """Return the points of the scope, flagged where another branch of its way is nearer than before."""
    way = np.flatnonzero(np.isin(tree.branch_of_point, plan.scope.branches))
    away = np.linalg.norm(scope.points_lps[:, None] - tree.points_lps[way], axis=2)
    branch = tree.branch_of_point[way[away.argmin(axis=1)]]
    flags = np.where(np.append(np.diff(branch) != 0, False), BRANCHING, ROUTE)
    return list(zip(scope.points_lps.tolist(), flags.tolist(), strict=True))

"""The route as CustusX and Fraxinus write it: `x y z flag`, from the target back to the trachea."""

from __future__ import annotations

import numpy as np

from lungaccess.plans.curves import DeviceCurve, DeviceCurves
from lungaccess.plans.plan import Plan

ROUTE, BRANCHING, BEYOND = 0, 1, 2
_HEADING = (
    "# [xPos yPos zPos BranchingPoint (0=Normal, 1=Branching position, 2=Extended from airway to target)] "
    "Number of positions: {count}"
)


def route_text(plan: Plan, curves: DeviceCurves) -> str:
    """Return the route of a plan as text, LPS mm, one point a line.

    Flags are 0 along the airway, 1 where one branch ends and the next begins, 2 for tubes and needle.
    """
    scope, tubes, needle = curves
    inside = _with_flags(plan, scope)
    beyond = [(point, BEYOND) for curve in (tubes, needle) for point in curve.points_lps[1:].tolist()]
    rows = [*inside, *beyond][::-1]
    lines = [_HEADING.format(count=len(rows))]
    lines += [f"{x:.4f} {y:.4f} {z:.4f} {flag}" for (x, y, z), flag in rows]
    return "\n".join([*lines, ""])


def _with_flags(plan: Plan, scope: DeviceCurve) -> list[tuple[list[float], int]]:
    points, branches = np.asarray(plan.scope.points_lps), np.asarray(plan.scope.branches)
    ends = points[np.flatnonzero(np.diff(branches) != 0)]
    return [
        (point.tolist(), BRANCHING if len(ends) and (ends == point).all(axis=1).any() else ROUTE)
        for point in scope.points_lps
    ]

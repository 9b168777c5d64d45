"""Plan all stages anew through another place of the airway wall: a stated exit of the tubes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses
from anatomy.errors import SettingsError, TargetError
from anatomy.lung import Lung
from anatomy.typed import Float, Int
from lungaccess.coupled import Atlas, build_atlas, plan
from lungaccess.coupled.atlas import require_same
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from stages.needle import StartIndex
from stages.tube import centreline, points_on_arcs, shapes_of

WITHIN_MM = 5.0
"""A point placed by hand is meant to a few millimetres, about the spacing of exits in the atlas."""


def plan_near_exit(
    lung: Lung,
    system: System,
    target: Target,
    exit_lps: ArrayLike,
    *,
    within_mm: float = WITHIN_MM,
    atlas: Atlas | None = None,
    **options: Any,
) -> Iterator[Plan]:
    """Plan all stages with tubes that leave the airway near a point; yield better and better plans.

    The search starts from the deployments of the atlas that leave the lumen there.  Plans whose exit the
    search has moved farther away are left out.

    Parameters
    ----------
    exit_lps : (3,) array_like, LPS mm
    within_mm : float
        How far from it the tubes may leave the lumen.
    atlas : Atlas, optional
        Made here if None.
    **options
        Those of `lungaccess.plan`.

    Raises
    ------
    NoPlan
        If no plan leaves the airway there.
    TargetError
        If no deployment of the tubes leaves the airway there: says how far the nearest one is.
    SettingsError
        If the distance is not above 0, the system has no needle, or as `lungaccess.plan`.
    """
    system.require_needle("A stated exit")
    if not 0.0 < within_mm < np.inf:
        raise SettingsError(f"The exit may be {within_mm} mm away", expected="a distance above 0")
    wanted = np.asarray(exit_lps, dtype=np.float64)
    made = build_atlas(lung, system) if atlas is None else atlas
    require_same(made, lung, system)
    found = False
    for each in plan(lung, system, target, atlas=_through(made, wanted, within_mm), **options):
        if np.linalg.norm(each.tube.exit.point_lps - wanted) <= within_mm:
            found = True
            yield each
    if not found:
        raise NoPlan(
            f"No plan was found that leaves the airway within {within_mm:g} mm of the stated exit",
            reasons={"exit: every plan found leaves the airway elsewhere": 1},
            advice="Allow a larger distance, or move the exit",
        )


def _through(atlas: Atlas, exit_lps: Float, within_mm: float) -> Atlas:
    """Return an atlas of the deployments alone that leave the lumen near a point."""
    away = np.linalg.norm(atlas.motions.tips[atlas.deployments.site, :3] - exit_lps, axis=1)
    # A tube is no shorter than the straight line to its exit, so the others cannot come near.
    near = np.flatnonzero(away <= atlas.deployments.exit_mm + within_mm)
    distances = np.linalg.norm(exit_points(atlas, near) - exit_lps, axis=1)
    chosen = near[distances <= within_mm]
    if not len(chosen):
        nearest = f"the nearest leaves it {distances.min():.1f} mm away" if len(near) else "none comes near"
        raise TargetError(
            f"No deployment of {atlas.system.name} leaves the airway within {within_mm:g} mm of the exit: "
            f"{nearest}",
            expected="a point of an airway wall that the tubes can pierce",
            remedy="Move the exit along the airway, or allow a larger distance",
        )
    few = atlas.deployments.only(chosen)
    return replace(atlas, deployments=few, index=StartIndex(few.positions, few.tangents))


def exit_points(atlas: Atlas, entries: Int) -> Float:
    """Return where deployments, by their numbers `(N,)`, leave the lumen for good, `(N, 3)` LPS mm."""
    tubes, every = atlas.system.tubes, atlas.deployments
    points = np.zeros((len(entries), 3))
    for n, entry in enumerate(entries.tolist()):
        turned, outer, inner, shape = every.choice(entry)
        tip = atlas.motions.tips[every.site[entry]]
        frame, at_mm = poses.pose(tip[:3], tip[3:6], tip[6:9]), [float(every.exit_mm[entry])]
        if shape < 0:
            points[n] = centreline(tubes, frame, turned, outer, inner, at_mm)[0]
        else:
            points[n] = points_on_arcs(shapes_of(tubes).member(shape).arcs, frame, turned, at_mm)[0]
    return points

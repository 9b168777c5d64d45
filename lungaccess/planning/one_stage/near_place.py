"""Plan all stages anew through a stated place: an exit of the tubes, or a place of the scope's tip."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError, TargetError
from anatomy.base.typed import Float, Int
from anatomy.lung import Lung
from lungaccess.planning.coupled import Atlas, atlas_part, build_atlas, plan
from lungaccess.planning.coupled.atlas import require_same
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from stages.tube import exit_points

WITHIN_MM = 5.0
"""A point placed by hand is meant to a few millimetres, about the spacing of exits in the atlas."""
TIP_WITHIN_MM = 1.5
"""Tips of the atlas are 1 mm apart along the airway: within this distance they are one place of the scope."""


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
    made = _atlas(lung, system, atlas, "A stated exit", within_mm)
    wanted = np.asarray(exit_lps, dtype=np.float64)
    plans = plan(lung, system, target, atlas=_through(made, wanted, within_mm), **options)
    return _near(plans, wanted, within_mm, lambda each: each.tube.exit.point_lps, "leaves the airway", "exit")


def plan_near_scope_tip(
    lung: Lung,
    system: System,
    target: Target,
    tip_lps: ArrayLike,
    *,
    within_mm: float = TIP_WITHIN_MM,
    atlas: Atlas | None = None,
    **options: Any,
) -> Iterator[Plan]:
    """Plan all stages with the tip of the scope near a point; yield better and better plans.

    The search starts from the deployments of the atlas whose scope tip is there.  Plans whose tip the search
    has moved farther away are left out.

    Parameters
    ----------
    tip_lps : (3,) array_like, LPS mm
    within_mm : float
        How far from it the tip may be.
    atlas : Atlas, optional
        Made here if None.
    **options
        Those of `lungaccess.plan`.

    Raises
    ------
    NoPlan
        If no plan has its tip there.
    TargetError
        If no tip of the atlas is there: says how far the nearest one is.
    SettingsError
        As `plan_near_exit`.
    """
    made = _atlas(lung, system, atlas, "A stated place of the scope's tip", within_mm)
    wanted = np.asarray(tip_lps, dtype=np.float64)
    tips = tips_near(made, wanted, within_mm)
    if not len(tips):
        distances = np.linalg.norm(made.motions.tips[:, :3] - wanted, axis=1)
        nearest = f"the nearest is {distances.min():.1f} mm away" if len(distances) else "there is none"
        raise TargetError(
            f"No tip of the scope of {system.name} is within {within_mm:g} mm of the stated place: {nearest}",
            expected="a point of the airway that the scope reaches",
            remedy="Move it along the airway, or allow a larger distance",
        )
    part = atlas_part(made, np.flatnonzero(np.isin(made.deployments.site, tips)))
    plans = plan(lung, system, target, atlas=part, **options)
    return _near(
        plans, wanted, within_mm, lambda each: each.scope.lps_from_scope_tip[:3, 3], "has its scope tip",
        "scope tip",
    )  # fmt: skip


def tips_near(atlas: Atlas, tip_lps: ArrayLike, within_mm: float = TIP_WITHIN_MM) -> Int:
    """Return the scope tips of an atlas near a point, by their numbers `(N,)`: one place, all directions."""
    away = np.linalg.norm(atlas.motions.tips[:, :3] - np.asarray(tip_lps), axis=1)
    return np.flatnonzero(away <= within_mm)


def _atlas(lung: Lung, system: System, atlas: Atlas | None, what: str, within_mm: float) -> Atlas:
    """Return the atlas, after what is asked has been looked at."""
    system.require_needle(what)
    if not 0.0 < within_mm < np.inf:
        raise SettingsError(f"{what} may be {within_mm} mm away", expected="a distance above 0")
    made = build_atlas(lung, system) if atlas is None else atlas
    require_same(made, lung, system)
    return made


def _near(
    plans: Iterator[Plan],
    wanted: Float,
    within_mm: float,
    place_of: Callable[[Plan], ArrayLike],
    does: str,
    what: str,
) -> Iterator[Plan]:
    """Yield the plans of which a place is near a point.

    Raises
    ------
    NoPlan
        If there is none.
    """
    found = False
    for each in plans:
        if np.linalg.norm(np.asarray(place_of(each)) - wanted) <= within_mm:
            found = True
            yield each
    if not found:
        raise NoPlan(
            f"No plan was found that {does} within {within_mm:g} mm of the stated {what}",
            reasons={f"{what}: every plan found {does} elsewhere": 1},
            advice=f"Allow a larger distance, or move the {what}",
        )


def _through(atlas: Atlas, exit_lps: Float, within_mm: float) -> Atlas:
    """Return an atlas of the deployments alone that leave the lumen near a point."""
    away = np.linalg.norm(atlas.motions.tips[atlas.deployments.site, :3] - exit_lps, axis=1)
    # A tube is no shorter than the straight line to its exit, so the others cannot come near.
    near = np.flatnonzero(away <= atlas.deployments.exit_mm + within_mm)
    points = exit_points(atlas.system.tubes, atlas.motions.tips, atlas.deployments, near)
    distances = np.linalg.norm(points - exit_lps, axis=1)
    chosen = near[distances <= within_mm]
    if not len(chosen):
        nearest = f"the nearest leaves it {distances.min():.1f} mm away" if len(near) else "none comes near"
        raise TargetError(
            f"No deployment of {atlas.system.name} leaves the airway within {within_mm:g} mm of the exit: "
            f"{nearest}",
            expected="a point of an airway wall that the tubes can pierce",
            remedy="Move the exit along the airway, or allow a larger distance",
        )
    return atlas_part(atlas, chosen)

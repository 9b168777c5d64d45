"""Constraints of a request on the plans of a search: the stated place, and the phases of the breath."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import TargetError
from anatomy.base.typed import Float, Int
from lungaccess.planning.coupled.atlas import Atlas, atlas_part
from lungaccess.plans.plan import Plan
from lungaccess.problem.request import Request, StatedPlace
from stages.tube import exit_points

TIP_WITHIN_MM = 1.5
"""How near a scope tip is to a stated one: tips of the atlas are 1 mm apart along the airway."""


def holds(request: Request, plan: Plan) -> bool:
    """Tell whether a plan keeps the stated place, and is proved in the phases that are asked for."""
    place = request.place
    if place is not None and float(np.linalg.norm(place_of(plan, place) - place.lps_mm)) > place.within_mm:
        return False
    return request.phases is None or (plan.window is not None and plan.window.holds_all(request.phases))


def place_of(plan: Plan, place: StatedPlace) -> Float:
    """Return where a plan has what is stated, `(3,)` LPS mm."""
    if place.kind == "exit":
        return np.asarray(plan.tube.exit.point_lps)
    return np.asarray(plan.scope.lps_from_scope_tip)[:3, 3]


def place_part(request: Request, atlas: Atlas) -> Atlas:
    """Return the part of an atlas whose deployments go through the stated place, all of it without one.

    Raises:
        TargetError: If there is none: says how far the nearest one is.
    """
    place = request.place
    if place is None:
        return atlas
    return _of_tips(atlas, place) if place.kind == "scope tip" else _of_exits(atlas, place)


def tips_near(atlas: Atlas, tip_lps: ArrayLike) -> Int:
    """Return the scope tips of an atlas near a point, by their numbers `(N,)`: one place, all directions."""
    away = np.linalg.norm(atlas.motions.tips[:, :3] - np.asarray(tip_lps), axis=1)
    return np.flatnonzero(away <= TIP_WITHIN_MM)


def _of_tips(atlas: Atlas, place: StatedPlace) -> Atlas:
    distances = np.linalg.norm(atlas.motions.tips[:, :3] - place.lps_mm, axis=1)
    tips = np.flatnonzero(distances <= place.within_mm)
    if not len(tips):
        nearest = f"the nearest is {distances.min():.1f} mm away" if len(distances) else "there is none"
        raise TargetError(
            f"No tip of the scope of {atlas.system.name} is within {place.within_mm:g} mm of the stated "
            f"place: {nearest}",
            expected="a point of the airway that the scope reaches",
            remedy="Move it along the airway, or allow a larger distance",
        )
    return atlas_part(atlas, np.flatnonzero(np.isin(atlas.deployments.site, tips)))


def _of_exits(atlas: Atlas, place: StatedPlace) -> Atlas:
    """Return an atlas of the deployments alone that leave the lumen near a point."""
    away = np.linalg.norm(atlas.motions.tips[atlas.deployments.site, :3] - place.lps_mm, axis=1)
    # A tube is no shorter than the straight line to its exit, so the others cannot come near.
    near = np.flatnonzero(away <= atlas.deployments.exit_mm + place.within_mm)
    points = exit_points(atlas.system.tubes, atlas.motions.tips, atlas.deployments, near)
    distances = np.linalg.norm(points - place.lps_mm, axis=1)
    chosen = near[distances <= place.within_mm]
    if not len(chosen):
        nearest = f"the nearest leaves it {distances.min():.1f} mm away" if len(near) else "none comes near"
        raise TargetError(
            f"No deployment of {atlas.system.name} leaves the airway within {place.within_mm:g} mm of the "
            f"exit: {nearest}",
            expected="a point of an airway wall that the tubes can pierce",
            remedy="Move the exit along the airway, or allow a larger distance",
        )
    return atlas_part(atlas, chosen)

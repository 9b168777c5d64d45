"""From which poses of the scope's tip tubes and needle still reach the target of a plan."""

import math
from typing import Any

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, UInt8
from anatomy.lung import Lung
from anatomy.poses import pose
from lungaccess.planning.one_stage.replan import replan_from_scope
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import Target
from stages.needle import KINDS, TriedStarts, try_around

OFFSET_MM, TILT_DEG = 3.0, 10.0
"""Published errors of a scope's tip are 1.3 to 2.1 mm an axis and 1 to 7 degrees."""
POSES, DIRECTIONS = 500, 5
"""Some seconds, and a share of one half known to 4 % or better."""
WORDS = {words: kind for kind, words in KINDS.items()}


@frozen_record
class ScopeRegion:
    """Poses of the scope's tip that were tried: whether tubes and needle reach the target from there.

    Args:
        lps_from_scope_tip ((4, 4) float64): As planned.
        tried: A start too near to an obstacle is a tip that does not fit into the airway.
    """

    lps_from_scope_tip: Float
    tried: TriedStarts

    @property
    def words(self) -> str:
        """The region in one sentence."""
        tried, share = self.tried, 100.0 * self.tried.share_of_free
        tilt = math.degrees(tried.tilt_rad)
        return (
            f"Of the tips of the scope up to {tried.offset_mm:g} mm and {tilt:g}° off "
            f"the plan that fit into the airway, {share:.0f} % still have a way to the target"
        )

    def record(self) -> dict[str, Any]:
        """Return plain JSON values."""
        tried = self.tried
        return {
            "words": self.words,
            "lps_from_scope_tip": self.lps_from_scope_tip.tolist(),
            "offset_mm": tried.offset_mm,
            "tilt_deg": math.degrees(tried.tilt_rad),
            "poses": int(tried.kinds.size),
            "share_of_those_that_fit": tried.share_of_free,
            "counts": tried.counts,
        }


def safe_scope_region(
    plan: Plan,
    lung: Lung,
    *,
    offset_mm: float = OFFSET_MM,
    tilt_deg: float = TILT_DEG,
    poses: int = POSES,
    seed: int = 0,
) -> ScopeRegion:
    """Try poses of the scope's tip around the planned one: from each, tubes and needle are planned anew.

    A tip fits into the airway if its centre is as deep in the lumen as the scope's radius, or as the planned
    tip where that is less.  What is found is proved clear, exactly to the target; what is not found proves
    nothing.  The same input and seed give the same answer.

    Args:
        offset_mm, tilt_deg: Largest distance and angle from the planned tip.
        poses: About how many are tried.

    Raises:
        PlanFileError: If the plan was made for another lung.
        SettingsError: If a number is out of its range.
    """
    plan.require_lung(lung)
    frame = np.asarray(plan.scope.lps_from_scope_tip)
    target = Target(lps_mm=plan.target_lps, origin=plan.target_origin)
    depth = lung.lumen_depth.lower_bound_mm(frame[None, :3, 3])[0]
    needed = min(plan.system.scope.radius_mm, float(depth))

    def tried(positions: Float, tangents: Float) -> UInt8:
        kinds = np.full(len(positions), WORDS["start too near to an obstacle"], dtype=np.uint8)
        for n in np.flatnonzero(lung.lumen_depth.lower_bound_mm(positions) >= needed).tolist():
            tip = pose(positions[n], tangents[n], frame[:3, 0])
            try:
                rest = replan_from_scope(lung, plan.system, tip, target, seed=seed, tries=0)
            except NoPlan:
                kinds[n] = WORDS["no path found"]
            else:
                kinds[n] = WORDS["one arc" if len(rest.path.arcs) == 1 else "two or three arcs"]
        return kinds

    found = try_around(
        frame, tried, offset_mm=offset_mm, tilt_rad=math.radians(tilt_deg), poses=poses, directions=DIRECTIONS
    )
    return ScopeRegion(lps_from_scope_tip=frame, tried=found)

"""The bronchoscope alone: its path to a lesion, and from which poses of its tip a plan can still go on."""

import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.files import write_text
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, UInt8
from anatomy.lung import Lung
from anatomy.poses import pose
from lungaccess.planning.one_stage.replan import replan_from_scope
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from stages.needle import KINDS, TriedStarts, try_around
from stages.scope import advisor

ADVICE_FILE, CAMERA_FILE = "advice.json", "camera.mrk.json"


@frozen_record
class ScopeAdvice:
    """The path of a scope to a lesion, with instructions; why it ends before the goal, "" if it does not.

    `thinner` is what thinner scopes would reach; empty if this one reaches the goal.
    """

    path: advisor.ScopePath
    instructions: tuple[advisor.Instruction, ...]
    why_stopped: str
    thinner: tuple[advisor.ThinnerScope, ...]

    def as_json(self) -> dict[str, Any]:
        """Return all a reader needs as plain values; poses are in LPS mm, +z forward."""
        path = self.path
        return {
            "frame": "LPS mm",
            "reached": path.reached,
            "why_stopped": self.why_stopped,
            "distance_to_goal_mm": path.distance_mm,
            "distance_to_lesion_mm": path.distance_to_lesion_mm,
            "lesion": {
                "centre": path.goal.lesion_lps.tolist(),
                "radius_mm": path.goal.lesion_radius_mm,
                "touches_lumen": path.goal.in_lesion,
            },
            "inserted_mm": path.length_mm,
            "lps_from_tip": path.lps_from_tip.tolist(),
            "instructions": [{**asdict(one), "text": one.text()} for one in self.instructions],
            "thinner_scopes": [asdict(one) for one in self.thinner],
            "states": [
                {"advance_mm": step, "twist_rad": twist, "bend_rad": bend}
                for step, (twist, bend) in zip(
                    path.steps_mm.tolist(), path.states[:, 12:].tolist(), strict=True
                )
            ],
        }


def advise_scope(
    lung: Lung, system: System, lesion_lps: Float, lesion_radius_mm: float, *, seed: int = 0
) -> ScopeAdvice:
    """Find a path of a system's scope from the trachea to a lesion, with its true radius clear of the wall.

    The goal is the lumen voxel nearest to the lesion's centre (LPS mm, anywhere), if possible one in the
    lesion where the scope fits.

    Raises:
        AnatomyError: If the scope fits nowhere in the trachea.
        TargetError: If the lesion is no sphere.
    """
    lumen, model = advisor.lumen_of_lung(lung), advisor.model_of(system.scope)
    start = advisor.start_state(lumen, lung.tree, model)
    width = lumen.width_from(lumen.voxel_at(start.lps_from_base[:3, 3]))
    # A goal in the lesion is chosen, if there is one, where the scope has this clearance, about half a voxel.
    fits = width >= model.radius_mm + 0.25
    guide = advisor.Advisor(
        lumen, model, advisor.goal_at(lumen, lesion_lps, lesion_radius_mm, preferred=fits)
    )
    path = guide.path(start, seed=seed)
    return ScopeAdvice(
        path=path,
        instructions=advisor.instructions_along(path, lung.tree),
        why_stopped=advisor.why_stopped(path, guide.field, lung.tree),
        thinner=() if path.reached else guide.thinner(start, seed=seed),
    )


def save_advice(advice: ScopeAdvice, folder: Path) -> None:
    """Write the advice, and the camera's flight for 3D Slicer, into a folder; FileError if it cannot be."""
    contents = {ADVICE_FILE: advice.as_json(), CAMERA_FILE: advisor.camera_flight(advice.path).markups()}
    for name, content in contents.items():
        write_text(folder / name, json.dumps(content, indent=1))


OFFSET_MM, TILT_DEG = 3.0, 10.0
"""Published errors of a scope's tip are 1.3 to 2.1 mm an axis and 1 to 7 degrees."""
POSES, DIRECTIONS = 500, 5
"""Some seconds, and a share of one half known to 4 % or better."""
WORDS = {words: kind for kind, words in KINDS.items()}


@frozen_record
class ScopeRegion:
    """Poses of the scope's tip that were tried: whether tubes and needle reach the target from there.

    A start too near to an obstacle is a tip that does not fit into the airway.
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

    About `poses` of them lie within a distance and an angle.  A tip fits into the airway if its centre is as
    deep in the lumen as the scope's radius, or as the planned tip where that is less.  What is found is
    proved clear, exactly to the target; what is not found proves nothing.  The same input and seed give the
    same answer.

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

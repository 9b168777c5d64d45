"""The bronchoscope alone: the path of a patient's scope to a lesion, with instructions."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from anatomy.base.files import write_text
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.problem.system import System
from stages.scope.advisor import (
    Advisor,
    Instruction,
    ScopePath,
    ThinnerScope,
    camera_flight,
    goal_at,
    instructions_along,
    lumen_of_lung,
    model_of,
    start_state,
    why_stopped,
)

ADVICE_FILE, CAMERA_FILE = "advice.json", "camera.mrk.json"


@frozen_record
class ScopeAdvice:
    """The path of a scope to a lesion, with instructions.

    Args:
        why_stopped: Why it ends before the goal; "" if it does not.
        thinner: What thinner scopes would reach; empty if this one reaches the goal.
    """

    path: ScopePath
    instructions: tuple[Instruction, ...]
    why_stopped: str
    thinner: tuple[ThinnerScope, ...]

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

    The goal is the lumen voxel nearest to the lesion's centre, if possible one in the lesion where the scope
    fits.

    Args:
        system: Its scope is used.
        lesion_lps ((3,) float64, LPS mm): Centre of the lesion, anywhere.

    Raises:
        AnatomyError: If the scope fits nowhere in the trachea.
        TargetError: If the lesion is no sphere.
    """
    lumen, model = lumen_of_lung(lung), model_of(system.scope)
    start = start_state(lumen, lung.tree, model)
    width = lumen.width_from(lumen.voxel_at(start.lps_from_base[:3, 3]))
    # A goal in the lesion is chosen, if there is one, where the scope has this clearance, about half a voxel.
    fits = width >= model.radius_mm + 0.25
    advisor = Advisor(lumen, model, goal_at(lumen, lesion_lps, lesion_radius_mm, preferred=fits))
    path = advisor.path(start, seed=seed)
    return ScopeAdvice(
        path=path,
        instructions=instructions_along(path, lung.tree),
        why_stopped=why_stopped(path, advisor.field, lung.tree),
        thinner=() if path.reached else advisor.thinner(start, seed=seed),
    )


def save_advice(advice: ScopeAdvice, folder: Path) -> None:
    """Write the advice, and the camera's flight as a curve for 3D Slicer, into a folder.

    Raises:
        FileError: If the folder is missing or not writable.
    """
    contents = {ADVICE_FILE: advice.as_json(), CAMERA_FILE: camera_flight(advice.path).markups()}
    for name, content in contents.items():
        write_text(folder / name, json.dumps(content, indent=1))

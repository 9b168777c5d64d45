"""A path as the camera at the tip sees it: poses as densely as a film or 3D Slicer needs them."""

import math
from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from stages.scope.advisor.kinematics import tip_frames
from stages.scope.advisor.path import ScopePath

MARKUPS_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)


@frozen_record
class FlyThrough:
    """Camera poses along a path; F poses.

    Parameters
    ----------
    lps_from_camera : (F, 4, 4) float64
        The camera looks along +z.
    inserted_mm : (F,) float64
        How far the scope is advanced at each pose.
    """

    lps_from_camera: Float
    inserted_mm: Float

    def markups(self) -> dict[str, Any]:
        """Return a curve for 3D Slicer, the content of a ``.mrk.json`` file, with the pose at every point."""
        points = [
            {
                "id": f"{number}",
                "label": f"{inserted:.1f} mm",
                "position": frame[:3, 3].tolist(),
                "orientation": frame[:3, :3].ravel().tolist(),
                "positionStatus": "defined",
            }
            for number, (frame, inserted) in enumerate(
                zip(self.lps_from_camera, self.inserted_mm, strict=True), start=1
            )
        ]
        curve = {"type": "Curve", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points}
        return {"@schema": MARKUPS_SCHEMA, "markups": [curve]}


def camera_flight(
    path: ScopePath, *, spacing_mm: float = 0.25, turn_rad: float = math.radians(2.0)
) -> FlyThrough:
    """Return the camera's poses along a path, up to the state nearest to the goal.

    Between two states base, twist and bend move evenly; there are so many poses that the camera neither
    moves nor turns farther than stated from one to the next.

    Raises
    ------
    SettingsError
        If a limit is not above 0.
    """
    if not (spacing_mm > 0.0 and turn_rad > 0.0):
        raise SettingsError(
            f"Poses every {spacing_mm:g} mm and {turn_rad:g} rad cannot be had", expected="limits above 0"
        )
    states, inserted = [path.states[0]], [0.0]
    done = 0.0
    for number in range(1, path.nearest + 1):
        pieces = _pieces(path, number, spacing_mm, turn_rad)
        step = float(path.steps_mm[number])
        for n in range(1, pieces):
            states.append(path.between(number, n / pieces))
            inserted.append(done + step * n / pieces)
        done += step
        states.append(path.states[number])
        inserted.append(done)
    frames = tip_frames(path.model, np.array(states))
    return FlyThrough(lps_from_camera=read_only(frames), inserted_mm=read_only(np.array(inserted)))


def _pieces(path: ScopePath, number: int, spacing_mm: float, turn_rad: float) -> int:
    """Return into how many pieces the motion to a state is cut; the tip moves at most as far as its parts."""
    before, after = path.states[number - 1], path.states[number]
    step = float(path.steps_mm[number])
    twist, bend = abs(float(after[12] - before[12])), abs(float(after[13] - before[13]))
    tightest = 2.0 * math.tan(0.5 * abs(float(after[13])) / path.model.links) / path.model.link_mm
    turned = tightest * step
    reach = path.model.length_mm + path.model.link_mm
    moved = step + reach * (turned + twist + bend)
    return max(1, math.ceil(moved / spacing_mm), math.ceil((turned + twist + bend) / turn_rad))

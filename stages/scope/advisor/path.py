"""The path of a scope: its states one sub-step apart, and where its body lies."""

import math
from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import freeze_arrays, read_only
from stages.scope.advisor import kinematics
from stages.scope.advisor.kinematics import ScopeModel, ScopeState, tip_frames
from stages.scope.advisor.nf1 import Goal

MARKUPS_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)


@frozen_record
class ScopePath:
    """A path of Algorithm 2 [Rosell2012]; M states.

    Args:
        states ((M, 14) float64): See `ScopeState.of_array`.
        steps_mm ((M,) float64): Advance of the base from the state before, 0 at the first.
        costs ((M,) float64): Eq. 9 of the motion that led to the state, 0 at the first.
        potentials ((M,) float64): Of the navigation field at the tip.
        reached: Whether the tip ends in the goal voxel.
        nearest: The first state of least potential: the last one, except in reproduction.
        retreats: How often the scope was pulled back and tried again.
        reproduction: Whether eq. 1 decided about collisions: then the path must not feed a plan.
    """

    model: ScopeModel
    goal: Goal
    states: Float
    steps_mm: Float
    costs: Float
    potentials: Float
    reached: bool
    nearest: int
    retreats: int
    reproduction: bool

    def __post_init__(self) -> None:
        freeze_arrays(self, "states", "steps_mm", "costs", "potentials", dtype=np.float64)

    @property
    def count(self) -> int:
        """Number of states, M."""
        return len(self.states)

    @property
    def length_mm(self) -> float:
        """How far the scope is advanced."""
        return float(self.steps_mm.sum())

    @property
    def lps_from_tip(self) -> Float:
        """The pose to hand over to the tubes: the tip nearest to the goal, looking along +z, `(4, 4)`."""
        frame: Float = read_only(kinematics.tip_frames(self.model, self.states[self.nearest])[0])
        return frame

    @property
    def distance_mm(self) -> float:
        """From the nearest tip to the centre of the goal voxel."""
        return float(np.linalg.norm(self.lps_from_tip[:3, 3] - self.goal.centre_lps))

    @property
    def distance_to_lesion_mm(self) -> float:
        """From the nearest tip to the surface of the lesion, 0 inside."""
        away = float(np.linalg.norm(self.lps_from_tip[:3, 3] - self.goal.lesion_lps))
        return max(away - self.goal.lesion_radius_mm, 0.0)

    def state(self, number: int) -> ScopeState:
        """Return a state by its number."""
        return ScopeState.of_array(self.states[number])

    def tips(self) -> Float:
        """Return the tip poses `lps_from_tip` of all states, `(M, 4, 4)`."""
        return kinematics.tip_frames(self.model, self.states)

    def between(self, number: int, fraction: float) -> Float:
        """Return the state (14,) at a fraction of the motion from state `number - 1` to state `number`.

        The base moves along its arc while twist and bend change evenly.
        """
        before, after = self.states[number - 1], self.states[number]
        advance_mm = fraction * float(self.steps_mm[number])
        moved = kinematics.advanced(
            self.model, ScopeState.of_array(before), advance_mm, float(after[12]), float(after[13])
        ).array
        moved[12:] = before[12:] + fraction * (after[12:] - before[12:])
        return moved

    def body(self, number: int, spacing_mm: float = 0.25) -> Float:
        """Return points `(B, 3)` LPS mm along the body in a state, from the first base to the tip.

        Behind the base the body lies where the base has been.
        """
        shaft = [self.states[0, 9:12]]
        for k in range(1, number + 1):
            pieces = max(1, math.ceil(float(self.steps_mm[k]) / spacing_mm))
            shaft += [self.between(k, n / pieces)[9:12] for n in range(1, pieces + 1)]
        chain = kinematics.joints(self.model, self.states[number])[0]
        pieces = max(1, math.ceil(self.model.link_mm / spacing_mm))
        share = (np.arange(pieces)[:, None] + 1.0) / pieces
        links = [a + share * (b - a) for a, b in zip(chain[:-1], chain[1:], strict=True)]
        return np.concatenate([np.array(shaft), *links])


@frozen_record
class FlyThrough:
    """Camera poses along a path; F poses.

    Args:
        lps_from_camera ((F, 4, 4) float64): The camera looks along +z.
        inserted_mm ((F,) float64): How far the scope is advanced at each pose.
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

    Raises:
        SettingsError: If a limit is not above 0.
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

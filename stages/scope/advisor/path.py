"""The path of a scope: its states one sub-step apart, where its body lies, and instructions for a person."""

import math
from itertools import pairwise
from typing import Any

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record, frozen_value
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
        """Return the state (14,) at a share of the motion to state `number`: on an arc, at an even turn."""
        before, after = self.states[number - 1], self.states[number]
        advance_mm = fraction * float(self.steps_mm[number])
        moved = kinematics.advanced(
            self.model, ScopeState.of_array(before), advance_mm, float(after[12]), float(after[13])
        ).array
        moved[12:] = before[12:] + fraction * (after[12:] - before[12:])
        return moved

    def body(self, number: int, spacing_mm: float = 0.25) -> Float:
        """Return points `(B, 3)` LPS mm along the body in a state, where the base has been, to the tip."""
        shaft = [self.states[0, 9:12]]
        for k in range(1, number + 1):
            pieces = max(1, math.ceil(float(self.steps_mm[k]) / spacing_mm))
            shaft += [self.between(k, n / pieces)[9:12] for n in range(1, pieces + 1)]
        chain = kinematics.joints(self.model, self.states[number])[0]
        pieces = max(1, math.ceil(self.model.link_mm / spacing_mm))
        share = (np.arange(pieces)[:, None] + 1.0) / pieces
        links = [a + share * (b - a) for a, b in pairwise(chain)]
        return np.concatenate([np.array(shaft), *links])


@frozen_record
class FlyThrough:
    """Camera poses `(F, 4, 4)` along a path, looking along +z, and how far the scope is advanced `(F,)`."""

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
    moves nor turns farther than stated from one to the next.  Raises SettingsError if a limit is not above 0.
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
    curvature = 2.0 * math.tan(0.5 * abs(float(after[13])) / path.model.links) / path.model.link_mm
    turned = curvature * step + twist + bend
    moved = step + (path.model.length_mm + path.model.link_mm) * turned
    return max(1, math.ceil(moved / spacing_mm), math.ceil(turned / turn_rad))


DIRECTIONS = (
    ("to the patient's left", (1.0, 0.0, 0.0)),
    ("to the patient's right", (-1.0, 0.0, 0.0)),
    ("backwards", (0.0, 1.0, 0.0)),
    ("forwards", (0.0, -1.0, 0.0)),
    ("upwards", (0.0, 0.0, 1.0)),
    ("downwards", (0.0, 0.0, -1.0)),
)
"""Words for the LPS axes, for an upright patient."""
LOOK_MM = 10.0
"""The direction of a branch is that of its first millimetres; forks nearer to each other count as one."""


@frozen_value
class Instruction:
    """One stretch of a path: into a branch and along it.

    Args:
        branch: Of the airway tree.
        generation: 0 is the trachea.
        from_carina_mm: Where the branch begins, along the tree; negative above the carina.
        heading: Side of the patient on which the branch lies, beside what else goes on there; "" for the
            first one.
        rotate_deg: Change of the twist since the last instruction.
        twist_deg, bend_deg: Twist and bend as the tip enters the branch.
        largest_bend_deg: Bend of largest size while the tip is in the branch.
        advance_mm: Advance while the tip is in the branch.
        tip_from_carina_mm: How far along the tree the tip then is.
    """

    branch: int
    generation: int
    from_carina_mm: float
    heading: str
    rotate_deg: float
    twist_deg: float
    bend_deg: float
    largest_bend_deg: float
    advance_mm: float
    tip_from_carina_mm: float

    def text(self) -> str:
        """Return the instruction as a sentence."""
        if not self.heading:
            return (
                f"Generation {self.generation}: advance {self.advance_mm:.0f} mm, "
                f"to {_place(self.tip_from_carina_mm)}."
            )
        turn = (
            f"rotate {self.rotate_deg:+.0f}° to {self.twist_deg:.0f}°"
            if round(self.rotate_deg)
            else "keep the twist"
        )
        bend = f"bend to {self.bend_deg:.0f}°" if round(self.bend_deg) else "hold the tip straight"
        if abs(self.largest_bend_deg - self.bend_deg) >= 10.0:
            bend += f" (up to {self.largest_bend_deg:.0f}°)"
        return (
            f"At {_place(self.from_carina_mm)} into generation {self.generation}, {self.heading}: "
            f"{turn}, {bend}, advance {self.advance_mm:.0f} mm."
        )


def _place(from_carina_mm: float) -> str:
    if round(from_carina_mm) == 0:
        return "the carina"
    return f"{abs(from_carina_mm):.0f} mm {'beyond' if from_carina_mm > 0.0 else 'above'} the carina"


def instructions_along(path: ScopePath, tree: AirwayTree) -> tuple[Instruction, ...]:
    """Return what to do branch by branch, by the tree point nearest to the tip, to the nearest state."""
    tips = path.tips()[: path.nearest + 1, :3, 3]
    # For each tip the nearest tree point on the route to the last one, never going back.
    route = tree.route(tree.nearest_point(tips[-1]))
    away = np.linalg.norm(tips[:, None] - tree.points_lps[route][None], axis=2)
    place = np.asarray(route[np.maximum.accumulate(np.argmin(away, axis=1))])
    branch = tree.branch_of_point[place]
    starts = [0, *(np.flatnonzero(np.diff(branch)) + 1).tolist(), len(branch)]
    carina = float(tree.distance_from_root_mm[tree.carina_point])
    instructions: list[Instruction] = []
    twist_before = math.degrees(path.states[0, 12])
    for begin, end in pairwise(starts):
        here = int(branch[begin])
        twist, bend = np.degrees(path.states[begin, 12:14]).tolist()
        bends = np.degrees(path.states[begin:end, 13])
        instructions.append(
            Instruction(
                branch=here,
                generation=int(tree.generation[here]),
                from_carina_mm=float(tree.distance_from_root_mm[_first_point(tree, here)]) - carina,
                heading=_heading(tree, here) if begin else "",
                rotate_deg=twist - twist_before,
                twist_deg=twist,
                bend_deg=bend,
                largest_bend_deg=float(bends[np.argmax(np.abs(bends))]),
                advance_mm=float(path.steps_mm[max(begin, 1) : end].sum()),
                tip_from_carina_mm=float(tree.distance_from_root_mm[place[end - 1]]) - carina,
            )
        )
        twist_before = twist
    return tuple(instructions)


def _first_point(tree: AirwayTree, branch: int) -> int:
    """Return the point on which a branch hangs, the root for the trachea."""
    return max(int(tree.parent_point[tree.branch_start[branch]]), 0)


def _heading(tree: AirwayTree, branch: int) -> str:
    """Say on which of the patient's sides a branch lies, compared with what else goes on from there."""
    fork, parent = _first_point(tree, branch), int(tree.branch_parent[branch])
    depth_mm = tree.distance_from_root_mm
    others = [
        int(tree.branch_start[child])
        for child in tree.children(parent)
        if child != branch and abs(depth_mm[_first_point(tree, int(child))] - depth_mm[fork]) <= LOOK_MM
    ]
    if fork + 1 < tree.branch_start[parent + 1]:
        others.append(fork + 1)
    own = _direction(tree, fork, int(tree.branch_start[branch]))
    rest = [_direction(tree, fork, first) for first in others] or [tree.tangents[fork]]
    aside = own - np.mean(rest, axis=0)
    return max(DIRECTIONS, key=lambda named: float(aside @ np.array(named[1])))[0]


def _direction(tree: AirwayTree, fork: int, first: int) -> Float:
    """Return the unit vector from a fork to a place some mm down the branch of the point `first`."""
    points = np.arange(first, tree.branch_start[tree.branch_of_point[first] + 1])
    depth_mm = tree.distance_from_root_mm
    near = points[depth_mm[points] <= depth_mm[fork] + LOOK_MM]
    vector = tree.points_lps[near[-1] if len(near) else first] - tree.points_lps[fork]
    length = float(np.linalg.norm(vector))
    return np.asarray(vector / length if length > 0.0 else vector)

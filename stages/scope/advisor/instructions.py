"""Instructions for a person: at every bifurcation of a path, how far to turn, bend and advance."""

import math

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from stages.scope.advisor.path import ScopePath

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
    """Return what to do branch by branch, up to the state nearest to the goal.

    The tip is taken to be in the branch of the tree point nearest to it on the route to where it ends.
    """
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
    for number, (begin, end) in enumerate(zip(starts[:-1], starts[1:], strict=True)):
        here = int(branch[begin])
        twist, bend = np.degrees(path.states[begin, 12:14]).tolist()
        bends = np.degrees(path.states[begin:end, 13])
        instructions.append(
            Instruction(
                branch=here,
                generation=int(tree.generation[here]),
                from_carina_mm=float(tree.distance_from_root_mm[_first_point(tree, here)]) - carina,
                heading=_heading(tree, here) if number else "",
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

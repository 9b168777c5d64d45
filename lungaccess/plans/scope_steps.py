"""What hands do with the bronchoscope of a plan: its states merged into steps that a person can follow."""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float, Int
from anatomy.lung import Lung
from lungaccess.plans.bifurcations import route_bifurcations
from lungaccess.plans.clock_face import STRAIGHT_AHEAD, clock_hour
from lungaccess.plans.insertion import scope_motion, shown_motion
from lungaccess.plans.plan import Plan
from lungaccess.problem.channel import bend_factor
from stages.scope import ScopeMotion

MERGED_RAD = math.radians(8.0)
"""States are merged while an even motion is so near to them: hands are not steadier [assumption]."""
AHEAD_MM = 12.0
"""Where the way goes on is told by the place of the tip after so much more advance: about a branch on."""
ROUNDED_MM, ROUNDED_DEG = 0.5, 0.5
"""What is smaller is written as 0."""
STILL = np.linspace(0.0, 1.0, 33)
"""Shares of an even turn in place at which it is compared with the states between."""


@frozen_value
class ScopeStep:
    """One step of a scope's insertion; all that changes changes evenly over its advance.

    Parameters
    ----------
    advance_mm, inserted_mm : float
        Advance in this step, and the whole advance at its end; 0 mm is where the motion begins.
    twist_deg : float
        Change of the twist; positive is clockwise seen from behind, as the picture sees it.
    from_bend_deg, to_bend_deg : float
        Bend at begin and end; positive is towards the top of the picture, and negative is down.
    goes_on : str
        Where in the picture the airway goes on as the step begins.
    branch, generation : int
        Of the airway in which the tip is at the end; branches go by their numbers, as in the whole plan.
    first_state, last_state : int
        The states of the plan that it merges.
    """

    advance_mm: float
    inserted_mm: float
    twist_deg: float
    from_bend_deg: float
    to_bend_deg: float
    goes_on: str
    branch: int
    generation: int
    first_state: int
    last_state: int

    @property
    def text(self) -> str:
        """The step as a sentence."""
        turns = " and ".join(words for words in (self._twist_words, self._bend_words) if words)
        if self.advance_mm < ROUNDED_MM:
            do = f"stand still and {turns}" if turns else "stand still"
        elif turns:
            do = f"advance {self.advance_mm:.0f} mm and on the way {turns}"
        else:
            do = f"advance {self.advance_mm:.0f} mm with the tip {bend_words(self.to_bend_deg)}"
        return f"The airway goes on {self.goes_on}: {do}. Inserted: {self.inserted_mm:.0f} mm."

    @property
    def _twist_words(self) -> str:
        if abs(self.twist_deg) < ROUNDED_DEG:
            return ""
        way = "clockwise" if self.twist_deg > 0.0 else "counterclockwise"
        return f"turn the scope {abs(self.twist_deg):.0f}° {way} (seen from behind)"

    @property
    def _bend_words(self) -> str:
        if abs(self.to_bend_deg - self.from_bend_deg) < ROUNDED_DEG:
            return ""
        return f"bring the tip from {bend_words(self.from_bend_deg)} to {bend_words(self.to_bend_deg)}"

    def as_json(self) -> dict[str, object]:
        """Return the step as plain values, with its sentence."""
        return {**asdict(self), "text": self.text}


def bend_words(bend_deg: float) -> str:
    """Return a bend in words, such as "20° up"."""
    if abs(bend_deg) < ROUNDED_DEG:
        return "straight"
    return f"{abs(bend_deg):.0f}° {'up' if bend_deg > 0.0 else 'down'}"


def scope_steps(motion: ScopeMotion, tree: AirwayTree) -> tuple[ScopeStep, ...]:
    """Return a motion as steps."""
    tips, states = motion.tips, motion.states
    ends = merged_states(states)
    places = np.linalg.norm(tips[ends, None, :3, 3] - tree.points_lps[None], axis=2).argmin(axis=1)
    branches = tree.branch_of_point[places]
    angles = np.degrees(states)
    return tuple(
        ScopeStep(
            advance_mm=float(states[last, 0] - states[first, 0]),
            inserted_mm=float(states[last, 0]),
            twist_deg=float(angles[last, 1] - angles[first, 1]),
            from_bend_deg=float(angles[first, 2]),
            to_bend_deg=float(angles[last, 2]),
            goes_on=_goes_on(tips, states[:, 0], first),
            branch=int(branch),
            generation=int(tree.generation[branch]),
            first_state=int(first),
            last_state=int(last),
        )
        for first, last, branch in zip(ends[:-1], ends[1:], branches[1:], strict=True)
    )


def handle_factor(plan: Plan) -> float:
    """Return by how much more the handle bends the section while the plan's tubes are in it, 1 or more."""
    return bend_factor(plan.system, *plan.tube.insertions_mm(plan.system.tubes))


def handle_words(plan: Plan) -> str:
    """Say how the handle is set while the tubes go in, which straighten the section."""
    bend_deg, factor = float(np.degrees(plan.scope.states[-1, 2])), handle_factor(plan)
    if abs(bend_deg) < ROUNDED_DEG:
        return "The tip is straight, and tubes in the channel leave it so."
    return (
        f"Tubes in the channel straighten the tip: as they go in, set the handle up to {factor:.2f} times as "
        f"far, as for {bend_words(bend_deg * factor)} without them, so that the picture stays and the tip "
        f"keeps {bend_words(bend_deg)}."
    )


def motion_record(plan: Plan, lung: Lung) -> dict[str, object]:
    """Return a plan's motion of the bronchoscope as plain values: steps for hands, all states for motors."""
    advance, (twist, bend) = plan.scope.states[:, 0], np.degrees(plan.scope.states[:, 1:]).T
    return {
        "steps": [
            one.as_json() | {"branch_in_words": lung.branch_words(one.branch)}
            for one in scope_steps(scope_motion(plan), lung.tree)
        ],
        "bifurcations": [
            one.as_json() for one in route_bifurcations(shown_motion(plan), plan.scope.branches, lung)
        ],
        "states": [
            {"advance_mm": float(a), "twist_deg": float(t), "bend_deg": float(b)}
            for a, t, b in zip(advance, twist, bend, strict=True)
        ],
        "lps_from_entry": plan.scope.lps_from_entry.tolist(),
        "bending_length_mm": plan.system.scope.bending_length_mm,
        "handle_factor_with_tubes": handle_factor(plan),
    }


def merged_states(states: Float) -> Int:
    """Return the states `(K,)` between which all others lie near an even motion, with the first and last."""
    ends = [0]
    while ends[-1] < len(states) - 1:
        last = ends[-1] + 1
        while last + 1 < len(states) and _is_even(states[ends[-1] : last + 2]):
            last += 1
        ends.append(last)
    return np.array(ends)


def _is_even(states: Float) -> bool:
    """Tell whether all states are near those of an even motion from the first to the last."""
    advance = states[:, 0] - states[0, 0]
    still = advance[-1] <= 0.0
    share = STILL if still else advance / advance[-1]
    twist, bend = (states[0, 1:] + share[:, None] * (states[-1, 1:] - states[0, 1:])).T
    true, even = states[:, 2] * np.exp(1j * states[:, 1]), bend * np.exp(1j * twist)
    away = np.abs(true[:, None] - even).min(axis=1) if still else np.abs(true - even)
    return bool(away.max() <= MERGED_RAD)


def _goes_on(tips: Float, advance: Float, state: int) -> str:
    """Say where in the picture of a state the tip will be after some more advance."""
    later = min(int(np.searchsorted(advance, advance[state] + AHEAD_MM)), len(tips) - 1)
    hour = clock_hour(tips[state], tips[later, :3, 3])
    return f"towards {hour} o'clock in the picture" if hour else STRAIGHT_AHEAD

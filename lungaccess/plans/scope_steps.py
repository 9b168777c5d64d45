"""What hands do with the bronchoscope of a plan: the steps from each proved state to the next, in words."""

import math
from collections.abc import Callable
from dataclasses import asdict

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float, Int
from anatomy.lung import Lung
from lungaccess.plans.bifurcations import STRAIGHT_AHEAD, Picture, lps_from_camera, route_bifurcations
from lungaccess.plans.insertion import scope_motion, shown_motion
from lungaccess.plans.plan import Plan
from lungaccess.problem.channel import bend_factor
from stages.scope import ScopeMotion, prover_of

MOST_DECIMALS = 6
"""Steps are written with as many decimals as their proof takes, at most so many: no motor is finer."""
NEAR_MM, NEAR_RAD = 0.1, math.radians(0.1)
"""The tip of the steps as they are written is so near to that of the plan: less than any hand can tell."""
UNLIMITED_MM, UNLIMITED_DEG = 10.0, 90.0
"""Larger tolerances are not looked for."""

PROVED = (
    "Each step is the proved way from one state of the plan to the next, as it is written here, and its "
    "errors are those for which it is still proved, one at a time."
)
"""What is said of steps that are proved."""
DIRECTIONS = (
    "Up, down and o'clock are those of the scope's picture; twist 0 is as the scope enters the trachea, and "
    "inserted lengths count from there."
)
"""What is said of all steps."""


@frozen_value
class ScopeStep:
    """One step of a scope's insertion: the proved way from one state of the motion to the next, as written.

    It advances, turns the scope, or bends the tip; where both of the last change, they change evenly.

    Args:
        advance_mm, inserted_mm: Advance in this step, and the whole advance at its end; 0 mm is where the
            motion begins.
        twist_deg, to_twist_deg: Change of the twist and its value at the end; positive is clockwise seen from
            behind, as the picture sees it.
        from_bend_deg, to_bend_deg: Bend at begin and end; positive is towards the top of the picture, and
            negative is down.
        advance_tolerance_mm, twist_tolerance_deg, bend_tolerance_deg: By how much the advance at the end, or
            twist or bend anywhere in the step, may err, all else being as stated, with the scope and its gap
            still proved to be in the lumen; see `stages.scope.MotionProver.tolerances`.
        goes_on: Where in the picture the airway goes on as the step begins.
        branch, generation: Of the airway in which the tip is at the end; branches go by their numbers, as in
            the whole plan.
        state: The state of the plan in which it ends.
    """

    advance_mm: float
    inserted_mm: float
    twist_deg: float
    to_twist_deg: float
    from_bend_deg: float
    to_bend_deg: float
    advance_tolerance_mm: float
    twist_tolerance_deg: float
    bend_tolerance_deg: float
    goes_on: str
    branch: int
    generation: int
    state: int

    @property
    def text(self) -> str:
        """The step as a sentence, and its tolerance as another."""
        return f"The airway goes on {self.goes_on}: {self.action}. {self.tolerance_words}."

    @property
    def action(self) -> str:
        """What hands do."""
        if self.advance_mm > 0.0:
            return f"advance {_number(self.advance_mm)} mm, until {_number(self.inserted_mm)} mm are inserted"
        said = []
        if self.twist_deg != 0.0:
            turn = f"turn the scope {_number(abs(self.twist_deg))}° {_way(self.twist_deg)}"
            twist = _number(abs(self.to_twist_deg))
            way = "" if twist == "0" else f" {_way(self.to_twist_deg)}"
            said.append(f"{turn} (seen from behind), to {twist}°{way}")
        if self.to_bend_deg != self.from_bend_deg:
            bends = _bend_words(self.from_bend_deg), _bend_words(self.to_bend_deg)
            said.append("bring the tip from {} to {}".format(*bends))
        return " and evenly with it ".join(said)

    @property
    def tolerance_words(self) -> str:
        """By how much the step may err."""
        mm = _tolerance(self.advance_tolerance_mm, UNLIMITED_MM, " mm")
        twist = _tolerance(self.twist_tolerance_deg, UNLIMITED_DEG, "°")
        bend = _tolerance(self.bend_tolerance_deg, UNLIMITED_DEG, "°")
        return f"There is room for an error of {mm}, {twist} of twist or {bend} of bend"

    def as_json(self) -> dict[str, object]:
        """Return the step as plain values, with its sentence."""
        return {**asdict(self), "text": self.text}


def _number(value: float) -> str:
    """Return a number without zeros at its end."""
    return f"{value + 0.0:.{MOST_DECIMALS}f}".rstrip("0").rstrip(".")


def _tolerance(value: float, most: float, unit: str) -> str:
    """Return a tolerance, rounded down."""
    if value >= most:
        return f"{most:g}{unit} and more"
    tenths = math.floor(10.0 * value)
    return f"{0.1 * tenths:.1f}{unit}" if tenths else f"less than 0.1{unit}"


def _way(twist_deg: float) -> str:
    return "clockwise" if twist_deg > 0.0 else "counterclockwise"


def _bend_words(bend_deg: float) -> str:
    """Return a bend in words, such as "20° up"."""
    number = _number(abs(bend_deg))
    return "straight" if number == "0" else f"{number}° {'up' if bend_deg > 0.0 else 'down'}"


def _written_motion(plan: Plan, lung: Lung) -> ScopeMotion:
    """Return the motion of a plan's bronchoscope as steps write it, with as few decimals as its proof takes.

    It has the most decimals where not even the motion of the plan is proved.
    """
    motion, prover = scope_motion(plan), prover_of(lung, plan.system.scope)
    for decimals in range(1, MOST_DECIMALS + 1):
        written = motion.written(decimals)
        apart = written.lps_from_tip - motion.lps_from_tip
        # The nine cosines of two frames differ by sqrt(2) times the turn between them, if it is small.
        turned_rad = np.linalg.norm(apart[:3, :3]) / math.sqrt(2.0)
        near = np.linalg.norm(apart[:3, 3]) <= NEAR_MM and turned_rad <= NEAR_RAD
        if near and not isinstance(prover.prove(written), str):
            break
    return written


def scope_steps(plan: Plan, lung: Lung) -> tuple[ScopeStep, ...]:
    """Return the motion of a plan's bronchoscope as steps, each from one proved state to the next."""
    motion = _written_motion(plan, lung)
    allowed = prover_of(lung, plan.system.scope).tolerances(motion)
    eyes = lps_from_camera(plan.system, motion.tips)
    places = lung.tree.route(int(lung.tree.branch_start[plan.scope.branches[-1] + 1]) - 1)
    return steps_of(motion, lung.tree, allowed, lambda state: _goes_on(lung, places, eyes[state]))


def steps_note(plan: Plan, lung: Lung) -> str:
    """Say what there is to know of the steps wherever they are shown, above all if they are not proved."""
    proved = prover_of(lung, plan.system.scope).prove(_written_motion(plan, lung))
    said = f"These steps are not proved: {proved}." if isinstance(proved, str) else PROVED
    return f"{said} {DIRECTIONS}"


def steps_of(
    motion: ScopeMotion, tree: AirwayTree, allowed: Float, goes_on: Callable[[int], str]
) -> tuple[ScopeStep, ...]:
    """Return a motion as steps; where nothing changes there is none.

    Args:
        motion: As it is written, M states.
        allowed ((M - 1, 3) float64): Its tolerances, see `stages.scope.MotionProver.tolerances`.
        goes_on (function of a state): Says where in its picture the airway goes on.
    """
    tips, degrees = motion.tips, np.degrees(motion.states[:, 1:])
    written = np.round(np.column_stack([motion.states[:, 0], degrees]), MOST_DECIMALS)
    moved = np.round(np.diff(written, axis=0), MOST_DECIMALS)
    places = np.linalg.norm(tips[:, None, :3, 3] - tree.points_lps[None], axis=2).argmin(axis=1)
    branches = tree.branch_of_point[places]
    return tuple(
        ScopeStep(
            advance_mm=float(moved[end - 1, 0]),
            inserted_mm=float(written[end, 0]),
            twist_deg=float(moved[end - 1, 1]),
            to_twist_deg=float(written[end, 1]),
            from_bend_deg=float(written[end - 1, 2]),
            to_bend_deg=float(written[end, 2]),
            advance_tolerance_mm=float(allowed[end - 1, 0]),
            twist_tolerance_deg=float(np.degrees(allowed[end - 1, 1])),
            bend_tolerance_deg=float(np.degrees(allowed[end - 1, 2])),
            goes_on=goes_on(end - 1),
            branch=int(branches[end]),
            generation=int(tree.generation[branches[end]]),
            state=end,
        )
        for end in range(1, len(tips))
        if moved[end - 1].any()
    )


def handle_factor(plan: Plan) -> float:
    """Return by how much more the handle bends the section while the plan's tubes are in it, 1 or more."""
    return bend_factor(plan.system, *plan.tube.insertions_mm(plan.system.tubes))


def handle_words(plan: Plan) -> str:
    """Say how the handle is set while the tubes go in, which straighten the section."""
    bend_deg, factor = float(np.degrees(plan.scope.states[-1, 2])), handle_factor(plan)
    with_tubes, without = (_bend_words(round(each, 1)) for each in (bend_deg, bend_deg * factor))
    if with_tubes == _bend_words(0.0):
        return "The tip is straight, and tubes in the channel leave it so."
    return (
        f"Tubes in the channel straighten the tip: as they go in, set the handle up to {factor:.2f} times as "
        f"far, as for {without} without them, so that the picture stays and the tip "
        f"keeps {with_tubes}."
    )


def motion_record(plan: Plan, lung: Lung) -> dict[str, object]:
    """Return a plan's motion of the bronchoscope as plain values: steps for hands, states for motors."""
    advance, (twist, bend) = plan.scope.states[:, 0], np.degrees(plan.scope.states[:, 1:]).T
    return {
        "steps": [
            one.as_json() | {"branch_in_words": lung.branch_words(one.branch)}
            for one in scope_steps(plan, lung)
        ],
        "bifurcations": [
            one.as_json()
            for one in route_bifurcations(shown_motion(plan), plan.scope.branches, lung, plan.system)
        ],
        "states": [
            {"advance_mm": float(a), "twist_deg": float(t), "bend_deg": float(b)}
            for a, t, b in zip(advance, twist, bend, strict=True)
        ],
        "passes": list(plan.redirections),
        "note": steps_note(plan, lung),
        "lps_from_entry": plan.scope.lps_from_entry.tolist(),
        "bending_length_mm": plan.system.scope.bending_length_mm,
        "handle_factor_with_tubes": handle_factor(plan),
    }


def _goes_on(lung: Lung, route: Int, lps_from_eye: Float) -> str:
    """Say where a picture shows that the route over points of the tree goes on."""
    points, depth = lung.tree.points_lps[route], lung.tree.distance_from_root_mm[route]
    here = int(np.linalg.norm(points - lps_from_eye[:3, 3], axis=1).argmin())
    # Where the way goes on is told by what the picture shows of the airway from so far ahead on.
    ahead = min(int(np.searchsorted(depth, depth[here] + 12.0)), len(route) - 1)
    # A picture of 48 pixels along each edge shows where the lumen goes on.
    (hole,) = Picture(lung, lps_from_eye, 48).holes([int(route[ahead])])
    return goes_on_words(hole.hour(lps_from_eye))


def goes_on_words(hour: int) -> str:
    """Say that the airway goes on at an hour of `lungaccess.plans.bifurcations.Hole.hour`."""
    return f"towards {hour} o'clock in the picture" if hour else STRAIGHT_AHEAD

"""A plan as a motion in time: joint values of scope, tubes and needle, and where their tips are."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float
from anatomy.grid import freeze_arrays
from anatomy.poses import poses_on_pieces
from lungaccess.plans.curves import needle_pieces
from lungaccess.plans.insertion import scope_motion
from lungaccess.plans.plan import Plan
from stages.needle import arc_transform
from stages.scope import ScopeMotion
from stages.tube import Neighbourhood, pieces_of_arcs

SCOPE, TUBES, NEEDLE = "scope", "tubes", "needle"
STEP_S = 0.1
"""Time between two samples: at the default speeds no tip moves by more than 1 mm in it."""
SHORTEST_S = 1e-9
"""Waypoints nearer to each other in time are one."""

_Speed = Annotated[float, quantity("speed, mm/s", above=0.0, at_most=1000.0)]
_Turn = Annotated[float, quantity("speed of turning, degrees/s", above=0.0, at_most=3600.0)]


@settings
class Speeds:
    """How fast joints move; what is given here are assumptions, not properties of a device.

    Args:
        scope_mm_per_s, scope_deg_per_s: Advance; twist and bend.
        tube_mm_per_s, tube_deg_per_s: Insertion and rotation of every tube.
        needle_mm_per_s, needle_deg_per_s: Insertion and roll.
    """

    scope_mm_per_s: _Speed = 10.0
    scope_deg_per_s: _Turn = 30.0
    tube_mm_per_s: _Speed = 2.0
    tube_deg_per_s: _Turn = 30.0
    needle_mm_per_s: _Speed = 2.0
    needle_deg_per_s: _Turn = 60.0


@frozen_record
class Trajectory:
    """A plan in time; T samples of J joints.

    Args:
        joints: Names of the joints, with their units: "scope_advance_mm", "scope_twist_rad",
            "scope_bend_rad"; of every tube, the outermost first, "outer_tube_insertion_mm" and
            "outer_tube_rotation_rad"; and "needle_insertion_mm", "needle_roll_rad" and
            "needle_curvature_per_mm", which is commanded.
        time_s ((T,) float64): Seconds from the begin, strictly rising.
        values ((T, J) float64): Between two samples every joint moves at a steady rate; the curvature holds
            up to its sample.
        stages: For each sample which device moves: "scope", "tubes" or "needle".
        lps_from_scope_tip, lps_from_tube_tip, lps_from_needle_tip ((T, 4, 4) float64): Where the tips are,
            LPS mm; a device that is not out yet is at the tip of the one around it.
    """

    joints: tuple[str, ...]
    time_s: Float
    values: Float
    stages: tuple[str, ...]
    lps_from_scope_tip: Float
    lps_from_tube_tip: Float
    lps_from_needle_tip: Float

    def __post_init__(self) -> None:
        tips = ("lps_from_scope_tip", "lps_from_tube_tip", "lps_from_needle_tip")
        freeze_arrays(self, "time_s", "values", *tips, dtype=np.float64)

    def tips(self, stage: str) -> Float:
        """Return where the tip of the device of a stage is, `(T, 4, 4)` LPS mm."""
        of = {SCOPE: self.lps_from_scope_tip, TUBES: self.lps_from_tube_tip, NEEDLE: self.lps_from_needle_tip}
        return of[stage]


def plan_trajectory(plan: Plan, speeds: Speeds | None = None, *, step_s: float = STEP_S) -> Trajectory:
    """Return a plan as a motion in time, each joint at its speed or slower.

    The scope goes through its states.  The tubes are turned at the tip of the scope, then go out together
    and stop one by one, as the plan's sweep is proved for.  The needle rolls, then bends along each arc.

    Args:
        speeds: The default ones if None.
        step_s: Largest time between two samples; there is one at every state, stop and arc, too.

    Raises:
        SettingsError: If the step is not above 0, or the tubes of the plan snap on the way.
    """
    if not 0.0 < step_s < np.inf:
        raise SettingsError(f"The samples are {step_s} s apart", expected="a time above 0")
    chosen = speeds or Speeds()
    parts = [np.asarray(plan.scope.states), _tube_waypoints(plan), _needle_waypoints(plan)]
    rows, stages = _joined([part for part in parts if len(part)])
    most = _most_per_s(plan, chosen)
    steps_s = (np.abs(np.diff(rows, axis=0)) / most).max(axis=1)
    kept = np.append(True, steps_s > SHORTEST_S)
    rows, at_s = rows[kept], np.append(0.0, np.cumsum(steps_s))[kept]
    stages = [stage for stage, keep in zip(stages, kept, strict=True) if keep]
    time_s = _sampled(at_s, step_s)
    values = np.stack([np.interp(time_s, at_s, column) for column in rows.T], axis=1)
    upto = np.searchsorted(at_s, time_s - SHORTEST_S)
    values[:, -1] = rows[upto, -1]
    scope, tube, needle = _tips(plan, values)
    return Trajectory(
        joints=_joint_names(plan), time_s=time_s, values=values, stages=tuple(stages[n] for n in upto),
        lps_from_scope_tip=scope, lps_from_tube_tip=tube, lps_from_needle_tip=needle,
    )  # fmt: skip


def _joint_names(plan: Plan) -> tuple[str, ...]:
    tubes = [
        f"{name}_tube_{joint}"
        for name, _tube in plan.system.tubes.named
        for joint in ("insertion_mm", "rotation_rad")
    ]
    needle = ("needle_insertion_mm", "needle_roll_rad", "needle_curvature_per_mm")
    return ("scope_advance_mm", "scope_twist_rad", "scope_bend_rad", *tubes, *needle)


def _most_per_s(plan: Plan, speeds: Speeds) -> Float:
    """Return the speed of every joint; the curvature is commanded at once."""
    turn = np.radians(speeds.scope_deg_per_s)
    tubes = [speeds.tube_mm_per_s, np.radians(speeds.tube_deg_per_s)] * len(plan.system.tubes.named)
    needle = [speeds.needle_mm_per_s, np.radians(speeds.needle_deg_per_s), np.inf]
    return np.array([speeds.scope_mm_per_s, turn, turn, *tubes, *needle])


def _tube_waypoints(plan: Plan) -> Float:
    """Return insertion and rotation of every tube `(W, 2 n)`: turned first, then out, one stopping by one."""
    tube, tubes = plan.tube, plan.system.tubes
    inserted, turned = np.array(tube.insertions_mm(tubes)), np.array(tube.rotations_rad(tubes))
    rows = [np.zeros(2 * len(inserted))]
    for out_mm in (0.0, *sorted({*inserted.tolist()} - {0.0})):
        rows.append(np.stack([np.minimum(inserted, out_mm), turned], axis=1).ravel())
    return np.array(rows)


def _needle_waypoints(plan: Plan) -> Float:
    """Return insertion, roll and curvature `(W, 3)`; the needle rolls in place before each arc."""
    rows = [np.zeros(3)]
    for length, roll, curvature in needle_pieces(plan.needle):
        rows.append(np.array([rows[-1][0], rows[-1][1] + roll, curvature]))
        rows.append(rows[-1] + [length, 0.0, 0.0])
    return np.array(rows) if len(rows) > 1 else np.zeros((0, 3))


def _joined(parts: list[Float]) -> tuple[Float, list[str]]:
    """Return waypoints `(W, J)` of all joints, one device after another, and which of them moves to each."""
    widths = [part.shape[1] for part in parts]
    rows, stages, now = [], [], np.concatenate([part[0] for part in parts])
    for name, begin, part in zip((SCOPE, TUBES, NEEDLE), np.cumsum([0, *widths[:-1]]), parts, strict=False):
        for values in part if name == SCOPE else part[1:]:
            now = now.copy()
            now[begin : begin + len(values)] = values
            rows.append(now)
            stages.append(name)
    joints = np.array(rows)
    return (joints if len(parts) == 3 else np.column_stack([joints, np.zeros((len(joints), 3))])), stages


def _sampled(at_s: Float, step_s: float) -> Float:
    """Return times no more than a step apart, with all of `at_s`."""
    parts = [at_s[:1]]
    for begin, end in pairwise(at_s.tolist()):
        parts.append(np.linspace(begin, end, max(1, int(np.ceil((end - begin) / step_s - 1e-9))) + 1)[1:])
    return np.concatenate(parts)


def _tips(plan: Plan, values: Float) -> tuple[Float, Float, Float]:
    """Return the tips of scope, tubes and needle at joint values `(T, J)`, each `(T, 4, 4)`."""
    motion = scope_motion(plan)
    scope = ScopeMotion(
        lps_from_entry=motion.lps_from_entry, states=values[:, :3], bending_length_mm=motion.bending_length_mm
    ).tips
    inserted = values[:, 3:-3:2]
    in_tubes = inserted.max(axis=1) > 0.0
    tube = scope.copy()
    tube[in_tubes] = _tube_tips(plan, inserted[in_tubes])
    needle = tube.copy()
    if plan.needle is not None:
        for row in np.flatnonzero(values[:, -3:].any(axis=1)):
            needle[row] = _needle_tip(plan, float(values[row, -3]), float(values[row, -2]))
    return scope, tube, needle


def _tube_tips(plan: Plan, inserted_mm: Float) -> Float:
    """Return the tip of the tubes `(N, 4, 4)` at insertions `(N, n)`, the outermost tube first."""
    tube, tubes, base = plan.tube, plan.system.tubes, np.asarray(plan.scope.lps_from_scope_tip)
    tips = np.zeros((len(inserted_mm), 4, 4))
    turned = np.array(tube.rotations_rad(tubes))[::-1] - tube.rotation_rad
    around = None
    for n, row in enumerate(inserted_mm):
        around = around or Neighbourhood.of(tubes.nested, row[::-1], turned, needle=tubes.needle_shaft)
        found = around.at(row[::-1], turned)
        if found is None:
            raise SettingsError("The tubes of the plan snap on the way", remedy="Run `lungaccess check`")
        around = around.moved(found)
        pieces = pieces_of_arcs(np.asarray(found.arcs), tube.rotation_rad)
        tips[n] = poses_on_pieces(base, pieces, np.inf)[0][-1]
    return tips


def _needle_tip(plan: Plan, inserted_mm: float, roll_rad: float) -> Float:
    """Return the tip of the needle where so much of it is inserted and rolled."""
    frame, turned = np.asarray(plan.tube.lps_from_tip), 0.0
    for length, roll, curvature in needle_pieces(plan.needle):
        if inserted_mm <= 0.0:
            break
        frame = frame @ arc_transform(min(length, inserted_mm), roll, curvature)
        inserted_mm, turned = inserted_mm - length, turned + roll
    return np.asarray(frame @ arc_transform(0.0, roll_rad - turned, 0.0))

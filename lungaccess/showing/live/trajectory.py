"""A plan as a motion in time: joint values and tips of the devices, and their files, which need no ROS."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from scipy.spatial.transform import Rotation

from anatomy.base.errors import SettingsError
from anatomy.base.files import require_writable_folder, write_text
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

    The scope goes through its states.  The tubes are turned at the tip of the scope, then go out together and
    stop one by one, as the plan's sweep is proved for.  The needle rolls, then bends along each arc.  Raises
    SettingsError if the step is not above 0, or the tubes of the plan snap on the way.

    Args:
        speeds: The default ones if None.
        step_s: Largest time between two samples; there is one at every state, stop and arc, too.
    """
    if not 0.0 < step_s < np.inf:
        raise SettingsError(f"The samples are {step_s} s apart", expected="a time above 0")
    chosen = speeds or Speeds()
    parts = [np.asarray(plan.scope.states), _tube_waypoints(plan), _needle_waypoints(plan)]
    rows, stages = _joined([part for part in parts if len(part)])
    turn = np.radians(chosen.scope_deg_per_s)
    tubes = [chosen.tube_mm_per_s, np.radians(chosen.tube_deg_per_s)] * len(plan.system.tubes.named)
    # The curvature of the needle is commanded at once.
    bends = [chosen.needle_mm_per_s, np.radians(chosen.needle_deg_per_s), np.inf]
    most = np.array([chosen.scope_mm_per_s, turn, turn, *tubes, *bends])
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


TABLE_FILE, JOINTS_FILE = "trajectory.csv", "joint_trajectory.yaml"
PATH_FILES = {SCOPE: "scope_path.yaml", TUBES: "tubes_path.yaml", NEEDLE: "needle_path.yaml"}
M_PER_MM = 1e-3
DIGITS = 10
"""Significant digits of a number: far below a nanometre."""
_SI = {"_mm": ("", M_PER_MM), "_rad": ("", 1.0), "_per_mm": ("", 1.0 / M_PER_MM)}


def write_trajectory(trajectory: Trajectory, folder: str | Path) -> tuple[str, ...]:
    """Write a trajectory as a table and as messages of ROS 2; return the names of the files.

    Raises FileError if the folder cannot be written.
    """
    target = require_writable_folder(folder)
    write_text(target / TABLE_FILE, table_text(trajectory))
    write_text(target / JOINTS_FILE, yaml_text(joint_trajectory(trajectory)))
    written = [TABLE_FILE, JOINTS_FILE]
    for stage, name in PATH_FILES.items():
        if stage in trajectory.stages:
            write_text(target / name, yaml_text(tip_path(trajectory, stage)))
            written.append(name)
    return tuple(written)


def table_text(trajectory: Trajectory) -> str:
    """Return a trajectory as CSV: time, stage, joints, and the pose of the tip that moves, LPS mm.

    The pose is a position and a unit quaternion, x, y, z, w.
    """
    pose = ("tip_x_mm", "tip_y_mm", "tip_z_mm", "tip_qx", "tip_qy", "tip_qz", "tip_qw")
    lines = [",".join(("time_s", "stage", *trajectory.joints, *pose))]
    tips = np.stack([trajectory.tips(stage)[n] for n, stage in enumerate(trajectory.stages)])
    rows = np.column_stack([trajectory.values, tips[:, :3, 3], _quaternions(tips)])
    for time, stage, row in zip(trajectory.time_s, trajectory.stages, rows, strict=True):
        lines.append(",".join((_number(time), stage, *(_number(value) for value in row))))
    return "\n".join([*lines, ""])


def joint_trajectory(trajectory: Trajectory) -> dict[str, Any]:
    """Return a trajectory as a `trajectory_msgs/msg/JointTrajectory`: metres, radians, 1/m.

    Velocities are those up to the next sample, 0 at the last.
    """
    scales = np.array([_SI[_unit(name)][1] for name in trajectory.joints])
    values = trajectory.values * scales
    rates = np.diff(values, axis=0) / np.diff(trajectory.time_s)[:, None]
    rates = np.vstack([rates, np.zeros(values.shape[1])])
    # The curvature is commanded at once: it is no joint that moves at a rate.
    rates[:, -1] = 0.0
    points = [
        {
            "positions": position.tolist(), "velocities": rate.tolist(), "accelerations": [], "effort": [],
            "time_from_start": _time(time),
        }
        for position, rate, time in zip(values, rates, trajectory.time_s.tolist(), strict=True)
    ]  # fmt: skip
    names = [name.removesuffix(_unit(name)) for name in trajectory.joints]
    return {"header": _header(0.0), "joint_names": names, "points": points}


def tip_path(trajectory: Trajectory, stage: str) -> dict[str, Any]:
    """Return the way of one tip as a `nav_msgs/msg/Path` with a time at every pose, metres."""
    chosen = [n for n, each in enumerate(trajectory.stages) if each == stage]
    tips = trajectory.tips(stage)[chosen]
    poses = [
        {
            "header": _header(float(trajectory.time_s[n])),
            "pose": {
                "position": dict(zip("xyz", (M_PER_MM * tip[:3, 3]).tolist(), strict=True)),
                "orientation": dict(zip("xyzw", turn.tolist(), strict=True)),
            },
        }
        for n, tip, turn in zip(chosen, tips, _quaternions(tips), strict=True)
    ]
    return {"header": _header(0.0), "poses": poses}


def _quaternions(poses: Float) -> Float:
    """Return the rotations of poses `(N, 4, 4)` as unit _quaternions `(N, 4)`, x, y, z, w, without jumps."""
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    signs = [1.0]
    for one, other in pairwise(turns):
        signs.append(signs[-1] * (-1.0 if float(one @ other) < 0.0 else 1.0))
    return np.asarray(turns * np.array(signs)[:, None])


def _unit(name: str) -> str:
    return next(unit for unit in ("_per_mm", "_mm", "_rad") if name.endswith(unit))


def _header(time_s: float) -> dict[str, Any]:
    # Frame of all positions: x to the patient's left, y to the back, z to the head; in ROS 2 in metres.
    return {"stamp": _time(time_s), "frame_id": "patient_lps"}


def _time(time_s: float) -> dict[str, int]:
    nanoseconds = round(1e9 * time_s)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def yaml_text(content: Mapping[str, Any]) -> str:
    """Return plain values as YAML in block style, lists of numbers in one line each."""
    return "\n".join([*_mapping(content, ""), ""])


def _mapping(content: Mapping[str, Any], indent: str) -> Iterator[str]:
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield f"{indent}{key}:"
            yield from _mapping(value, indent + "  ")
        elif isinstance(value, Sequence) and value and isinstance(value[0], Mapping):
            yield f"{indent}{key}:"
            for item in value:
                first, *others = _mapping(item, indent + "  ")
                yield f"{indent}- {first.lstrip()}"
                yield from others
        elif isinstance(value, Sequence) and not isinstance(value, str):
            yield f"{indent}{key}: [{', '.join(_scalar(each) for each in value)}]"
        else:
            yield f"{indent}{key}: {_scalar(value)}"


def _scalar(value: Any) -> str:
    return value if isinstance(value, str) else str(value) if isinstance(value, int) else _number(value)


def _number(value: float) -> str:
    """Return a number with a point or an exponent that YAML reads as a float."""
    text = f"{float(value):.{DIGITS}g}"
    if math.isfinite(value) and "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return text if "." in text or "e" in text else text + ".0"

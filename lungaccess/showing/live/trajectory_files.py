"""A trajectory as plain files: a table, and YAML laid out as messages of ROS 2, which need no ROS."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from anatomy.base.files import require_writable_folder, write_text
from anatomy.base.typed import Float
from lungaccess.showing.live.trajectory import NEEDLE, SCOPE, TUBES, Trajectory

TABLE_FILE, JOINTS_FILE = "trajectory.csv", "joint_trajectory.yaml"
PATH_FILES = {SCOPE: "scope_path.yaml", TUBES: "tubes_path.yaml", NEEDLE: "needle_path.yaml"}
M_PER_MM = 1e-3
DIGITS = 10
"""Significant digits of a number: far below a nanometre."""
_SI = {"_mm": ("", M_PER_MM), "_rad": ("", 1.0), "_per_mm": ("", 1.0 / M_PER_MM)}


def write_trajectory(trajectory: Trajectory, folder: str | Path) -> tuple[str, ...]:
    """Write a trajectory as a table and as messages of ROS 2; return the names of the files.

    Raises:
        FileError: If the folder cannot be written.
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
    rows = np.column_stack([trajectory.values, tips[:, :3, 3], quaternions(tips)])
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
            "positions": position.tolist(),
            "velocities": rate.tolist(),
            "accelerations": [],
            "effort": [],
            "time_from_start": _time(time),
        }
        for position, rate, time in zip(values, rates, trajectory.time_s.tolist(), strict=True)
    ]
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
        for n, tip, turn in zip(chosen, tips, quaternions(tips), strict=True)
    ]
    return {"header": _header(0.0), "poses": poses}


def quaternions(poses: Float) -> Float:
    """Return the rotations of poses `(N, 4, 4)` as unit quaternions `(N, 4)`, x, y, z, w, without jumps."""
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
            yield from _listed(value, indent)
        elif isinstance(value, Sequence) and not isinstance(value, str):
            yield f"{indent}{key}: [{', '.join(_scalar(each) for each in value)}]"
        else:
            yield f"{indent}{key}: {_scalar(value)}"


def _listed(items: Iterable[Mapping[str, Any]], indent: str) -> Iterator[str]:
    for item in items:
        first, *others = _mapping(item, indent + "  ")
        yield f"{indent}- {first.lstrip()}"
        yield from others


def _scalar(value: Any) -> str:
    return value if isinstance(value, str) else str(value) if isinstance(value, int) else _number(value)


def _number(value: float) -> str:
    """Return a number with a point or an exponent that YAML reads as a float."""
    text = f"{float(value):.{DIGITS}g}"
    if math.isfinite(value) and "e" in text and "." not in text:
        text = text.replace("e", ".0e")
    return text if "." in text or "e" in text else text + ".0"

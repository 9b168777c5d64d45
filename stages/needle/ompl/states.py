"""States and paths of OMPL as frames and arcs."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from anatomy.base.typed import Float
from stages.needle.kernels import states
from stages.needle.path import ArcPath


def write_state(state: Any, frame: Float) -> None:
    """Set an OMPL SE(3) state to a frame."""
    put_numbers(state, states.state_of(frame))


def read_state(state: Any) -> Float:
    """Return the frame of an OMPL SE(3) state."""
    numbers = numbers_of(state)
    frame = np.eye(4)
    frame[:3, :3] = np.array(states.axes(numbers)).T
    frame[:3, 3] = numbers[:3]
    return frame


def numbers_of(state: Any) -> tuple[float, ...]:
    """Return position (mm) and unit quaternion x, y, z, w of an OMPL SE(3) state."""
    q = state.rotation()
    return state.getX(), state.getY(), state.getZ(), q.x, q.y, q.z, q.w


def put_numbers(state: Any, numbers: Sequence[float]) -> None:
    """Set an OMPL SE(3) state to position (mm) and unit quaternion x, y, z, w."""
    q = state.rotation()
    x, y, z, q.x, q.y, q.z, q.w = numbers
    state.setX(x)
    state.setY(y)
    state.setZ(z)


def path_of(solution: Any) -> ArcPath:
    """Return a `control.PathControl` as arcs, one for each run of controls that bend alike.

    Nothing is proved here: see `NeedleProblem.violation`.
    """
    arcs: list[list[float]] = []
    before: tuple[float, float] | None = None
    for n in range(solution.getControlCount()):
        u = solution.getControl(n)
        length, bend = u[0] * solution.getControlDuration(n), (u[1], u[2])
        if bend == before:
            arcs[-1][0] += length
        else:
            turned = bend[0] - (0.0 if before is None else before[0])
            arcs.append([length, math.remainder(turned, 2.0 * math.pi), bend[1]])
        before = bend
    return ArcPath(lps_from_start=read_state(solution.getState(0)), arcs=np.array(arcs))

"""Needle paths as a person steers them: roll, then insert along an arc.

A query is what is asked of a path; violations are why one is no answer to it, whoever found it.
"""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses as frames
from anatomy.base.errors import FrameError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from anatomy.kernels import arcs as arc_kernels
from anatomy.structures import BITS
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels import tree
from stages.needle.kernels.connections import least_cosine
from stages.needle.kernels.proof import blocker_on_arc


@frozen_record
class Query:
    """A start pose and a target.

    Args:
        lps_from_start ((4, 4) float64): +z is the direction of insertion.
        target: (3,) float64, LPS mm.
        branch: Pierced branch, whose wall is exempt at the exit; -1 for none.
        inserted_mm, turned_rad: Length of the needle behind the start and its accumulated turn: the limits
            count both, and so does the exemption at the exit.
        reference ((3,) float64): Direction from which the limit of the angle counts; by default the start's.

    Raises:
        FrameError: If there are not so many finite numbers, the pose is not rigid, or the reference is 0.
        SettingsError: If the length or the turn behind the start is negative or not finite.
    """

    lps_from_start: Float
    target: Float
    branch: int = -1
    inserted_mm: float = 0.0
    turned_rad: float = 0.0
    reference: Float | None = None

    @property
    def goal(self) -> tuple[float, float, float]:
        """The target as the kernels take it."""
        return as_point(self.target)

    def __post_init__(self) -> None:
        frame = np.array(self.lps_from_start, dtype=np.float64)
        target = np.array(self.target, dtype=np.float64)
        if frame.shape != (4, 4) or target.shape != (3,) or not np.isfinite([*frame.flat, *target]).all():
            raise FrameError(
                f"A needle query has a start of shape {frame.shape} and a target of shape {target.shape}",
                expected="a 4x4 pose and three coordinates, all finite, LPS mm",
            )
        rotation = frame[:3, :3]
        if not (np.abs(rotation.T @ rotation - np.eye(3)).max() <= 1e-6 and np.linalg.det(rotation) > 0):
            raise FrameError(
                "The start of a needle query is not a right-handed rigid pose", expected="a rotation"
            )
        for name, value in (("inserted length", self.inserted_mm), ("accumulated turn", self.turned_rad)):
            if not 0.0 <= value < math.inf:
                raise SettingsError(f"The {name} is {value}", expected="a finite number of 0 or more")
        object.__setattr__(self, "lps_from_start", frame)
        object.__setattr__(self, "target", target)
        if self.reference is not None:
            object.__setattr__(self, "reference", _unit(np.array(self.reference, dtype=np.float64)))


def _unit(direction: Float) -> Float:
    length = float(np.linalg.norm(direction)) if direction.shape == (3,) else math.nan
    if not 0.0 < length < math.inf:
        raise FrameError(
            f"The reference direction of a needle query is {direction.tolist()}",
            expected="three finite numbers, not all 0",
        )
    return direction / length


SAME_MM = 1e-6
SAME_RAD = 1e-6
"""Rounding that is forgiven."""

LENGTH, ROLL, CURVATURE = 0, 1, 2


@frozen_record
class ArcPath:
    """A needle path of A arcs from a start pose.

    Args:
        lps_from_start ((4, 4) float64): +z is the direction of insertion.
        arcs ((A, 3) float64): Length in mm, roll in rad about the tip's axis before the arc (it bends towards
            the +x of the rolled frame, which stays), curvature in 1/mm.
    """

    lps_from_start: Float
    arcs: Float

    def __post_init__(self) -> None:
        object.__setattr__(self, "lps_from_start", read_only(np.array(self.lps_from_start, dtype=np.float64)))
        object.__setattr__(self, "arcs", read_only(np.asarray(self.arcs, dtype=np.float64).reshape(-1, 3)))

    def arc_records(self) -> list[dict[str, float]]:
        """Return the arcs as files hold them: length, roll and curvature of each, by name."""
        return [
            {"length_mm": length, "roll_rad": roll, "curvature_per_mm": curvature}
            for length, roll, curvature in self.arcs.tolist()
        ]

    @property
    def length_mm(self) -> float:
        """Length of all arcs."""
        return float(self.arcs[:, LENGTH].sum())

    @property
    def accumulated_turn_rad(self) -> float:
        """Sum of the angles of all arcs."""
        return float((self.arcs[:, LENGTH] * self.arcs[:, CURVATURE]).sum())

    def frames(self) -> Float:
        """Return the tip frame after each arc, `(A + 1, 4, 4)`, the start first."""
        out = [self.lps_from_start]
        for length, roll, curvature in self.arcs:
            out.append(out[-1] @ arc_transform(length, roll, curvature))
        return np.stack(out)

    def sample(self, step_mm: float) -> tuple[Float, Float]:
        """Return points `(M, 3)` at most `step_mm` apart and their path lengths `(M,)`, ends included."""
        points, lengths = [self.lps_from_start[None, :3, 3]], [np.zeros(1)]
        for frame, (length, roll, curvature) in zip(self.frames(), self.arcs, strict=False):
            count = max(1, math.ceil(length / step_mm))
            s = length * np.arange(1, count + 1) / count
            points.append(frames.poses_on_arc(frame, roll, curvature, s)[:, :3, 3])
            lengths.append(lengths[-1][-1] + s)
        return np.concatenate(points), np.concatenate(lengths)

    def max_angle_from_start_rad(self, reference: Float | None = None) -> float:
        """Return the largest angle between the tip and a direction `(3,)`, by default that at the start."""
        direction = self.lps_from_start[:3, 2] if reference is None else reference
        least = 1.0
        for frame, (length, roll, curvature) in zip(self.frames(), self.arcs, strict=False):
            forward = float(direction @ frame[:3, 2])
            aside = float(direction @ bend_direction(frame, roll))
            least = min(least, least_cosine(forward, aside, length * curvature))
        return math.acos(least)


def bend_direction(frame: Float, roll_rad: float) -> Float:
    """Return the unit vector towards which an arc bends after a roll in a tip frame."""
    return np.asarray(math.cos(roll_rad) * frame[:3, 0] + math.sin(roll_rad) * frame[:3, 1])


def arc_transform(length_mm: float, roll_rad: float, curvature_per_mm: float) -> Float:
    """Return `before_from_after` (4, 4) of a roll followed by an arc that bends towards +x."""
    angle = curvature_per_mm * length_mm
    roll = np.eye(4)
    roll[:2, :2] = [[math.cos(roll_rad), -math.sin(roll_rad)], [math.sin(roll_rad), math.cos(roll_rad)]]
    arc = np.eye(4)
    arc[0, 0] = arc[2, 2] = math.cos(angle)
    arc[0, 2], arc[2, 0] = math.sin(angle), -math.sin(angle)
    arc[0, 3] = arc_kernels.versine_length(curvature_per_mm, length_mm)
    arc[2, 3] = arc_kernels.sine_length(curvature_per_mm, length_mm)
    return np.asarray(roll @ arc)


def as_point(values: ArrayLike) -> tuple[float, float, float]:
    """Return three coordinates as the kernels take them."""
    x, y, z = np.asarray(values).tolist()
    return x, y, z


def pose_at(frame: Float) -> tuple[float, ...]:
    """Return position and direction of a tip frame as the kernels take them."""
    return *as_point(frame[:3, 3]), *as_point(frame[:3, 2])


def direct_path(lps_from_start: Float, target: ArrayLike) -> ArcPath:
    """Return the single arc from a pose to a point [Kuntz2015, `steer`]; no limit is checked here."""
    length, (curvature, *normal), _turn = arc_kernels.arc_to_point(pose_at(lps_from_start), as_point(target))
    return ArcPath(
        lps_from_start=lps_from_start,
        arcs=np.array([[length, frames.roll_towards(lps_from_start, normal), curvature]]),
    )


def path_from_tree(lps_from_start: Float, nodes: Float, parents: Int, last: int) -> ArcPath:
    """Return the path from the root of a search tree to its node `last`; see `stages.needle.kernels.tree`."""
    chain = []
    while last != 0:
        chain.append(last)
        last = int(parents[last])
    frame, arcs = np.asarray(lps_from_start), []
    for node in reversed(chain):
        length, curvature = float(nodes[node, tree.ARC_LENGTH]), float(nodes[node, tree.BEND])
        roll = frames.roll_towards(frame, nodes[node, tree.BEND + 1 : tree.BEND + 4])
        arcs.append((length, roll, curvature))
        frame = frame @ arc_transform(length, roll, curvature)
    return ArcPath(lps_from_start=lps_from_start, arcs=np.array(arcs))


def blocker_on_path(
    environment: NeedleEnvironment, path: ArcPath, branch: int, inserted_mm: float = 0.0
) -> int:
    """Prove every arc of a path clear; return 0, or the label of the voxel that is too near.

    `branch` is the pierced one, -1 for none, and `inserted_mm` the length of the needle behind the start.
    """
    obstacles, limits = environment.obstacles, environment.limits
    for pose, bend, length in kernel_arcs(path):
        label = blocker_on_arc(obstacles, limits, pose, bend, length, inserted_mm, branch)
        if label:
            return int(label)
        inserted_mm += length
    return 0


def kernel_arcs(path: ArcPath) -> Iterator[tuple[tuple[float, ...], tuple[float, ...], float]]:
    """Yield each arc as the kernels take it: `pose`, `bend` and length."""
    for frame, (length, roll, curvature) in zip(path.frames(), path.arcs, strict=False):
        yield pose_at(frame), (float(curvature), *as_point(bend_direction(frame, roll))), float(length)


def violation(
    environment: NeedleEnvironment, query: Query, path: ArcPath, *, goal_tolerance_mm: float = 0.0
) -> str:
    """Tell why a path is no answer to a query; "" if it is one.

    All limits of the needle are tested, and every arc is proved clear.  The path may end as far from the
    target as the larger of `goal_tolerance_mm` and the environment's own tolerance.
    """
    needle = environment.needle
    reference = query.lps_from_start[:3, 2] if query.reference is None else query.reference
    lengths, curvatures = path.arcs[:, 0], path.arcs[:, 2]
    tolerance = max(goal_tolerance_mm, environment.goal_tolerance_mm)
    turned = query.turned_rad + path.accumulated_turn_rad
    bent = (curvatures >= 0.0) & (curvatures <= needle.max_curvature_per_mm * (1.0 + SAME_MM))
    # Not a number fails every one of these comparisons.
    tests = {
        "starts elsewhere": np.abs(path.lps_from_start - query.lps_from_start).max() <= SAME_MM,
        "goes backwards": bool((lengths >= 0.0).all()),
        "longer than the needle": query.inserted_mm + path.length_mm <= needle.max_length_mm + SAME_MM,
        "bends too tightly": bool(bent.all()),
        "turns too far in all": turned <= math.radians(needle.max_accumulated_turn_deg) + SAME_RAD,
        "points too far from its direction at the start": path.max_angle_from_start_rad(reference)
        <= math.radians(needle.max_angle_from_start_deg) + SAME_RAD,
        "misses the target": np.linalg.norm(path.frames()[-1][:3, 3] - query.target) <= tolerance + SAME_MM,
    }
    for reason, passed in tests.items():
        if not passed:
            return reason
    label = blocker_on_path(environment, path, query.branch, query.inserted_mm)
    return "" if label == 0 else "too near: " + next(name for name, bit in BITS.items() if label & bit)

"""The three devices of a plan as curves: poses along their axes, in closed form.

Reports and exports use these curves.  The independent check integrates the devices by itself.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import freeze_arrays
from anatomy.poses import poses_on_arc, poses_on_pieces
from lungaccess.plans.parts import NeedlePath, ScopeInsertion, TubeDeployment
from lungaccess.problem.system import System
from stages.scope.device import laid_pieces
from stages.tube.arcs import SHORTEST_ARC_MM, pieces_of_arcs
from stages.tube.device import ConcentricTubes

STEP_MM = 0.25
"""Largest distance between the poses of tubes and needle: the chord of a 40 mm arc is off by 0.2 um."""


SHORTEST_MM = 1e-6
"""Lengths that differ by less are one."""


@frozen_record
class DeviceCurve:
    """Where a device ("scope", "tubes" or "needle") runs; N poses.

    `lps_from_device` `(N, 4, 4)` are poses whose +z points the way the device moves; at each of them
    `radius_mm` `(N,)` is the outer radius, and `arc_length_mm` `(N,)` the length of the device from its first
    pose.  The colour is red, green and blue in [0, 1].
    """

    name: str
    lps_from_device: Float
    radius_mm: Float
    arc_length_mm: Float
    colour: tuple[float, float, float]

    def __post_init__(self) -> None:
        freeze_arrays(self, "lps_from_device", "radius_mm", "arc_length_mm", dtype=np.float64)

    @property
    def points_lps(self) -> Float:
        """Positions, `(N, 3)` LPS mm."""
        return self.lps_from_device[:, :3, 3]


class DeviceCurves(NamedTuple):
    """Scope, tubes and needle of a plan.

    Where there is no needle, its curve has the one pose of the tip of the tubes, and no length.
    """

    scope: DeviceCurve
    tubes: DeviceCurve
    needle: DeviceCurve

    @property
    def present(self) -> tuple[DeviceCurve, ...]:
        """The curves of the devices that there are."""
        return tuple(curve for curve in self if len(curve.arc_length_mm) > 1)


def device_curves(
    scope: ScopeInsertion,
    tube: TubeDeployment,
    needle: NeedlePath | None,
    system: System,
    step_mm: float = STEP_MM,
) -> DeviceCurves:
    """Return the curves of the three devices, poses of tubes and needle at most `step_mm` apart.

    +x is the direction of the bend.  Where two arcs meet, the pose is that at the end of the first, before
    the turn; the last pose of the scope is that of its tip.
    """
    tubes = system.tubes
    laid = laid_pieces(scope.states, system.scope.bending_length_mm)
    # Largest distance between the poses of the scope: the chord of its tightest arcs is off by 0.01 mm.
    scope_poses, scope_mm = poses_on_pieces(scope.lps_from_entry, laid, 1.0)
    tube_poses, tube_mm = poses_on_pieces(scope.lps_from_scope_tip, tube_pieces(tube), step_mm)
    start = tube.lps_from_tip if needle is None else needle.lps_from_start
    needle_poses, needle_mm = poses_on_pieces(start, needle_pieces(needle), step_mm)
    needle_radius_mm = 0.0 if system.needle is None else system.needle.radius_mm
    devices = (
        ("scope", scope_poses, scope_mm, system.scope.radius_mm, (0.12, 0.47, 0.71)),
        ("tubes", tube_poses, tube_mm, tube_radii(tube, tubes, tube_mm), (1.0, 0.5, 0.05)),
        ("needle", needle_poses, needle_mm, needle_radius_mm, (0.1, 0.1, 0.1)),
    )
    return DeviceCurves(
        *(
            DeviceCurve(
                name=name, lps_from_device=poses, radius_mm=np.broadcast_to(radius_mm, len(arc_mm)).copy(),
                arc_length_mm=arc_mm, colour=colour,
            )
            for name, poses, arc_mm, radius_mm, colour in devices
        )
    )  # fmt: skip


def tube_pieces(tube: TubeDeployment) -> Float:
    """Return length in mm, roll before it in rad and curvature in 1/mm `(P, 3)` of each arc of the tubes."""
    return pieces_of_arcs(np.asarray(tube.shape.arcs), tube.rotation_rad)


def tube_radii(tube: TubeDeployment, tubes: ConcentricTubes, arc_mm: Float) -> Float:
    """Return the radius in mm `(N,)` of the outermost tube at arc lengths `(N,)` from the scope tip."""
    return radii_at(tubes, tube.insertions_mm(tubes), arc_mm)


def radii_at(tubes: ConcentricTubes, insertions_mm: Sequence[float], arc_mm: Float) -> Float:
    """Return the same for insertions, the outermost tube first."""
    ends = np.array(insertions_mm) + SHORTEST_MM
    radii = np.array([each.radius_mm for _name, each in tubes.named])
    return np.asarray(radii[np.minimum(np.searchsorted(ends, arc_mm), len(radii) - 1)])


def pieces_beyond(lps_from_start: Float, pieces: Float, begin_mm: float) -> tuple[Float, Float]:
    """Return pose and arcs of what lies beyond an arc length of a row of arcs.

    Args:
        lps_from_start ((4, 4) float64): Where the first arc starts.
        pieces ((P, 3) float64): Length in mm, roll before it in rad, which is kept for the next, and
            curvature in 1/mm of each arc.
        begin_mm: From 0 to less than the length of all arcs.

    Returns:
        (4, 4) float64, (R, 3) float64.
    """
    pose, left_mm = np.asarray(lps_from_start), begin_mm
    for number, (length, roll, curvature) in enumerate(pieces):
        if left_mm < length - SHORTEST_ARC_MM:
            rest = pieces[number:].copy()
            if left_mm > 0.0:
                pose = poses_on_arc(pose, roll, curvature, np.array([left_mm]))[0]
                rest[0, :2] = length - left_mm, 0.0
            return pose, rest
        pose, left_mm = poses_on_arc(pose, roll, curvature, np.array([length]))[0], left_mm - length
    return pose, np.zeros((0, 3))


def needle_pieces(needle: NeedlePath | None) -> Float:
    """Return length in mm, roll before it in rad and curvature in 1/mm `(A, 3)` of each arc of the needle."""
    if needle is None:
        return np.zeros((0, 3))
    arcs = [(arc.length_mm, arc.roll_rad, arc.curvature_per_mm) for arc in needle.arcs]
    return np.array(arcs, dtype=np.float64).reshape(-1, 3)


def arc_lengths(points: Float) -> Float:
    """Return the length in mm `(N,)` along a polyline `(N, 3)` up to each of its points."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))

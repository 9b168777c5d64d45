"""The guide path of a route: the centreline nodes that the search found, with start and goal."""

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from stages.scope.route.centreline import Centreline
from stages.scope.route.curve import DEGREE, Curve, interpolate

WAYPOINT_SPACING_MM = 3.0
"""Denser points give the spline the kinks of a voxel skeleton; sparser ones cut the bends of airways."""


@frozen_record
class GuidePath:
    """P points from start to goal, of which no two neighbours coincide, with the radius of the lumen.

    Parameters
    ----------
    points_mm : (P, 3) float64, LPS mm
    radius_mm : (P,) float64
    """

    points_mm: Float
    radius_mm: Float

    @property
    def along_mm(self) -> Float:
        """Length of the polyline up to each point, `(P,)`."""
        step = np.linalg.norm(np.diff(self.points_mm, axis=0), axis=1)
        return np.concatenate(((0.0,), np.cumsum(step)))

    @property
    def cones(self) -> Float:
        """Round cones along the guide path, `(P - 1, 8)`; they lead, but are no part of the lumen."""
        with_radius = np.column_stack((self.points_mm, self.radius_mm))
        return np.hstack((with_radius[:-1], with_radius[1:]))

    def curve(self, spacing_mm: float = WAYPOINT_SPACING_MM) -> Curve:
        """Return the tentative curve: the cubic B-spline through points of the guide path.

        Parameters
        ----------
        spacing_mm : float
            Distance of the points along the guide path, about; 0 for every point, as in [Li2021].
        """
        along = self.along_mm
        if spacing_mm <= 0.0:
            return interpolate(self.points_mm)
        count = max(round(along[-1] / spacing_mm), DEGREE)
        at = np.linspace(0.0, along[-1], count + 1)
        return interpolate(np.stack([np.interp(at, along, axis) for axis in self.points_mm.T], axis=1))


def guide_path_along(centreline: Centreline, nodes: Int, start_mm: Float, goal_mm: Float) -> GuidePath:
    """Return the guide path over centreline nodes.

    Start and goal take the place of the nodes nearest to them.

    Raises
    ------
    SettingsError
        If start and goal are the same point.
    """
    inner = nodes[1:-1]
    points = np.vstack((start_mm, centreline.nodes_mm[inner], goal_mm))
    radius = np.concatenate(
        (centreline.radius_mm[nodes[:1]], centreline.radius_mm[inner], centreline.radius_mm[nodes[-1:]])
    )
    # Points nearer than this coincide: rounding, far below a voxel.
    apart = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6
    kept = np.concatenate(((True,), apart))
    if kept.sum() < 2:
        raise SettingsError(
            "Start and goal of the route are the same point",
            expected="two points apart",
            remedy="Choose another goal or start",
        )
    if not apart[-1]:
        kept[np.flatnonzero(kept)[-1]] = False
        kept[-1] = True
    return GuidePath(points_mm=read_only(points[kept]), radius_mm=read_only(radius[kept]))

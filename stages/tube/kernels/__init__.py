"""Compiled kernels of the tube stage, and those that the coupled planner calls."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from stages.tube.kernels.deployment import ENTRY_COLUMNS as ENTRY_COLUMNS
    from stages.tube.kernels.deployment import ENTRY_TIP as ENTRY_TIP
    from stages.tube.kernels.deployment import enumerate_site as enumerate_site
    from stages.tube.kernels.deployment import validate_deployment as validate_deployment
    from stages.tube.kernels.planar import CURVED_LENGTH as CURVED_LENGTH
    from stages.tube.kernels.planar import INNER_CURVATURE as INNER_CURVATURE
    from stages.tube.kernels.planar import INNER_RADIUS as INNER_RADIUS
    from stages.tube.kernels.planar import MARGIN as MARGIN
    from stages.tube.kernels.planar import MAX_EXTENSION as MAX_EXTENSION
    from stages.tube.kernels.planar import MAX_PROTRUSION as MAX_PROTRUSION
    from stages.tube.kernels.planar import MAX_SWEEP as MAX_SWEEP
    from stages.tube.kernels.planar import MIN_WALL_ANGLE as MIN_WALL_ANGLE
    from stages.tube.kernels.planar import N_TUBES as N_TUBES
    from stages.tube.kernels.planar import OUTER_RADIUS as OUTER_RADIUS
    from stages.tube.kernels.planar import OVERLAP_CURVATURE as OVERLAP_CURVATURE
    from stages.tube.kernels.planar import lateral_sweep as lateral_sweep
    from stages.tube.kernels.planar import planar_point as planar_point
    from stages.tube.kernels.planar import planar_points as planar_points
    from stages.tube.kernels.planar import tip_pose as tip_pose
    from stages.tube.kernels.wall_exit import ACCEPTED as ACCEPTED
    from stages.tube.kernels.wall_exit import BRANCH as BRANCH
    from stages.tube.kernels.wall_exit import FLAT_EXIT as FLAT_EXIT
    from stages.tube.kernels.wall_exit import LEAVES_MEDIASTINAL as LEAVES_MEDIASTINAL
    from stages.tube.kernels.wall_exit import LEFT_AT as LEFT_AT
    from stages.tube.kernels.wall_exit import N_REASONS as N_REASONS
    from stages.tube.kernels.wall_exit import N_TRACE as N_TRACE
    from stages.tube.kernels.wall_exit import NEAR_FISSURE as NEAR_FISSURE
    from stages.tube.kernels.wall_exit import NEAR_OTHER_BRANCH as NEAR_OTHER_BRANCH
    from stages.tube.kernels.wall_exit import NEAR_PLEURA as NEAR_PLEURA
    from stages.tube.kernels.wall_exit import NEAR_VESSEL as NEAR_VESSEL
    from stages.tube.kernels.wall_exit import NO_EXIT as NO_EXIT
    from stages.tube.kernels.wall_exit import PROTRUDES as PROTRUDES
    from stages.tube.kernels.wall_exit import REENTERS_LUMEN as REENTERS_LUMEN
    from stages.tube.kernels.wall_exit import SWEEPS as SWEEPS
    from stages.tube.kernels.wall_exit import TOO_LONG as TOO_LONG
    from stages.tube.kernels.wall_exit import WALL_ANGLE as WALL_ANGLE
    from stages.tube.kernels.wall_exit import WALL_ZONE_MM as WALL_ZONE_MM
    from stages.tube.kernels.wall_exit import TubeEnvironment as TubeEnvironment
    from stages.tube.kernels.wall_exit import wall_angle as wall_angle

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""Compiled kernels of the tube stage, and those that the coupled planner calls."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from stages.tube.kernels.deployment import ACCEPTED as ACCEPTED
    from stages.tube.kernels.deployment import BRANCH as BRANCH
    from stages.tube.kernels.deployment import CURVED_LENGTH as CURVED_LENGTH
    from stages.tube.kernels.deployment import FLAT_EXIT as FLAT_EXIT
    from stages.tube.kernels.deployment import INNER_CURVATURE as INNER_CURVATURE
    from stages.tube.kernels.deployment import INNER_RADIUS as INNER_RADIUS
    from stages.tube.kernels.deployment import LEAVES_MEDIASTINAL as LEAVES_MEDIASTINAL
    from stages.tube.kernels.deployment import MARGIN as MARGIN
    from stages.tube.kernels.deployment import MAX_EXTENSION as MAX_EXTENSION
    from stages.tube.kernels.deployment import MAX_PROTRUSION as MAX_PROTRUSION
    from stages.tube.kernels.deployment import MAX_SWEEP as MAX_SWEEP
    from stages.tube.kernels.deployment import N_TRACE as N_TRACE
    from stages.tube.kernels.deployment import NEAR_OTHER_BRANCH as NEAR_OTHER_BRANCH
    from stages.tube.kernels.deployment import NO_EXIT as NO_EXIT
    from stages.tube.kernels.deployment import OUTER_RADIUS as OUTER_RADIUS
    from stages.tube.kernels.deployment import OVERLAP_CURVATURE as OVERLAP_CURVATURE
    from stages.tube.kernels.deployment import PROTRUDES as PROTRUDES
    from stages.tube.kernels.deployment import REENTERS_LUMEN as REENTERS_LUMEN
    from stages.tube.kernels.deployment import WALL_ZONE_MM as WALL_ZONE_MM
    from stages.tube.kernels.deployment import deploy as deploy
    from stages.tube.kernels.deployment import lateral_sweep as lateral_sweep
    from stages.tube.kernels.deployment import planar_point as planar_point
    from stages.tube.kernels.deployment import wall_angle as wall_angle

__getattr__, __dir__ = lazy_exports(__name__, __file__)

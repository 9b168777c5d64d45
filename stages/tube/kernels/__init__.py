"""Compiled kernels of the tube stage, and those that the coupled planner calls."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from stages.tube.kernels.aiming import CLOSE_MM, aim_shape
    from stages.tube.kernels.one_shape import (
        DesignArrays,
        ManyShapes,
        ShapeArrays,
        near_shape,
        required_beside,
        take_member,
        take_over,
        whole_way,
    )
    from stages.tube.kernels.placing import tip_of_arcs, validate_arcs
    from stages.tube.kernels.planar import (
        CURVED_LENGTH,
        INNER_CURVATURE,
        INNER_RADIUS,
        INSERTION_STEP_MM,
        MARGIN,
        MAX_EXTENSION,
        MAX_PROTRUSION,
        MAX_SWEEP,
        MAX_WALL_RUN,
        MIN_WALL_ANGLE,
        N_TUBES,
        OUTER_RADIUS,
        OVERLAP_CURVATURE,
        SWEEP_SAMPLES,
        greatest_insertions,
        insertions_exist,
        lateral_sweep,
        off_track,
        planar_point,
        sweep_slope,
    )
    from stages.tube.kernels.shapes import (
        ARC_COLUMNS,
        DIRECTION,
        LENGTH,
        RADIUS,
        SWEEP,
        bend_towards,
        carried,
    )
    from stages.tube.kernels.wall_exit import (
        ACCEPTED,
        BRANCH,
        CORNER_MM,
        FINE_STEP_MM,
        FLAT_EXIT,
        LEAVES_MEDIASTINAL,
        LEFT_AT,
        LONG_WALL_RUN,
        LOOK_MM,
        N_REASONS,
        N_TRACE,
        NEAR_FISSURE,
        NEAR_OTHER_BRANCH,
        NEAR_PLEURA,
        NEAR_VESSEL,
        NO_EXIT,
        REENTERS_LUMEN,
        RUN_STEP_MM,
        UNNOTICED_MM,
        WALL_ANGLE,
        WALL_RUN,
        WALL_ZONE_MM,
        TubeEnvironment,
        refused_exits,
        wall_angle,
    )

__getattr__, __dir__ = lazy_exports(__name__, __file__)

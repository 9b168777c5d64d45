"""Single deployments of any joint values, proved by the way to them, and as arrays that a search changes."""

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Int
from stages.tube.arcs import TubeShape
from stages.tube.device import ConcentricTubes
from stages.tube.kernels import one_shape as kernel
from stages.tube.kernels import shapes as columns
from stages.tube.kernels.one_shape import DesignArrays, ManyShapes, ShapeArrays
from stages.tube.mechanics import TubeMechanics
from stages.tube.sequences import BEND_RAD
from stages.tube.shapes import TubeShapes, strained_radii

WAY_STEP_MM = 2.0
"""Insertion between two looks at the tubes on their way: as in the shapes of two tubes."""

NO_SHAPES = ManyShapes(
    joints=np.zeros((0, 0)),
    tips=np.zeros((0, 0)),
    results=np.zeros((0, columns.SHAPE_COLUMNS)),
    arcs=np.zeros((0, columns.ARC_COLUMNS)),
    first_arc=np.zeros(1, dtype=np.int64),
)
"""Planar tubes have a closed form instead."""


def design_arrays(tubes: ConcentricTubes) -> DesignArrays | None:
    """Return a design and its limits for the kernels; None for planar tubes, which have a closed form.

    A kernel that takes None is compiled without the mechanics that only other tubes need.
    """
    if tubes.planar:
        return None
    mechanics = TubeMechanics(tubes.nested)
    limits = np.zeros(kernel.N_LIMITS)
    limits[kernel.STEP], limits[kernel.STOP] = mechanics.step_rad, WAY_STEP_MM
    limits[kernel.BEND], limits[kernel.MAX_EXTENSION] = BEND_RAD, tubes.max_extension_mm
    limits[kernel.MAX_SWEEP], limits[kernel.MAX_STRAIN] = tubes.max_lateral_sweep_mm, tubes.max_strain
    bent = np.array([bool(tube.bends) for tube in tubes.nested])
    return DesignArrays(
        *mechanics.design,
        radii=np.array([tube.radius_mm for tube in tubes.nested]),
        strained=strained_radii(tubes.nested, tubes.max_extension_mm),
        turned=bent & (np.cumsum(bent) > 1),
        limits=limits,
    )


def with_any_sweep(design: DesignArrays) -> DesignArrays:
    """Return a design whose tubes may sweep sideways as far as they like."""
    limits = design.limits.copy()
    limits[kernel.MAX_SWEEP] = np.inf
    return design._replace(limits=limits)


def shape_arrays(design: DesignArrays | None) -> ShapeArrays:
    """Return arrays with room for any shape of a design; without room for planar tubes."""
    n = 0 if design is None else len(design.lengths)
    room = 0 if design is None else columns.MOST_ARCS * (1 + n + 2 * len(design.bends))
    return ShapeArrays(
        joints=np.zeros(2 * n),
        tips=np.zeros(n),
        result=np.zeros(columns.SHAPE_COLUMNS),
        arcs=np.zeros((room, columns.ARC_COLUMNS)),
        number=np.zeros(1, dtype=np.int64),
    )


def many_shapes(shapes: TubeShapes, members: Int) -> ManyShapes:
    """Return some shapes `(M,)` of a design for the kernels."""
    results = np.zeros((len(members), columns.SHAPE_COLUMNS))
    for column, values in (
        (columns.LEAST, shapes.least_determinant),
        (columns.STRAIN, shapes.strain),
        (columns.SWEEP, shapes.lateral_sweep_mm),
        (columns.LEADER, shapes.follow_the_leader_error_mm),
        (columns.ERROR, shapes.arc_error_mm),
    ):
        results[:, column] = values[members]
    chosen = shapes.subset(members)
    return ManyShapes(
        joints=np.hstack([chosen.insertions_mm, chosen.rotations_rad]),
        tips=np.array(chosen.tip_angles_rad),
        results=results,
        arcs=np.array(chosen.arcs),
        first_arc=np.array(chosen.first_arc),
    )


def copies(shape: ShapeArrays, count: int) -> ManyShapes:
    """Return the same shape so many times."""
    arcs = shape.arcs[: shape.number[0]]
    return ManyShapes(
        joints=np.tile(shape.joints, (count, 1)),
        tips=np.tile(shape.tips, (count, 1)),
        results=np.tile(shape.result, (count, 1)),
        arcs=np.tile(arcs, (count, 1)),
        first_arc=len(arcs) * np.arange(count + 1),
    )


def deployed(design: DesignArrays, insertions_mm: ArrayLike, rotations_rad: ArrayLike) -> ShapeArrays | None:
    """Return the shape of joint values, None if the tubes snap or a limit of the design is not kept.

    Parameters
    ----------
    insertions_mm, rotations_rad : (n,) float64
        See `TubeShape`.
    """
    shape = shape_arrays(design)
    shape.joints[:] = np.concatenate([np.asarray(insertions_mm), np.asarray(rotations_rad)])
    return shape if kernel.whole_way(design, shape) else None


def shape_of_arrays(shape: ShapeArrays) -> TubeShape:
    """Return a shape that `deployed` or a search has proved, as a record."""
    n, result = len(shape.tips), shape.result
    return TubeShape(
        insertions_mm=shape.joints[:n].copy(),
        rotations_rad=shape.joints[n:].copy(),
        arcs=shape.arcs[: shape.number[0]].copy(),
        lateral_sweep_mm=float(result[columns.SWEEP]),
        follow_the_leader_error_mm=float(result[columns.LEADER]),
        arc_error_mm=float(result[columns.ERROR]),
        least_determinant=float(result[columns.LEAST]),
    )

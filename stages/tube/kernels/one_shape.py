"""One deployment of any joint values: its shape alone from one nearby, or with the whole way to it.

Joints `(2 n,)` are the insertions in mm, then the rotations of the rear ends in rad, both the innermost tube
first.
"""

import math
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Bool, Float, Int
from anatomy.kernels.compiling import inner_kernel, kernel, merged_kernel
from stages.tube.kernels.assembly import SHORTEST_PIECE_MM as SAME_MM
from stages.tube.kernels.planar import lateral_sweep
from stages.tube.kernels.pose import frames_at, lay
from stages.tube.kernels.shapes import (
    CURVATURE,
    ERROR,
    EXTENSION,
    LEADER,
    LEAST,
    MOST_ARCS,
    STRAIN,
    SWEEP,
    TIP,
    arcs_near,
    largest_strain,
    lay_out,
    lay_untwisted,
    reach,
    rear_ends,
    strain_at_rest,
    twists,
)
from stages.tube.kernels.sweep import sweep_of

STEP, STOP, BEND, MAX_EXTENSION, MAX_SWEEP, MAX_STRAIN, N_LIMITS = range(7)
"""Places of the limits: the step of `assembly.cut`, the insertion of a step of the way, the rotation of a
rear end at which the tube bends towards +x of the scope tip, and what is kept."""


class DesignArrays(NamedTuple):
    """A design of n tubes for the kernels, the innermost first.

    Args:
        stiffness, lengths, bends: See `assembly`; a body after the tubes is a straight needle, whose tip is
            that of the innermost tube.
        radii, strained ((n,) float64): See `shapes.follow_all`.
        turned ((n,) bool): Whether the shape changes as the tube is turned against the others.
        limits: (N_LIMITS,) float64.
        planar ((N_TUBES,) float64): The numbers of `planar` where the tubes are: exact sweep; else empty.
    """

    stiffness: Float
    lengths: Float
    bends: Float
    radii: Float
    strained: Float
    turned: Bool
    limits: Float
    planar: Float


class ShapeArrays(NamedTuple):
    """One deployment for the kernels, to be filled by them: joints (2 n,), result (SHAPE_COLUMNS,), arcs.

    `tips` (n,) are angles at the tubes' own ends; `number` (1,) tells how many rows of the arcs are in use.
    """

    joints: Float
    tips: Float
    result: Float
    arcs: Float
    number: Int


class ManyShapes(NamedTuple):
    """S proved deployments for the kernels.

    Args:
        joints, tips, results: (S, 2 n), (S, n), (S, SHAPE_COLUMNS) float64.
        arcs: (A, ARC_COLUMNS) float64.
        first_arc ((S + 1,) int64): Where the arcs of each begin.
    """

    joints: Float
    tips: Float
    results: Float
    arcs: Float
    first_arc: Int


@inner_kernel
def in_order(design, joints):
    """Tell whether tubes and their rear ends are in order and none is too far out."""
    n, lengths = design.radii.shape[0], design.lengths
    for i in range(n):
        if joints[i] < 0.0 or joints[i] > min(lengths[i], design.limits[MAX_EXTENSION]):
            return False
        if i > 0:
            if joints[i] > joints[i - 1] + SAME_MM:
                return False
            if joints[i] - lengths[i] < joints[i - 1] - lengths[i - 1] - SAME_MM:
                return False
    return joints[0] > 0.0


@inner_kernel
def near_shape(design, near, shape):
    """Fill tips, error and arcs of `shape` at joints near another; tell if there is one, limits aside."""
    n = design.radii.shape[0]
    if not in_order(design, shape.joints):
        return False
    if not twists(design.bends):
        _fill_untwisted(design, shape)
        return True
    shape.tips[:] = near.tips
    shape.number[0] = arcs_near(
        (design.stiffness, design.lengths, design.bends), design.radii, near.joints[n:] + design.limits[BEND],
        rear_ends(design.lengths, near.joints[:n]), shape.joints[n:] - near.joints[n:],
        rear_ends(design.lengths, shape.joints[:n]), design.limits[STEP], shape.tips, shape.result,
        shape.arcs,
    )  # fmt: skip
    return shape.number[0] > 0


@inner_kernel
def _fill_untwisted(design, shape):
    """Fill a shape of tubes that do not twist each other at its joints, but for its sweep."""
    n, result = design.radii.shape[0], shape.result
    arrays = design.stiffness, design.lengths, design.bends
    shape.tips[:] = shape.joints[n:] + design.limits[BEND]
    result[LEAST], result[STRAIN] = 1.0, strain_at_rest(design.bends, design.strained)
    shape.number[0] = lay_untwisted(
        arrays, design.radii, design.strained, shape.tips, rear_ends(design.lengths, shape.joints[:n]),
        design.limits[STEP], result, shape.arcs,
    )  # fmt: skip


@kernel(nogil=True)
def whole_way(design, shape):
    """Fill `shape` at its joints by the sequence `together`; tell whether it keeps all limits of the design.

    The innermost tube goes out by steps of STOP or a little less; the others stop on the way.
    """
    shape.number[0] = 0
    joints, result, lengths = shape.joints, shape.result, design.lengths
    if not in_order(design, joints):
        return False
    n = design.radii.shape[0]
    arrays = design.stiffness, lengths, design.bends
    if design.planar.shape[0] > 0:
        _fill_untwisted(design, shape)
        result[SWEEP] = result[LEADER] = lateral_sweep(design.planar, joints[n - 1], joints[0])
        return result[STRAIN] <= design.limits[MAX_STRAIN] and result[SWEEP] <= design.limits[MAX_SWEEP]
    base, still = joints[n:] + design.limits[BEND], np.zeros(n)
    steps_out = max(int(math.ceil(joints[0] / design.limits[STOP] - SAME_MM)), 1)
    spacing = joints[0] / steps_out
    stops = np.linspace(0.0, joints[0], steps_out + 1)
    states = np.arange(steps_out + 1).reshape(-1, 1)
    bodies = np.zeros((steps_out + 1, steps_out + 1, 3))
    found, angles, rates = np.zeros((len(stops), 12)), np.zeros((len(stops), n)), np.zeros((len(stops), n))
    places = np.zeros((2 * MOST_ARCS * (1 + lengths.shape[0] + 2 * design.bends.shape[0]), 4))
    scratch = np.zeros((places.shape[0], 12)), np.zeros((places.shape[0], n)), np.zeros((places.shape[0], n))
    shape.tips[:] = base
    result[:] = 0.0
    result[LEAST], result[EXTENSION] = 1.0, joints[0]
    result[STRAIN] = strain_at_rest(design.bends, design.strained)
    begin = rear_ends(lengths, still)
    for k in range(1, steps_out + 1):
        end = rear_ends(lengths, np.minimum(stops[k], joints[:n]))
        least, cutting, nodes, steps = reach(arrays, base, still, begin, end, design.limits[STEP], shape.tips)
        result[LEAST] = min(result[LEAST], least)
        if least <= 0.0:
            return False
        poses = np.zeros((steps[0].shape[0] + 1, 12))
        lay(cutting, nodes, steps, poses)
        frames_at(cutting, nodes, steps, poses, stops[: k + 1], found, angles, rates)
        bodies[k, : k + 1] = found[: k + 1, 9:]
        strain = largest_strain(arrays, design.strained, end, cutting, nodes, steps)
        result[STRAIN] = max(result[STRAIN], strain)
        if result[STRAIN] > design.limits[MAX_STRAIN]:
            return False
        begin = end
        if k < steps_out:
            continue
        result[TIP:] = poses[-1]
        shape.number[0], result[ERROR] = lay_out(
            arrays, design.radii, end, cutting, nodes, steps, poses, shape.arcs, 0, places, scratch
        )
    sagitta = shape.arcs[: shape.number[0], CURVATURE].max() * spacing**2 / 8.0
    parents = np.arange(steps_out + 1) - 1
    result[SWEEP], result[LEADER] = sweep_of(bodies, states, parents, steps_out, sagitta)
    return result[SWEEP] <= design.limits[MAX_SWEEP]


@merged_kernel
def required_beside(shape):
    """Return what has to be free around a shape beside its radius and the margins, mm."""
    return shape.result[SWEEP] + shape.result[ERROR]


@inner_kernel
def take_over(one, other):
    """Copy one shape into the arrays of another."""
    one.joints[:] = other.joints
    one.tips[:] = other.tips
    one.result[:] = other.result
    one.number[0] = other.number[0]
    one.arcs[: other.number[0]] = other.arcs[: other.number[0]]


@inner_kernel
def take_member(one, shapes, member):
    """Copy one of many shapes into the arrays of a shape."""
    one.joints[:] = shapes.joints[member]
    one.tips[:] = shapes.tips[member]
    one.result[:] = shapes.results[member]
    first, end = shapes.first_arc[member], shapes.first_arc[member + 1]
    one.number[0] = end - first
    one.arcs[: end - first] = shapes.arcs[first:end]

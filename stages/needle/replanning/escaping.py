"""Where to plan from: the tip, or where a tip that has lost its clearance gets it back."""

import math
from collections.abc import Iterator
from dataclasses import replace

from anatomy.kernels.arcs import pose_on_arc
from anatomy.kernels.field import EXACT_REACH_MM, exact_distance
from anatomy.structures import BITS, LUMEN
from stages.needle.environment import NeedleEnvironment
from stages.needle.kernels.cost import ObjectiveArrays
from stages.needle.kernels.proof import blocker_on_arc
from stages.needle.path import Query, bend_direction
from stages.needle.replanning.reaiming import Attempts, Bend, Root, Source, as_point, pose_at, root_after

ROLLS = 8
STEP_MM = 0.25
"""Lengths of the arcs that are tried differ by this: half a voxel."""


def structure_name(label: int) -> str:
    """Return the name of the first obstacle that a voxel label stands for."""
    return next((name for name, bit in BITS.items() if label & bit), "nothing")


def with_limits(environment: NeedleEnvironment, **limits: float) -> NeedleEnvironment:
    """Return an environment with other limits, by the names of `stages.needle.kernels.proof.Limits`."""
    return replace(environment, limits=environment.limits._replace(**limits))


def blocker_at(
    environment: NeedleEnvironment, pose: tuple[float, ...], inserted_mm: float, branch: int
) -> int:
    """Return the label of what a point of the needle is too near to, 0 if it is clear.

    Args:
        pose ((6,) floats): See `anatomy.kernels.arcs`.
        inserted_mm: Length of needle up to the point, for the exemption at the exit.
        branch: Pierced branch; -1 for none.
    """
    straight = (0.0, 1.0, 0.0, 0.0)
    return int(
        blocker_on_arc(environment.obstacles, environment.limits, pose, straight, 0.0, inserted_mm, branch)
    )


def tip_clearance(environment: NeedleEnvironment, query: Query) -> tuple[float, int]:
    """Return the exact distance in mm from a query's start to what it has to keep clear of, and its label.

    Beyond the required clearance and a little more it is not measured.
    """
    _clearance, labels, geometry, bits = environment.obstacles
    reach = environment.required_clearance_mm + EXACT_REACH_MM
    point = as_point(query.lps_from_start[:3, 3])
    in_exit = query.branch >= 0 and query.inserted_mm < environment.limits.exempt_mm
    spared = query.branch if in_exit else -1
    distance, label = exact_distance(labels, geometry, *point, bits, spared, reach)
    if in_exit:
        lumen, lumen_label = exact_distance(labels, geometry, *point, LUMEN, -1, reach)
        if lumen < min(distance, environment.needle.radius_mm):
            distance, label = lumen, lumen_label
    return float(distance), int(label)


def roots_of_tip(
    environment: NeedleEnvironment, objective: ObjectiveArrays, query: Query, longest_mm: float
) -> tuple[list[Root], float]:
    """Return where to plan from, the nearest first, and the clearance proved on the way there.

    That is the tip itself.  Where the tip has lost the required clearance, it is the ends of short arcs that
    lead back to it; on them the axis comes no nearer to an obstacle than the tip is, but for a little
    slack, and never nearer than the needle's radius.

    Args:
        query: From the tip.
        longest_mm: Longest arc.
    """
    required = environment.required_clearance_mm
    pose = pose_at(query.lps_from_start)
    if not blocker_at(environment, pose, query.inserted_mm, query.branch):
        return [Root(query=query)], required
    clearance, _label = tip_clearance(environment, query)
    # An arc that leads away from an obstacle may come nearer by 0.1 mm first: bending takes a while.
    relaxed = min(max(environment.needle.radius_mm, clearance - 0.1), required)
    near = with_limits(environment, required_mm=relaxed)
    roots = []
    for bend in _bends(environment, query):
        length = _length_to_clearance(environment, query, pose, bend, longest_mm)
        attempts = Attempts(near, objective, Root(query=query))
        if length > 0.0:
            attempts.by_arc(bend, length, Source.REJOIN)
        if attempts.path is not None:
            roots.append(root_after(query, attempts.path, attempts.cost))
    return sorted(roots, key=lambda root: root.away_mm), relaxed


def _bends(environment: NeedleEnvironment, query: Query) -> Iterator[Bend]:
    """Yield straight on, and the tightest arcs to all sides."""
    for n in range(ROLLS):
        side = as_point(bend_direction(query.lps_from_start, 2.0 * math.pi * n / ROLLS))
        if n == 0:
            yield 0.0, *side
        yield environment.limits.kappa, *side


def _length_to_clearance(
    environment: NeedleEnvironment, query: Query, pose: tuple[float, ...], bend: Bend, longest_mm: float
) -> float:
    """Return the length of an arc after which the required clearance is regained, 0 if never."""
    for n in range(1, int(longest_mm / STEP_MM) + 1):
        s = n * STEP_MM
        if not blocker_at(environment, pose_on_arc(pose, bend, s), query.inserted_mm + s, query.branch):
            return s
    return 0.0

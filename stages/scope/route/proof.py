"""The limits of a route, the proof that a whole curve keeps to them, and what [Li2021] measures of it."""

from typing import Annotated

import numpy as np

from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from stages.scope.route.centreline import Centreline
from stages.scope.route.curve import Curve
from stages.scope.route.kernels import spline as kernel


@settings
class RouteLimits:
    """What the device can follow, S of [Li2021] as curvature; a tolerance of 0 makes the ends exact."""

    max_curvature_per_mm: Annotated[float, quantity("largest curvature", above=0.0, at_most=10.0)]
    device_radius_mm: Annotated[float, quantity("radius of the device", at_least=0.0, at_most=10.0)] = 0.0
    wall_margin_mm: Annotated[float, quantity("gap from device to wall", at_least=0.0, at_most=10.0)] = 0.0
    end_tolerance_mm: Annotated[
        float, quantity("distance of the ends from the wanted points", at_least=0.0, at_most=10.0)
    ] = 0.0

    @property
    def needed_mm(self) -> float:
        """Depth in the lumen that every point of the route must have."""
        return self.device_radius_mm + self.wall_margin_mm


REASONS = {
    kernel.BENDS: "too curved",
    kernel.LEAVES: "too near the wall",
    kernel.UNDECIDED: "at its limit, undecided",
}


@frozen_record
class Proof:
    """What was proved of a curve with M spans.

    Args:
        verdicts ((M,) int64): 0 where all of a span keeps both limits; 1, too curved; 2, too near the wall;
            3, undecided.
        points_mm ((M, 3) float64): A point that breaks a limit, for the spans where there is one.
        curvature_bound_per_mm, depth_bound_mm: No point of the proved spans is more curved, or less deep in
            the lumen.  Not sharp.
    """

    verdicts: Int
    points_mm: Float
    curvature_bound_per_mm: float
    depth_bound_mm: float

    @property
    def holds(self) -> bool:
        """Whether every span is proved."""
        return not self.verdicts.any()

    @property
    def failed_spans(self) -> Int:
        """Spans that are not proved."""
        return np.flatnonzero(self.verdicts)

    def reasons(self) -> dict[str, int]:
        """Count the spans that are not proved by their reason."""
        found = np.bincount(self.verdicts, minlength=4).tolist()
        return {text: found[verdict] for verdict, text in REASONS.items() if found[verdict]}


def prove(curve: Curve, centreline: Centreline, max_curvature_per_mm: float, needed_mm: float) -> Proof:
    """Prove, or disprove, that a curve keeps its curvature limit and is `needed_mm` deep in the lumen.

    Each span is a Bezier cubic, halved until bounds decide: the convex hull of the derivative's points bounds
    its norm from below, that of the cross product from above, and the depth in the lumen cannot change by
    more than the distance.  A span that is not decided after ten halvings counts as failed.
    """
    verdicts = np.zeros(curve.n_spans, dtype=np.int64)
    points = np.zeros((curve.n_spans, 3))
    bounds = np.array((0.0, np.inf))
    kernel.prove_spans(
        curve.control_mm, curve.knots, centreline.cones, *centreline.cells, float(max_curvature_per_mm),
        float(needed_mm), verdicts, points, bounds,
    )  # fmt: skip
    return Proof(
        verdicts=read_only(verdicts),
        points_mm=read_only(points),
        curvature_bound_per_mm=float(bounds[0]),
        depth_bound_mm=float(bounds[1]),
    )


PER_SPAN = 16
"""Samples a span: about 0.2 mm apart, where curvature hardly changes between two."""


@frozen_value
class RouteMetrics:
    """Numbers from a curve's dense samples: curvature, wall distance (negative outside), length ratio."""

    normalised_length: float
    mean_curvature_per_mm: float
    largest_curvature_per_mm: float
    mean_wall_mm: float
    least_wall_mm: float


def measure(curve: Curve, centreline: Centreline) -> RouteMetrics:
    """Measure a curve at `PER_SPAN` samples a span [Li2021]."""
    parameters = curve.parameters(PER_SPAN)
    points = curve.at(parameters)[0]
    curvature = curve.curvature_per_mm(parameters)
    wall = centreline.depth_mm(points)
    return RouteMetrics(
        normalised_length=curve.length_mm(PER_SPAN) / float(np.linalg.norm(points[-1] - points[0])),
        mean_curvature_per_mm=float(curvature.mean()),
        largest_curvature_per_mm=float(curvature.max()),
        mean_wall_mm=float(wall.mean()),
        least_wall_mm=float(wall.min()),
    )

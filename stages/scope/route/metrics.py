"""What [Li2021] measures of a route."""

from __future__ import annotations

import numpy as np

from anatomy.base.records import frozen_value
from stages.scope.route.centreline import Centreline
from stages.scope.route.curve import Curve

PER_SPAN = 16
"""Samples a span: about 0.2 mm apart, where curvature hardly changes between two."""


@frozen_value
class RouteMetrics:
    """Numbers of a curve, from dense samples: curvature, and distance to the wall, which is negative outside.

    `normalised_length` is the length over the distance between the ends.
    """

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
    chord = float(np.linalg.norm(points[-1] - points[0]))
    return RouteMetrics(
        normalised_length=curve.length_mm(PER_SPAN) / chord,
        mean_curvature_per_mm=float(curvature.mean()),
        largest_curvature_per_mm=float(curvature.max()),
        mean_wall_mm=float(wall.mean()),
        least_wall_mm=float(wall.min()),
    )

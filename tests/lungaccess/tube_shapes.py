"""Shapes of tubes as a plan states them, from the closed form of a single bend."""

from __future__ import annotations

import numpy as np

from lungaccess.plans.parts import DeployedShape
from stages.tube import ConcentricTubes
from tests.stages.tube.closed_form import pieces


def stated_shape(tubes: ConcentricTubes, outer_mm: float, inner_mm: float) -> DeployedShape:
    """Return the shape of tubes that are not turned against each other."""
    arcs = [
        (end - begin, 0.0, kappa, radius) for begin, end, kappa, radius in pieces(tubes, outer_mm, inner_mm)
    ]
    return DeployedShape(
        relative_rotations_rad={name: 0.0 for name, _tube in tubes.named},
        arcs=np.array(arcs),
        arc_error_mm=0.0,
        least_determinant=1.0,
    )

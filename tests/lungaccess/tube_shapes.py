"""Shapes of tubes as a plan states them, from the closed form of a single bend."""

from __future__ import annotations

from typing import Any

import numpy as np

from lungaccess.plans.parts import DeployedShape
from lungaccess.problem.system import System
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


def shared_curvatures(system: System) -> tuple[float, float]:
    """Return the curvature of the inner tube's bend ahead of the outer one and in it, 1/mm.

    Those that lie in each other share it by their stiffness, a needle that is deployed with them, too.
    """
    tubes, needle = system.tubes, system.needle
    inner, *around = (_stiffness(tube, tube.outer_diameter_mm) for tube in tubes.nested)
    outer = sum(around)
    carried = needle is not None and system.needle_preloaded
    within = _stiffness(needle, needle.diameter_mm) if carried else 0.0
    kappa = tubes.inner.precurvature_per_mm
    return kappa * (inner / (inner + within)), kappa * (inner / (inner + within + outer))


def _stiffness(shaft: Any, diameter_mm: float) -> float:
    """Return the bending stiffness of the foremost part of a shaft, up to a factor that all share."""
    slots = shaft.slotted_segments
    factor = slots[0].stiffness_factor if slots else 1.0
    return float(factor * shaft.youngs_modulus_gpa * (diameter_mm**4 - shaft.inner_diameter_mm**4))

"""Tubes that bend towards a flat airway wall."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.poses import pose
from stages.tube import Deployment, DeploymentValidator, kernels, tube_constants
from stages.tube.device import ConcentricTubes, Tube
from tests.stages.scenes import Canvas, forked_tree

KAPPA = 0.025
CURVED = 40.0


def tubes_of(**changes: float) -> ConcentricTubes:
    """An outer tube of 1.6 mm, an inner one of 1.2 mm with 40 mm of 40 mm radius, any run in the wall."""
    changes.setdefault("max_wall_run_mm", 100.0)
    curved = changes.pop("curved_length_mm", CURVED)
    length = changes.pop("inner_length_mm", 680.0)
    kappa = changes.pop("kappa", KAPPA)
    outer = Tube(outer_diameter_mm=1.6, inner_diameter_mm=1.38, length_mm=640.0)
    inner = Tube(
        outer_diameter_mm=1.2, inner_diameter_mm=1.05, length_mm=length, curved_length_mm=curved,
        precurvature_per_mm=kappa,
    )  # fmt: skip
    return ConcentricTubes(outer=outer, inner=inner, **changes)


TUBES = tubes_of()
NUMBERS = tube_constants(TUBES, Margins())
OVERLAP = float(NUMBERS[kernels.OVERLAP_CURVATURE])
MARGIN = 0.5
LOW, HIGH, SPACING = np.array([-12.0, -10.0, -20.0]), np.array([14.0, 10.0, 20.0]), 0.5
BASE = (-3.0, 0.0, -15.0)


def plane_canvas(wall_mm: float = 1.0, spacing: Any = SPACING) -> Canvas:
    """A lumen below x = 0 with a flat wall above."""
    canvas = Canvas.empty(LOW, HIGH, spacing)
    x = canvas.points[..., 0]
    canvas.airway(x < 0, x < wall_mm, 0)
    return canvas


def validated(
    lung: Lung, outer: float = 0.0, inner: float = 30.0, *, base: Any = BASE, tubes: ConcentricTubes = TUBES,
    rotation: float = 0.0, with_fissures: bool = False, forward: Any = (0.0, 0.0, 1.0),
) -> Deployment | str:  # fmt: skip
    """Validate a deployment that bends towards +x."""
    validator = DeploymentValidator(
        lung, tubes, Margins(segmentation_margin_mm=MARGIN), with_fissures=with_fissures
    )
    tip = pose(base, forward, (1.0, 0.0, 0.0))
    return validator.validate(tip, rotation, [outer, inner])


CHAIN = forked_tree(
    [([0, 0, 9], [0, 0, 6], 8.0, -1), ([0, 0, 6], [0, 0, 3], 5.0, 0), ([0, 0, 3], [0, 0, 0], 3.0, 1)]
)
"""Trachea, main bronchus, lobar bronchus: the last may be left."""


def accepted(verdict: Deployment | str) -> Deployment:
    assert isinstance(verdict, Deployment), verdict
    return verdict


def arc_to_wall(depth: float, kappa: float = KAPPA) -> float:
    """Length of an arc that starts along a wall `depth` away and ends at it."""
    return math.acos(1 - kappa * depth) / kappa


def tip_of(outer: float, inner: float, base: Any, rotation: float) -> Float:
    aside, ahead = kernels.planar_point(NUMBERS, outer, inner, inner)
    return np.array(base) + [aside * math.cos(rotation), aside * math.sin(rotation), ahead]


REFUSALS = {
    "vessel": "the tube comes too near a vessel",
    "pleura": "the tube comes too near the pleura or leaves the lung",
    "fissure": "the tube comes too near a fissure",
    "branch": "the tube comes too near another airway",
    "again": "the tube enters an airway again",
    "flat": "the tube meets the airway wall at too flat an angle",
    "wall": "the tube runs too far in the wall of the airway that it leaves",
    "none": "the tube does not leave the airway",
    "long": "the tube would extend too far",
    "short": "the inner tube is too short to protrude so far",
    "sweep": "the tubes would sweep tissue sideways",
}

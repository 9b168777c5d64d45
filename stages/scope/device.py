"""What the planner has to know of a bronchoscope."""

import math
from dataclasses import field
from typing import Annotated

import numpy as np

from anatomy.base.records import LEFT_OUT_IF_EMPTY
from anatomy.base.settings import impossible, quantity, settings, text
from anatomy.base.typed import Float

SHORTEST_MM = 1e-9
"""A shorter advance is rounding."""


@settings
class Bronchoscope:
    """A flexible bronchoscope with one working channel, which is thinner than the scope.

    Its tip is a bending section, an arc of one curvature; behind it the shaft lies where the section led it.
    """

    name: Annotated[str, text("model of the bronchoscope")]
    outer_diameter_mm: Annotated[
        float, quantity("largest diameter of the part that enters the airways", above=0.0, at_most=20.0)
    ]
    channel_diameter_mm: Annotated[
        float, quantity("inner diameter of the working channel", above=0.0, at_most=10.0)
    ]
    lumen_margin_mm: Annotated[
        float, quantity("gap between scope and airway lumen on every side", at_least=0.0, at_most=10.0)
    ] = 0.0
    bend_up_deg: Annotated[float, quantity("largest upward bending of the tip", at_least=0.0, at_most=270.0)]
    bend_down_deg: Annotated[
        float, quantity("largest downward bending of the tip", at_least=0.0, at_most=270.0)
    ]
    bending_length_mm: Annotated[float, quantity("length of the bending section", above=0.0, at_most=100.0)]
    min_bending_radius_mm: Annotated[
        float, quantity("radius of the tightest arc of the bending section", above=0.0, at_most=1000.0)
    ]
    min_shaft_radius_mm: Annotated[
        float, quantity("radius of the tightest arc in which the shaft may lie", above=0.0, at_most=1000.0)
    ]
    bending_stiffness_n_mm2: Annotated[
        float, quantity("bending stiffness of the bending section", above=0.0, at_most=1e7)
    ]
    rigid_head_mm: Annotated[
        float,
        quantity("length of the camera head, which ends the section unbent", at_least=0.0, at_most=50.0),
    ] = field(default=0.0, metadata={LEFT_OUT_IF_EMPTY: True})

    def __post_init__(self) -> None:
        if self.rigid_head_mm >= self.bending_length_mm:
            allowed = f"less than bending_length_mm = {self.bending_length_mm:g}, of which it is a part"
            raise impossible("rigid_head_mm", self.rigid_head_mm, allowed)
        if self.channel_diameter_mm >= self.outer_diameter_mm:
            allowed = f"less than outer_diameter_mm = {self.outer_diameter_mm:g}"
            raise impossible("channel_diameter_mm", self.channel_diameter_mm, allowed)
        for name in ("min_bending_radius_mm", "min_shaft_radius_mm"):
            if getattr(self, name) <= self.radius_mm:
                wide = f"more than half of outer_diameter_mm, {self.radius_mm:g}: no scope bends into itself"
                raise impossible(name, getattr(self, name), wide)

    @property
    def radius_mm(self) -> float:
        """Outer radius, mm."""
        return 0.5 * self.outer_diameter_mm

    @property
    def bends_rad(self) -> tuple[float, float]:
        """Bend of the whole section farthest down (0 or negative) and farthest up, rad.

        The angle of the data sheet ends a bend, or the least radius where that is met first.
        """
        tightest = self.bending_length_mm / self.min_bending_radius_mm
        return -min(math.radians(self.bend_down_deg), tightest), min(math.radians(self.bend_up_deg), tightest)

    @property
    def laying_curvature_per_mm(self) -> float:
        """Largest curvature with which the section may advance, for the shaft then lies in it."""
        return 1.0 / max(self.min_bending_radius_mm, self.min_shaft_radius_mm)


def laid_pieces(states: Float, bending_length_mm: float) -> Float:
    """Return length in mm, roll before it in rad and curvature in 1/mm `(P, 3)` of each arc of a body.

    The section lays the shaft where it advances; the section itself is the last arc.  States `(M, 3)` are
    those of a `stages.scope.ScopeMotion`.
    """
    advance, twist, bend = states.T
    moved = np.flatnonzero(np.diff(advance) > SHORTEST_MM) + 1
    length = np.append(np.diff(advance)[moved - 1], bending_length_mm)
    which = np.append(moved, len(states) - 1)
    return np.column_stack([length, np.diff(twist[which], prepend=0.0), bend[which] / bending_length_mm])

"""What the planner has to know of a steerable needle."""

from typing import Annotated

from anatomy.base.settings import quantity, settings


@settings
class Needle:
    """A bevel-tip or flexure-tip needle that follows arcs of bounded curvature.

    Its angle to the start is limited as in [Kuntz2015].  The wall that its first length may lie in is that of
    the branch which the tube pierced.
    """

    diameter_mm: Annotated[float, quantity("outer diameter of the needle", above=0.0, at_most=5.0)]
    max_curvature_per_mm: Annotated[
        float, quantity("curvature of the tightest arc in lung tissue", above=0.0, at_most=0.2)
    ]
    max_length_mm: Annotated[
        float, quantity("longest path from the start of the needle", above=0.0, at_most=500.0)
    ] = 150.0
    max_angle_from_start_deg: Annotated[
        float, quantity("largest angle between tip and start direction", above=0.0, at_most=180.0)
    ] = 90.0
    max_accumulated_turn_deg: Annotated[
        float, quantity("largest sum of the angles of all arcs", above=0.0, at_most=1080.0)
    ] = 180.0
    exit_exemption_mm: Annotated[
        float, quantity("needle length that may lie in the pierced wall", at_least=0.0, at_most=30.0)
    ] = 5.0

    max_strain: Annotated[
        float, quantity("largest strain of the needle's shaft in a bend", above=0.0, at_most=0.2)
    ] = 0.08
    strain_factor: Annotated[
        float, quantity("strain as a share of a plain shaft's: slots lower it", above=0.0, at_most=2.0)
    ] = 1.0

    @property
    def most_bent_per_mm(self) -> float:
        """How bent a channel may be that the needle passes, 1/mm."""
        return self.max_strain / (self.radius_mm * self.strain_factor)

    @property
    def radius_mm(self) -> float:
        """Outer radius, mm."""
        return 0.5 * self.diameter_mm

    @property
    def min_radius_of_curvature_mm(self) -> float:
        """Radius of the tightest arc, mm."""
        return 1.0 / self.max_curvature_per_mm

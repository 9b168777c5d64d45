"""What the planner has to know of a steerable needle."""

from typing import Annotated

from pydantic import Field

from anatomy.base.settings import impossible, quantity, settings
from anatomy.shafts import SlottedSegment, check_segments


@settings
class Needle:
    """A bevel-tip or flexure-tip needle that follows arcs of bounded curvature.

    Its angle to the start is limited as in [Kuntz2015].  The wall that its first length may lie in is that of
    the branch which the tube pierced.

    Its shaft is a tube like any other, which stiffens the tubes that aim it.  Without further keys it is a
    solid wire of superelastic NiTi, the stiffest of its diameter and material; `youngs_modulus_gpa = 0` says
    that its stiffness is to be neglected.  Raises SettingsError if a value is not finite or absurd, the bore
    is as wide as the needle, or slotted segments overlap.
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
    inner_diameter_mm: Annotated[
        float, quantity("bore of the needle, 0 of a solid one", at_least=0.0, at_most=5.0)
    ] = 0.0
    slotted_segments: Annotated[
        tuple[SlottedSegment, ...], Field(description="stretches with slots, the foremost first")
    ] = ()
    youngs_modulus_gpa: Annotated[
        float, quantity("Young's modulus, 0 to neglect the stiffness", at_least=0.0, at_most=1000.0)
    ] = 60.0
    poisson_ratio: Annotated[float, quantity("Poisson's ratio", at_least=0.0, below=0.5)] = 0.3

    def __post_init__(self) -> None:
        if self.inner_diameter_mm >= self.diameter_mm:
            raise impossible(
                "inner_diameter_mm", self.inner_diameter_mm, f"less than diameter_mm = {self.diameter_mm:g}"
            )
        check_segments(self.slotted_segments)

    def strain_factor(self, passing_mm: float) -> float:
        """Return the largest strain as a share of a plain shaft's, from the tip to `passing_mm` behind it."""
        at, factor = 0.0, 0.0
        for segment in self.slotted_segments:
            if segment.from_tip_mm < passing_mm:
                plain = segment.from_tip_mm > at
                factor, at = max(factor, segment.strain_factor, float(plain)), segment.to_mm
        return max(factor, 1.0) if at < passing_mm else factor

    def most_bent_per_mm(self, passing_mm: float) -> float:
        """Return how bent a channel may be that the first `passing_mm` of the needle pass, 1/mm."""
        return self.max_strain / (self.radius_mm * self.strain_factor(passing_mm))

    @property
    def radius_mm(self) -> float:
        """Outer radius, mm."""
        return 0.5 * self.diameter_mm

    @property
    def min_radius_of_curvature_mm(self) -> float:
        """Radius of the tightest arc, mm."""
        return 1.0 / self.max_curvature_per_mm

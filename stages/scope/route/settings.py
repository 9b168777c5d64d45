"""Settings of a route."""

from typing import Annotated

from anatomy.base.settings import quantity, settings


@settings
class RouteLimits:
    """What the device can follow; the largest curvature is S of [Li2021].

    With an end tolerance of 0 the route ends exactly at the wanted points.
    """

    max_curvature_per_mm: Annotated[float, quantity("largest curvature", above=0.0, at_most=10.0)]
    device_radius_mm: Annotated[float, quantity("outer radius of the device", at_least=0.0, at_most=10.0)] = (
        0.0
    )
    wall_margin_mm: Annotated[float, quantity("gap between device and wall", at_least=0.0, at_most=10.0)] = (
        0.0
    )
    end_tolerance_mm: Annotated[
        float, quantity("distance of the ends from the wanted points", at_least=0.0, at_most=10.0)
    ] = 0.0

    @property
    def needed_mm(self) -> float:
        """Depth in the lumen that every point of the route must have."""
        return self.device_radius_mm + self.wall_margin_mm

"""What the planner has to know of a bronchoscope."""

from __future__ import annotations

from typing import Annotated

from anatomy.settings import impossible, quantity, settings, text


@settings
class Bronchoscope:
    """A flexible bronchoscope with one working channel, which is thinner than the scope."""

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

    def __post_init__(self) -> None:
        if self.channel_diameter_mm >= self.outer_diameter_mm:
            raise impossible(
                "channel_diameter_mm",
                self.channel_diameter_mm,
                f"less than outer_diameter_mm = {self.outer_diameter_mm:g}",
            )

    @property
    def radius_mm(self) -> float:
        """Outer radius, mm."""
        return 0.5 * self.outer_diameter_mm

"""A tube and a needle are both a round shaft of one material, which a laser's slots may soften."""

import math
from collections.abc import Sequence
from typing import Annotated

from anatomy.base.settings import impossible, quantity, settings


@settings
class SlottedSegment:
    """A stretch of a tube or needle that a laser has patterned with slots, so that it bends more easily.

    Both factors compare it with the plain shaft at the same curvature: the bending stiffness, and the largest
    strain of the material.
    """

    from_tip_mm: Annotated[
        float, quantity("place of its front end, counted from the tip", at_least=0.0, at_most=2000.0)
    ] = 0.0
    length_mm: Annotated[float, quantity("length of the segment", above=0.0, at_most=2000.0)]
    stiffness_factor: Annotated[
        float, quantity("bending stiffness as a share of the plain shaft's", above=0.0, at_most=1.0)
    ]
    strain_factor: Annotated[
        float,
        quantity("strain as a share of the plain shaft's at the same curvature", above=0.0, at_most=2.0),
    ]

    @property
    def to_mm(self) -> float:
        """Place of its rear end, counted from the tip, mm."""
        return self.from_tip_mm + self.length_mm


def check_segments(segments: Sequence[SlottedSegment], length_mm: float = math.inf) -> None:
    """Check that segments, the foremost first, do not overlap and lie within a shaft.

    Raises pydantic_core.PydanticCustomError where one begins before the end of another or ends beyond the
    shaft.
    """
    at = 0.0
    for n, segment in enumerate(segments):
        if segment.from_tip_mm < at or segment.to_mm > length_mm:
            within = f" and such that the segment ends within length_mm = {length_mm:g}"
            raise impossible(
                f"slotted_segments[{n}].from_tip_mm",
                segment.from_tip_mm,
                f"at least {at:g}, where the segment before ends,{within if length_mm < math.inf else ''}",
            )
        at = segment.to_mm


def second_moment_mm4(outer_diameter_mm: float, inner_diameter_mm: float) -> float:
    """Return the second moment of area of a ring, mm^4."""
    return math.pi / 64.0 * (outer_diameter_mm**4 - inner_diameter_mm**4)

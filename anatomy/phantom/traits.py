"""What makes one phantom differ from the next besides its seed and size: build, disease, operation."""

from typing import Annotated, Literal

from pydantic import Field

from anatomy.base.settings import quantity, settings
from anatomy.lobes import LEFT_LOWER, LEFT_UPPER, RIGHT_LOWER, RIGHT_MIDDLE, RIGHT_UPPER
from anatomy.phantom.chest import LOBES

Lobe = Literal["", "right upper", "right middle", "right lower", "left upper", "left lower"]
RESECTED_INTO = {
    RIGHT_UPPER: RIGHT_MIDDLE, RIGHT_MIDDLE: RIGHT_UPPER, RIGHT_LOWER: RIGHT_MIDDLE, LEFT_UPPER: LEFT_LOWER,
    LEFT_LOWER: LEFT_UPPER,
}  # fmt: skip
"""Which lobe expands into the room of one that was resected: one beside it."""


@settings
class Traits:
    """The traits of a phantom; the default ones are those of `make_phantom` without any.

    The model has the proportions of an adult, and outside these ranges its fixed sizes mislead: segments
    would have no airway, lobar bronchi would leave their lobes, or lobes have no vessels. Casts of lungs show
    a flow exponent of 2.8 [Kitaoka1999]; masks of patients' CTs show 1.6 to 2, since thin airways are lost or
    drawn too thin. Hilar vessels are in neither the mask of the vessels nor that of the lungs, as in most
    segmentations, and the mask of the vessels ends with the lungs; 0 leaves all vessels in it. The bronchus
    of a resected lobe ends in a stump, its neighbour fills the room, and the diaphragm stands higher.
    Emphysema deepens the chest, flattens the diaphragm, takes thin vessels, and adds bullae below the pleura,
    which are not part of the lung mask: a needle must not enter them.
    """

    stature: Annotated[float, quantity("Factor of all lengths", at_least=0.85, at_most=1.2)] = 1.0
    flow_exponent: Annotated[
        float, quantity("Power of a tube's diameter that its flow goes with", at_least=1.5, at_most=3.2)
    ] = 2.8
    slenderness: Annotated[
        float, quantity("Lengths in diameters that grown branches aim at", at_least=1.0, at_most=10.0)
    ] = 3.0
    vessel_calibre: Annotated[
        float, quantity("Diameter of a vessel by that of the lumen beside it", at_least=1.0, at_most=3.0)
    ] = 1.0
    vessel_limit_mm: Annotated[
        float, quantity("Diameter at which vessels end, in an adult", at_least=0.5, at_most=4.0)
    ] = 1.3
    bronchus_length: Annotated[
        float, quantity("Factor of the lengths of main and lobar bronchi", at_least=0.8, at_most=1.5)
    ] = 1.0
    vessel_rim_mm: Annotated[
        float, quantity("Rim below an adult's pleura without vessels", at_least=0.0, at_most=10.0)
    ] = 0.0
    hilar_vessel_mm: Annotated[
        float,
        quantity("Diameter of an adult's vessels that count as mediastinum", at_least=0.0, at_most=25.0),
    ] = 0.0
    open_fissures: Annotated[
        float, quantity("Share of fissures that is missing, from the hilum on", at_least=0.0, at_most=1.0)
    ] = 0.0
    resected: Annotated[Lobe, Field(description="Lobe that was taken out")] = ""
    emphysema: Annotated[float, quantity("From none to severe", at_least=0.0, at_most=1.0)] = 0.0

    @property
    def resected_lobe(self) -> int:
        """Number of the resected lobe, 0 for none."""
        return LOBES[self.resected] if self.resected else 0


PLAIN = Traits()
"""The traits of `make_phantom` without any."""

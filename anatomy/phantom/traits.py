"""What makes one phantom differ from the next besides its seed and size: build, disease, operation."""

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from anatomy.lobes import LEFT_LOWER, LEFT_UPPER, RIGHT_LOWER, RIGHT_MIDDLE, RIGHT_UPPER
from anatomy.phantom.chest import LOBES

RESECTED_INTO = {
    RIGHT_UPPER: RIGHT_MIDDLE, RIGHT_MIDDLE: RIGHT_UPPER, RIGHT_LOWER: RIGHT_MIDDLE, LEFT_UPPER: LEFT_LOWER,
    LEFT_LOWER: LEFT_UPPER,
}  # fmt: skip
"""Which lobe expands into the room of one that was resected: one beside it."""
LEAST_STATURE, GREATEST_STATURE = 0.85, 1.2
"""The model has the proportions of an adult: farther away its fixed sizes, such as walls, mislead."""
LEAST_EXPONENT, GREATEST_EXPONENT = 1.5, 3.2
"""Below, segments would have no airway; above, twigs are nearly as wide as bronchi."""
LEAST_BRONCHUS_LENGTH, GREATEST_BRONCHUS_LENGTH = 0.8, 1.5
"""Beyond, lobar bronchi leave their lobes."""
GREATEST_RIM_MM, GREATEST_HILAR_VESSEL_MM = 10.0, 25.0
"""A wider rim would leave the lobes of a child without vessels; no vessel is wider than 25 mm."""


@frozen_value
class Traits:
    """The traits of a phantom; the default ones are those of `make_phantom` without any.

    Args:
        stature: Factor of all lengths, beside that of the size: 0.85 to 1.2.
        flow_exponent: The flow of a tube goes with this power of its diameter: 1.5 to 3.2.  2.8 is what casts
            of lungs show [Kitaoka1999]; masks of patients' CTs show 1.6 to 2, since thin airways are lost or
            drawn too thin.
        slenderness: Lengths of grown branches in diameters that are aimed at: 1 to 10.
        vessel_calibre: Diameter of a vessel by that of the airway lumen that supplies as much tissue: 1 to 3.
        vessel_limit_mm: Diameter at which vessels end, in an adult: at most 4.
        bronchus_length: Factor of the lengths of main and lobar bronchi: 0.8 to 1.5.
        vessel_rim_mm: Depth of the rim below the pleura, in an adult, into which no vessel runs: at most 10.
        hilar_vessel_mm: Diameter, in an adult, from which vessels count as mediastinum, as in most
            segmentations: they are in neither the mask of the vessels nor that of the lungs, and the mask of
            the vessels ends with the lungs.  At most 25; 0: all vessels are in the mask.
        open_fissures: Share of each lung's fissures that is missing, from the hilum outwards: 0 to 1.
        resected: A lobe of `anatomy.phantom.LOBES` that was taken out: its bronchus ends in a stump, its
            neighbour fills the room, and the diaphragm stands higher; "" for none.
        emphysema: 0 for none to 1 for severe: a deeper chest with a flat diaphragm, fewer thin vessels, and
            bullae below the pleura, into which no vessel grows.  Bullae are not part of the lung mask: a
            needle must not enter them.

    Raises:
        SettingsError: If a trait is out of its range.
    """

    stature: float = 1.0
    flow_exponent: float = 2.8
    slenderness: float = 3.0
    vessel_calibre: float = 1.0
    vessel_limit_mm: float = 1.3
    bronchus_length: float = 1.0
    vessel_rim_mm: float = 0.0
    hilar_vessel_mm: float = 0.0
    open_fissures: float = 0.0
    resected: str = ""
    emphysema: float = 0.0

    def __post_init__(self) -> None:
        for name, low, high in (
            ("stature", LEAST_STATURE, GREATEST_STATURE),
            ("flow_exponent", LEAST_EXPONENT, GREATEST_EXPONENT),
            ("slenderness", 1.0, 10.0),
            ("vessel_calibre", 1.0, 3.0),
            # Above, hardly a vessel is left.
            ("vessel_limit_mm", 0.5, 4.0),
            ("bronchus_length", LEAST_BRONCHUS_LENGTH, GREATEST_BRONCHUS_LENGTH),
            ("vessel_rim_mm", 0.0, GREATEST_RIM_MM),
            ("hilar_vessel_mm", 0.0, GREATEST_HILAR_VESSEL_MM),
            ("open_fissures", 0.0, 1.0),
            ("emphysema", 0.0, 1.0),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise SettingsError(
                    f"The trait {name} of the phantom is {value}", expected=f"{low:g} to {high:g}"
                )
        if self.resected and self.resected not in LOBES:
            raise SettingsError(
                f"The resected lobe of the phantom is {self.resected!r}",
                expected=f"one of {', '.join(LOBES)}",
            )

    @property
    def resected_lobe(self) -> int:
        """Number of the resected lobe, 0 for none."""
        return LOBES[self.resected] if self.resected else 0


PLAIN = Traits()
"""The traits of `make_phantom` without any."""

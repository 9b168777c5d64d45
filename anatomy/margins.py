"""The distances kept from the masks on top of a device's own radius."""

from typing import Annotated, Any

from anatomy.base.settings import quantity, settings


def _allowance_for(what: str) -> Any:
    return quantity(f"allowance for {what}", at_least=0.0, at_most=20.0)


@settings
class Margins:
    """Margins around every device, one for each reason why a mask is not the patient.

    Clearance is proved against the masks. The border of a mask is wrong by some fraction of a voxel and
    more (segmentation), and the patient on the table does not lie where the image says (registration).
    Raises SettingsError if a margin is negative, not finite or absurd.
    """

    segmentation_margin_mm: Annotated[float, _allowance_for("the border of the masks")] = 0.5
    registration_margin_mm: Annotated[float, _allowance_for("the alignment of image and patient")] = 0.0

    @property
    def total_mm(self) -> float:
        """Sum of the margins, mm: what a device keeps beyond its radius."""
        return self.segmentation_margin_mm + self.registration_margin_mm

"""What is done at the target: the tool, and how much of the nodule has to be in it."""

import math
import os
from typing import Annotated, Literal

import numpy as np

from anatomy.base.settings import impossible, parse, quantity, settings, text
from anatomy.base.typed import Float
from lungaccess.problem.preset_files import PresetFiles

ACROSS = 9
"""So many points lie across a wide tool: its volume in the nodule is then known to some percent."""
_FILES = PresetFiles(
    what="tool",
    folders=("presets/tools",),
    remedy="docs/explanation/tissue.md prints a complete file to start from",
    expected="lines such as from_tip_mm = -15.0",
)


@settings
class Tool:
    """A tool that takes or treats the tissue in a body of revolution about the needle's direction.

    Args:
        name, description, source: What it is, for people, and where its sizes come from.
        shape: "cylinder" of what a device cuts or holds, or "ellipsoid" of what is frozen or heated.
        from_tip_mm, to_tip_mm: Where the body begins and ends along the needle's direction, from the tip;
            behind it is negative.  What goes on mechanically is part of the needle, whose tip is at its end:
            a cylinder does not reach ahead of the tip, and no tool has its middle ahead of it.
        least: Tissue of the nodule in the tool that counts as success, in `unit`.
        unit: "mm" of the tool's length, "mm3" of its volume, or "share" of the nodule.
        margin_mm: Tissue about the nodule counts as nodule up to this distance: what an ablation has to
            cover.
        rim_mm: Only tissue so near to the nodule's surface counts, 0 for all of it: the inside may be
            necrotic.

    Raises:
        SettingsError: If the body has no length, reaches ahead, or has less room than the tissue that has to
            be in it.
    """

    name: Annotated[str, text("what the tool is called")] = "stated"
    description: Annotated[str, text("one sentence for people", may_be_empty=True)] = ""
    source: Annotated[str, text("where its sizes come from, or 'assumption'")] = "assumption"
    shape: Literal["cylinder", "ellipsoid"] = "cylinder"
    from_tip_mm: Annotated[float, quantity("begin of the body, from the tip", at_least=-80.0, at_most=80.0)]
    to_tip_mm: Annotated[float, quantity("end of the body, from the tip", at_least=-80.0, at_most=80.0)]
    diameter_mm: Annotated[float, quantity("diameter of the body", above=0.0, at_most=80.0)]
    least: Annotated[float, quantity("tissue in the tool that is enough, in `unit`", above=0.0, at_most=1e6)]
    unit: Literal["mm", "mm3", "share"] = "mm"
    margin_mm: Annotated[
        float, quantity("tissue about the nodule that counts as nodule", at_least=0.0, at_most=20.0)
    ] = 0.0
    rim_mm: Annotated[
        float, quantity("thickness of the rim that counts, 0 for all", at_least=0.0, at_most=50.0)
    ] = 0.0

    def __post_init__(self) -> None:
        if self.to_tip_mm <= self.from_tip_mm:
            raise impossible("to_tip_mm", self.to_tip_mm, f"more than from_tip_mm = {self.from_tip_mm:g}")
        most = 0.0 if self.shape == "cylinder" else -self.from_tip_mm
        if self.to_tip_mm > most:
            raise impossible(
                "to_tip_mm",
                self.to_tip_mm,
                f"at most {most:g}: what goes on mechanically is part of the needle's way, whose tip is at "
                "the end of it, and nothing lies mostly ahead of the tip",
            )
        room = {"mm": self.length_mm, "mm3": self.volume_mm3, "share": 1.0}[self.unit]
        if self.least > room:
            raise impossible("least", self.least, f"at most {room:.4g} {self.unit}, which fits into the tool")

    @property
    def length_mm(self) -> float:
        """Length of the body, mm."""
        return self.to_tip_mm - self.from_tip_mm

    @property
    def beyond_mm(self) -> float:
        """How far the tip lies beyond the middle of the body, mm."""
        return -0.5 * (self.from_tip_mm + self.to_tip_mm)

    @property
    def volume_mm3(self) -> float:
        """Volume of the body, mm^3."""
        share = 1.0 if self.shape == "cylinder" else 2.0 / 3.0
        return share * 0.25 * math.pi * self.diameter_mm**2 * self.length_mm

    @property
    def words(self) -> str:
        """What counts as success in words, such as "at least 5 mm of the nodule in the core needle"."""
        about = f" with {self.margin_mm:g} mm about it" if self.margin_mm else ""
        rim = f"'s rim of {self.rim_mm:g} mm" if self.rim_mm else ""
        amount = {"mm": f"{self.least:g} mm", "mm3": f"{self.least:g} mm³", "share": f"{self.least:.0%}"}
        return f"at least {amount[self.unit]} of the nodule{rim}{about} in the {self.name}"

    def points(self) -> Float:
        """Return points `(K, 3)` of the body in the frame of the tip, +z ahead; each stands for as much."""
        # A tool that is no wider takes beside its axis what it takes along it.
        if self.diameter_mm <= 2.0:
            # Points on the axis of a thin tool are so far apart: with 0.25 a core's chance was 0.8 of 100 too
            # high.
            count = max(math.ceil(self.length_mm / 0.1), 1)
            z = self.from_tip_mm + self.length_mm * (np.arange(count) + 0.5) / count
            return np.column_stack([np.zeros((count, 2)), z])
        side = (2.0 * np.arange(ACROSS) + 1.0) / ACROSS - 1.0
        x, y, z = (each.ravel() for each in np.meshgrid(side, side, side, indexing="ij"))
        inside = x**2 + y**2 + (z**2 if self.shape == "ellipsoid" else 0.0) <= 1.0
        scale = 0.5 * np.array([self.diameter_mm, self.diameter_mm, self.length_mm])
        found = np.column_stack([x, y, z])[inside] * scale
        return np.asarray(found - [0.0, 0.0, self.beyond_mm])


def load_tool(name_or_path: str | os.PathLike[str]) -> Tool:
    """Read a tool from a preset or from a TOML file.

    What may be stated, and the errors, are those of `lungaccess.problem.system.load_system`.

    Examples:
        >>> load_tool("core").words
        'at least 5 mm of the nodule in the core needle'
    """
    return parse(Tool, _FILES.read(name_or_path), os.fspath(name_or_path), remedy=_FILES.remedy)

"""What is done at the target: the tool, and how much tissue it has to take or treat."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np

from anatomy.base.settings import impossible, quantity, settings, text
from anatomy.base.typed import Float

FINEST_MM = 0.25
"""Spacing of the points on the axis of a tool: what is left of a core differs by less than half of it."""
ACROSS = 9
"""Points of a tool that is wide, across it: a volume is then known to some percent."""
WIDE_MM = 2.0
"""A tool that is no wider takes along its axis what it takes beside it."""


@settings
class Tool:
    """A tool that takes or treats the tissue in a body of revolution about the needle's direction.

    Parameters
    ----------
    name, description, source : str
    shape : str
        "cylinder", or "ellipsoid" of what is frozen or heated.
    from_tip_mm, to_tip_mm : float
        Where that body begins and ends along the needle's direction, from its tip; what lies behind it is
        negative.
    diameter_mm : float
    least : float
        Tissue of the nodule with which a pass or several are enough, in `unit`.
    unit : str
        "mm" of the tool's length, "mm3", or "share" of the nodule.
    margin_mm : float
        Tissue about the nodule that counts as nodule: what an ablation has to cover.
    rim_mm : float
        Only so thick a rim of the nodule counts, 0 for all of it: the core may be necrotic.

    Raises
    ------
    SettingsError
        If the body has no length, or less tissue fits into it than there has to be.
    """

    name: Annotated[str, text("what the tool is called")] = "stated"
    description: Annotated[str, text("one sentence for people", may_be_empty=True)] = ""
    source: Annotated[str, text("where its sizes come from, or 'assumption'")] = "assumption"
    shape: Literal["cylinder", "ellipsoid"] = "cylinder"
    from_tip_mm: Annotated[
        float, quantity("where it begins, from the needle's tip", at_least=-60, at_most=60)
    ]
    to_tip_mm: Annotated[float, quantity("where it ends, from the needle's tip", at_least=-60, at_most=60)]
    diameter_mm: Annotated[float, quantity("diameter of what it takes or treats", above=0.0, at_most=80.0)]
    least: Annotated[float, quantity("tissue that is enough, in `unit`", above=0.0, at_most=1e6)]
    unit: Literal["mm", "mm3", "share"] = "mm"
    margin_mm: Annotated[float, quantity("tissue about the nodule that counts", at_least=0, at_most=20)] = 0.0
    rim_mm: Annotated[float, quantity("thickness of the rim that counts, 0: all", at_least=0, at_most=50)] = (
        0.0
    )

    def __post_init__(self) -> None:
        if self.to_tip_mm <= self.from_tip_mm:
            raise impossible("to_tip_mm", self.to_tip_mm, f"more than from_tip_mm = {self.from_tip_mm:g}")
        most = {"mm": self.length_mm, "mm3": self.volume_mm3, "share": 1.0}[self.unit]
        if self.least > most:
            raise impossible(
                "least", self.least, f"at most {most:.3g} {self.unit}: no more fits into the tool"
            )

    @property
    def length_mm(self) -> float:
        """Length of the body, mm."""
        return self.to_tip_mm - self.from_tip_mm

    @property
    def volume_mm3(self) -> float:
        """Volume of the body, mm^3."""
        shape = 1.0 if self.shape == "cylinder" else 2.0 / 3.0
        return shape * 0.25 * math.pi * self.diameter_mm**2 * self.length_mm

    @property
    def words(self) -> str:
        """What is enough: "at least 5 mm of the nodule in the tool"."""
        if self.unit == "share":
            return f"at least {self.least:.0%} of the nodule in the {self.name}"
        return f"at least {self.least:g} {self.unit.replace('3', '³')} of the nodule in the {self.name}"

    def points(self) -> Float:
        """Return points `(K, 3)` of the body, in the frame of the needle's tip, +z ahead; each stands for as much."""
        count = max(round(self.length_mm / FINEST_MM), 1) if self.diameter_mm <= WIDE_MM else ACROSS
        along = (np.arange(count) + 0.5) / count
        z = self.from_tip_mm + self.length_mm * along
        if self.diameter_mm <= WIDE_MM:
            return np.column_stack([np.zeros((count, 2)), z])
        side = (2.0 * np.arange(ACROSS) + 1.0) / ACROSS - 1.0
        x, y, n = np.meshgrid(side, side, np.arange(count), indexing="ij")
        widest = np.ones(count) if self.shape == "cylinder" else 1.0 - (2.0 * along - 1.0) ** 2
        inside = x**2 + y**2 <= widest[n]
        radius = 0.5 * self.diameter_mm
        return np.column_stack([radius * x[inside], radius * y[inside], z[n[inside]]])

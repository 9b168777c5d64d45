"""The error model: how large the errors of devices and target are assumed to be."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Annotated

from anatomy.io.files import read_toml
from anatomy.settings import impossible, parse, quantity, settings, text

_REMEDY = "`lungaccess template errors` prints a complete file to start from"
CURVATURE = "needle_curvature"
"""The one kind whose size is a pair of factors and no standard deviation."""

UNITS: dict[str, str] = {
    "scope_position": "mm",
    "scope_direction": "deg",
    "tube_rotation": "deg",
    "tube_insertion": "mm",
    CURVATURE: "factor",
    "needle_roll": "deg",
    "needle_insertion": "mm",
    "target_position": "mm",
}
"""Kinds of error and the unit in which their size is stated."""
OF_NEEDLE = (CURVATURE, "needle_roll", "needle_insertion")
"""The kinds that only a needle has."""


@settings
class ErrorModel:
    """How large the errors of devices and target are, independent of each other and open loop.

    Sizes are standard deviations of normal errors without bias, except for the needle's curvature.  All
    defaults are assumptions, see docs/explanation/risk.md.

    Parameters
    ----------
    name : str
        What the model is called where its results are shown, see `label`.
    scope_position_mm : float
        Position of the scope tip, along each axis, mm.
    scope_direction_deg : float
        Tilt of the scope tip about each of two axes across it, degrees.
    tube_rotation_deg : float
        Rotation of both tubes together, degrees.
    tube_insertion_mm : float
        Insertion of each tube, mm.
    needle_curvature_low_factor, needle_curvature_high_factor : float
        The curvature of all arcs is that of the plan times one factor, uniform between these two.
    needle_roll_deg : float
        Angle of the needle about its axis at each arc, degrees.
    needle_insertion_mm : float
        Insertion at which each arc ends, mm.
    target_position_mm : float
        Position of the target, along each axis, mm.

    Raises
    ------
    SettingsError
        If a value is not finite, negative or absurd, or the factors are in the wrong order.
    """

    name: Annotated[str, text("what the model is called where its results are shown", may_be_empty=True)] = ""
    scope_position_mm: Annotated[
        float, quantity("standard deviation of the scope tip along each axis", at_least=0.0, at_most=20.0)
    ] = 1.0
    scope_direction_deg: Annotated[
        float,
        quantity("standard deviation of the scope tip's tilt about each axis", at_least=0.0, at_most=45.0),
    ] = 2.0
    tube_rotation_deg: Annotated[
        float, quantity("standard deviation of the tubes' rotation", at_least=0.0, at_most=180.0)
    ] = 3.0
    tube_insertion_mm: Annotated[
        float, quantity("standard deviation of each tube's insertion", at_least=0.0, at_most=20.0)
    ] = 0.5
    needle_curvature_low_factor: Annotated[
        float, quantity("least curvature, as a multiple of the planned one", at_least=0.0, at_most=1.0)
    ] = 0.7
    needle_curvature_high_factor: Annotated[
        float, quantity("greatest curvature, as a multiple of the planned one", at_least=1.0, at_most=5.0)
    ] = 1.4
    needle_roll_deg: Annotated[
        float, quantity("standard deviation of the needle's angle at each arc", at_least=0.0, at_most=180.0)
    ] = 5.0
    needle_insertion_mm: Annotated[
        float, quantity("standard deviation of the insertion at each arc's end", at_least=0.0, at_most=20.0)
    ] = 0.5
    target_position_mm: Annotated[
        float, quantity("standard deviation of the target along each axis", at_least=0.0, at_most=50.0)
    ] = 1.0

    def __post_init__(self) -> None:
        low, high = self.needle_curvature_low_factor, self.needle_curvature_high_factor
        if not low <= high:
            raise impossible("needle_curvature_low_factor", low, f"at most {high:g}")

    @property
    def sizes(self) -> dict[str, float]:
        """Size of each kind of error but the curvature's, mm or degrees, by its name in `UNITS`."""
        return {
            name: float(getattr(self, f"{name}_{unit}")) for name, unit in UNITS.items() if name != CURVATURE
        }

    @property
    def is_default(self) -> bool:
        """Whether all sizes are the default ones, which are assumptions."""
        return replace(self, name="") == ErrorModel()

    @property
    def label(self) -> str:
        """What the model is called: its name, "default" if all sizes are the default ones, else "stated"."""
        return self.name or ("default" if self.is_default else "stated")

    def words(self, *, with_needle: bool) -> str:
        """Return all sizes in one clause, standard deviations but for the factors of the curvature."""
        low, high = self.curvature_factors
        of_needle = (
            f"needle {self.needle_insertion_mm:g} mm and {self.needle_roll_deg:g}°, "
            f"its curvature {low:g} to {high:g} times the planned one, "
        )
        return (
            f"scope tip {self.scope_position_mm:g} mm and {self.scope_direction_deg:g}°, "
            f"tubes {self.tube_insertion_mm:g} mm and {self.tube_rotation_deg:g}°, "
            f"{of_needle if with_needle else ''}target {self.target_position_mm:g} mm"
        )

    @property
    def curvature_factors(self) -> tuple[float, float]:
        """Least and greatest factor of the needle's curvature."""
        return self.needle_curvature_low_factor, self.needle_curvature_high_factor


def load_errors(path: str | os.PathLike[str]) -> ErrorModel:
    """Read an error model from a TOML file; keys that are left out take their defaults.

    The model is called what the file says in `name`, else as the file is.

    Raises
    ------
    SettingsError
        If the file is not TOML, or a value in it is wrong.
    FileError
        If the file cannot be read.
    """
    mapping = read_toml(
        os.fspath(path), expected="one line a key, such as scope_position_mm = 1.0", remedy=_REMEDY
    )
    named = {"name": os.path.basename(path), **mapping}
    return parse(ErrorModel, named, os.fspath(path), remedy=_REMEDY)

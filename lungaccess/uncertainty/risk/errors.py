"""The error model: how large the errors of devices, patient and images are, and who says so."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Self

from anatomy.base.settings import impossible, quantity, settings, text

CURVATURE, BREATHING = "needle_curvature", "breathing"
UNITS: dict[str, str] = {
    "scope_position": "mm",
    "scope_direction": "deg",
    "tube_rotation": "deg",
    "tube_insertion": "mm",
    CURVATURE: "ln",
    "needle_roll": "deg",
    "needle_insertion": "mm",
    "target_position": "mm",
    BREATHING: "mm",
}
"""Kinds of error and the unit in which their size is stated; "ln" is the natural logarithm of a factor."""
OF_NEEDLE = (CURVATURE, "needle_roll", "needle_insertion")
"""The kinds that only a needle has."""
ASSUMPTION = "assumption"
"""What a source begins with where nobody has published a figure."""
NORMAL, BOUNDED = "normal", "bounded"
IN_WINDOW = "lognormal-in-window"
"""Breathing of which the phase is one of the plan's window."""

_Source = Annotated[str, text(f"where the sizes come from, or a text that begins with {ASSUMPTION!r}")]
_Distribution = Annotated[str, text(f"{NORMAL!r} or {BOUNDED!r}")]


class _Term:
    """What terms with a part drawn once a patient and a part drawn once an attempt have in common."""

    unit: ClassVar[str]
    distributions: ClassVar[tuple[str, ...]] = (NORMAL, BOUNDED)
    distribution: str
    source: str

    def __post_init__(self) -> None:
        if self.distribution not in self.distributions:
            raise impossible("distribution", self.distribution, " or ".join(self.distributions))

    @property
    def patient(self) -> float:
        """Size of the part that is drawn once for each patient, in the unit of the term."""
        return float(getattr(self, f"patient_{self.unit}"))

    @property
    def attempt(self) -> float:
        """Size of the part that is drawn once for each attempt, in the unit of the term."""
        return float(getattr(self, f"attempt_{self.unit}"))

    @property
    def size(self) -> float:
        """Size of both parts together, which are independent: the root of the sum of their squares."""
        return math.hypot(self.patient, self.attempt)

    @property
    def is_assumed(self) -> bool:
        """Whether there is an error, and nobody has published its size."""
        return self.size > 0.0 and self.source.startswith(ASSUMPTION)

    def sized(self, size: float) -> Self:
        """Return the term with both parts scaled to a size together; a term of none gets one an attempt."""
        if not self.size:
            return replace(self, **{f"attempt_{self.unit}": size})  # type: ignore[type-var]
        scale = size / self.size
        parts = {f"patient_{self.unit}": scale * self.patient, f"attempt_{self.unit}": scale * self.attempt}
        return replace(self, **parts)  # type: ignore[type-var]


@settings
class PositionError(_Term):
    """An error of a length, mm, along each axis or of each device.

    Parameters
    ----------
    distribution : str
        "normal": the sizes are standard deviations.  "bounded": uniform, the sizes are the largest errors.
    patient_mm, attempt_mm : float
        Size of the part drawn once for each patient, and of that drawn once for each attempt; they add up.
    source : str
        Where the sizes come from; what nobody has published begins with "assumption".

    Raises
    ------
    SettingsError
        If a size is not finite, negative or absurd, or the distribution unknown.
    """

    unit: ClassVar[str] = "mm"
    distribution: _Distribution = NORMAL
    patient_mm: Annotated[float, quantity("size of the part of each patient", at_least=0.0, at_most=50.0)] = (
        0.0
    )
    attempt_mm: Annotated[float, quantity("size of the part of each attempt", at_least=0.0, at_most=50.0)] = (
        0.0
    )
    source: _Source = ASSUMPTION


@settings
class AngleError(_Term):
    """An error of an angle, degrees, about each axis or at each arc; see `PositionError`."""

    unit: ClassVar[str] = "deg"
    distribution: _Distribution = NORMAL
    patient_deg: Annotated[
        float, quantity("size of the part of each patient", at_least=0.0, at_most=180.0)
    ] = 0.0
    attempt_deg: Annotated[
        float, quantity("size of the part of each attempt", at_least=0.0, at_most=180.0)
    ] = 0.0
    source: _Source = ASSUMPTION


@settings
class CurvatureError(_Term):
    """The factor by which a needle bends more or less than planned, the same in all arcs of an insertion.

    Parameters
    ----------
    distribution : str
        "lognormal-factor", the only one: the logarithm of the factor is normal.
    median : float
        Factor that half of the needles exceed.
    patient_ln, attempt_ln : float
        Standard deviation of the logarithm, see `PositionError`.
    straight_share : float
        Share of the attempts in which the needle does not bend at all, whatever was drawn otherwise.
    """

    unit: ClassVar[str] = "ln"
    distributions: ClassVar[tuple[str, ...]] = ("lognormal-factor",)
    distribution: Annotated[str, text("'lognormal-factor'")] = "lognormal-factor"
    median: Annotated[float, quantity("median of the factor of the curvature", at_least=0.1, at_most=5.0)] = (
        1.0
    )
    patient_ln: Annotated[
        float, quantity("standard deviation of the logarithm, by patient", at_least=0.0, at_most=1.5)
    ] = 0.0
    attempt_ln: Annotated[
        float, quantity("standard deviation of the logarithm, by attempt", at_least=0.0, at_most=1.5)
    ] = 0.0
    straight_share: Annotated[
        float, quantity("share of the needles that go straight", at_least=0.0, at_most=1.0)
    ] = 0.0
    source: _Source = ASSUMPTION


@settings
class BreathingError(_Term):
    """Motion of the lung by breathing between scope and target, see `lungaccess.uncertainty.risk.breathing`.

    Parameters
    ----------
    distribution : str
        "lognormal": the logarithm of the patient's motion is normal, and the procedure is at any time of the
        cycle.  "lognormal-in-window": it is in the plan's window, which needs the motion of the patient.
    median_mm : float
        Median over patients of A, the motion from end-exhale to end-inhale that 95 % of the points of a lung
        do not exceed; 0 for none.
    patient_ln : float
        Standard deviation of the logarithm of A.
    """

    unit: ClassVar[str] = "mm"
    distributions: ClassVar[tuple[str, ...]] = ("lognormal", IN_WINDOW)
    distribution: Annotated[str, text(f"'lognormal' or {IN_WINDOW!r}")] = "lognormal"
    median_mm: Annotated[
        float, quantity("median of the patients' motion by breathing", at_least=0.0, at_most=60.0)
    ] = 0.0
    patient_ln: Annotated[
        float, quantity("standard deviation of its logarithm over patients", at_least=0.0, at_most=1.5)
    ] = 0.0
    source: _Source = ASSUMPTION

    @property
    def size(self) -> float:
        """The median motion, mm."""
        return self.median_mm

    def sized(self, size: float) -> BreathingError:
        """Return the term with another median."""
        return replace(self, median_mm=size)


Term = PositionError | AngleError | CurvatureError | BreathingError


@settings
class ErrorModel:
    """How large the errors of devices, patient and images are; independent of each other, without bias.

    Without arguments there is no error at all; `load_errors` reads the presets, which state their sources.

    Parameters
    ----------
    name : str
        What the model is called where its results are shown, see `label`.
    description : str
        One sentence for people.
    scope_position : PositionError
        Position of the scope tip, along each axis.
    scope_direction : AngleError
        Tilt of the scope tip about each of two axes across it.
    tube_rotation : AngleError
        Rotation of planar tubes together, or of each tube that is not planar.
    tube_insertion : PositionError
        Insertion of each tube.
    needle_curvature : CurvatureError
    needle_roll : AngleError
        Angle of the needle about its axis at each arc.
    needle_insertion : PositionError
        Insertion at which each arc ends.
    target_position : PositionError
        Position of the target, along each axis.
    breathing : BreathingError

    Raises
    ------
    SettingsError
        If a value is not finite, negative or absurd.
    """

    name: Annotated[str, text("what the model is called where its results are shown", may_be_empty=True)] = ""
    description: Annotated[str, text("one sentence for people", may_be_empty=True)] = ""
    scope_position: PositionError = PositionError()
    scope_direction: AngleError = AngleError()
    tube_rotation: AngleError = AngleError()
    tube_insertion: PositionError = PositionError()
    needle_curvature: CurvatureError = CurvatureError()
    needle_roll: AngleError = AngleError()
    needle_insertion: PositionError = PositionError()
    target_position: PositionError = PositionError()
    breathing: BreathingError = BreathingError()

    def term(self, kind: str) -> Term:
        """Return the error of a kind, by its name in `UNITS`."""
        found: Term = getattr(self, kind)
        return found

    def only(self, kind: str, size: float | None = None) -> ErrorModel:
        """Return the model with errors of one kind only, scaled to a size if one is given."""
        term = self.term(kind)
        kept: dict[str, Any] = {kind: term if size is None else term.sized(size)}
        return ErrorModel(**kept)

    def scaled(self, factor: float) -> ErrorModel:
        """Return the model with all sizes multiplied by a factor."""
        terms: dict[str, Any] = {kind: self.term(kind).sized(factor * self.term(kind).size) for kind in UNITS}
        return replace(self, **terms)

    @property
    def assumed(self) -> tuple[str, ...]:
        """The kinds with an error whose size nobody has published."""
        return tuple(kind for kind in UNITS if self.term(kind).is_assumed)

    @property
    def label(self) -> str:
        """What the model is called: its name, "stated" if it has none."""
        return self.name or "stated"

    def words(self, *, with_needle: bool) -> str:
        """Return all sizes in one clause: those of normal errors are standard deviations."""
        size = {kind: self.term(kind).size for kind in UNITS}
        straight = self.needle_curvature.straight_share
        of_needle = (
            f"needle {size['needle_insertion']:g} mm and {size['needle_roll']:g}°, its curvature "
            f"{100.0 * size[CURVATURE]:.0f} %{f' ({100.0 * straight:g} % go straight)' if straight else ''}, "
        )
        breathing = f", breathing {size[BREATHING]:.1f} mm" if size[BREATHING] else ""
        return (
            f"scope tip {size['scope_position']:g} mm and {size['scope_direction']:g}°, "
            f"tubes {size['tube_insertion']:g} mm and {size['tube_rotation']:g}°, "
            f"{of_needle if with_needle else ''}target {size['target_position']:g} mm{breathing}"
        )

"""The error model: how large the errors of devices, patient and images are, and who says so."""

import math
from dataclasses import field, replace
from typing import Annotated, Any, ClassVar, Self

from anatomy.base.errors import SettingsError
from anatomy.base.records import LEFT_OUT_IF_EMPTY
from anatomy.base.settings import impossible, quantity, settings, text
from anatomy.base.words import did_you_mean
from anatomy.lobes import LOBES, lobe_named
from stages.scope import WallContact

CURVATURE, BREATHING, VESSEL_BORDER = "needle_curvature", "breathing", "vessel_border"
UNITS: dict[str, str] = {
    "scope_position": "mm", "scope_direction": "deg", "tube_rotation": "deg", "tube_insertion": "mm",
    CURVATURE: "ln", "needle_roll": "deg", "needle_insertion": "mm", "target_position": "mm", BREATHING: "mm",
    VESSEL_BORDER: "mm",
}  # fmt: skip
"""Kinds of error and the unit in which their size is stated; "ln" is the natural logarithm of a factor."""
AXES: dict[str, int] = {
    "scope_position": 3, "scope_direction": 2, "tube_rotation": 1, "tube_insertion": 1, "needle_roll": 1,
    "needle_insertion": 1, "target_position": 3, VESSEL_BORDER: 1,
}  # fmt: skip
"""How many numbers the bias of a kind has: along x, y, z of the scope's tip, about its x and y, LPS for the
target, one where the devices have one axis, and one for the vessels' border.  The curvature has its median
instead."""
OF_NEEDLE = (CURVATURE, "needle_roll", "needle_insertion")
"""The kinds that only a needle has."""
ASSUMPTION = "assumption"
"""What a source begins with where nobody has published a figure."""
NORMAL, BOUNDED = "normal", "bounded"
RESTING = "resting"
"""Normal errors about where the scope's shaft comes to rest on the wall, with the spread of that place."""
OF_SHAFT = ("scope_position", "scope_direction")
"""The kinds that may be about the resting shaft."""
IN_WINDOW = "lognormal-in-window"
"""Breathing of which the phase is one of the plan's window."""

_Source = Annotated[str, text(f"where the sizes come from, or a text that begins with {ASSUMPTION!r}")]
_Distribution = Annotated[str, text(f"{NORMAL!r}, {BOUNDED!r} or, of the scope's tip, {RESTING!r}")]


def _size(whose: str, at_most: float) -> Any:
    return quantity(f"size of the part of each {whose}", at_least=0.0, at_most=at_most)


def _bias(at_most: float) -> Any:
    return quantity("mean of the error", at_least=-at_most, at_most=at_most)


def _optional() -> Any:
    """Return the field of a tuple that files lack where it is empty."""
    return field(default=(), metadata={LEFT_OUT_IF_EMPTY: True})


class _Term:
    """What terms with a part drawn once a patient and a part drawn once an attempt have in common."""

    unit: ClassVar[str]
    distributions: ClassVar[tuple[str, ...]] = (NORMAL, BOUNDED, RESTING)
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
    def bias(self) -> tuple[float, ...]:
        """The mean of the error in the unit of the term, as many numbers as `AXES` says; none for no bias."""
        return tuple(getattr(self, f"bias_{self.unit}", ()))

    @property
    def size(self) -> float:
        """Size of both parts together, which are independent: the root of the sum of their squares."""
        return math.hypot(self.patient, self.attempt)

    @property
    def rms(self) -> float:
        """Root of the mean square of the error along one axis, bias and spread together."""
        bias = self.bias
        return math.hypot(self.size, math.hypot(*bias) / math.sqrt(len(bias))) if bias else self.size

    @property
    def is_assumed(self) -> bool:
        """Whether there is an error, and nobody has published its size."""
        return self.rms > 0.0 and self.source.startswith(ASSUMPTION)

    def sized(self, size: float) -> Self:
        """Return the term scaled to a size of both parts together; a term of none gets one an attempt.

        An error of a known size is about the plan: it has no bias, wherever the shaft rests.
        """
        if self.distribution == RESTING:
            return replace(self, distribution=NORMAL).sized(size)  # type: ignore[type-var]
        if self.bias:
            return replace(self, **{f"bias_{self.unit}": ()}).sized(size)  # type: ignore[type-var]
        if not self.size:
            return replace(self, **{f"attempt_{self.unit}": size})  # type: ignore[type-var]
        return self.scaled(size / self.size)

    def scaled(self, factor: float) -> Self:
        """Return the term with both parts and its bias multiplied by a factor."""
        parts: dict[str, Any] = {
            f"patient_{self.unit}": factor * self.patient,
            f"attempt_{self.unit}": factor * self.attempt,
        }
        if self.bias:
            parts[f"bias_{self.unit}"] = tuple(factor * each for each in self.bias)
        return replace(self, **parts)  # type: ignore[type-var]


@settings
class PositionError(_Term):
    """An error of a length, mm, along each axis or of each device.

    Args:
        distribution: "normal": the sizes are standard deviations.  "bounded": uniform, the sizes are the
            largest errors.  "resting", of the scope's tip: normal about where the shaft rests, whose spread
            adds to the sizes.
        patient_mm, attempt_mm: Size of the part drawn once for each patient, and of that drawn once for each
            attempt; they add up.
        bias_mm: Mean of the error, added to both parts: as many numbers as `AXES` says, none for no bias.
        source: Where the sizes come from; what nobody has published begins with "assumption".
    """

    unit: ClassVar[str] = "mm"
    distribution: _Distribution = NORMAL
    patient_mm: Annotated[float, _size("patient", 50.0)] = 0.0
    attempt_mm: Annotated[float, _size("attempt", 50.0)] = 0.0
    bias_mm: tuple[Annotated[float, _bias(50.0)], ...] = _optional()
    source: _Source = ASSUMPTION


@settings
class AngleError(_Term):
    """An error of an angle, degrees, about each axis or at each arc; see `PositionError`."""

    unit: ClassVar[str] = "deg"
    distribution: _Distribution = NORMAL
    patient_deg: Annotated[float, _size("patient", 180.0)] = 0.0
    attempt_deg: Annotated[float, _size("attempt", 180.0)] = 0.0
    bias_deg: tuple[Annotated[float, _bias(180.0)], ...] = _optional()
    source: _Source = ASSUMPTION


@settings
class CurvatureError(_Term):
    """The factor by which a needle bends more or less than planned, the same in all arcs of an insertion.

    Args:
        median: Factor that half of the needles exceed.
        patient_ln, attempt_ln: Standard deviation of the logarithm, see `PositionError`.
        straight_share: Share of the attempts in which the needle does not bend at all, whatever was drawn
            otherwise.
    """

    unit: ClassVar[str] = "ln"
    distributions: ClassVar[tuple[str, ...]] = ("lognormal-factor",)
    distribution: Annotated[str, text("'lognormal-factor'")] = "lognormal-factor"
    median: Annotated[float, quantity("median of the factor of the curvature", at_least=0.1, at_most=5.0)] = (
        1.0
    )
    patient_ln: Annotated[float, _size("patient", 1.5)] = 0.0
    attempt_ln: Annotated[float, _size("attempt", 1.5)] = 0.0
    straight_share: Annotated[
        float, quantity("share of the needles that go straight", at_least=0.0, at_most=1.0)
    ] = 0.0
    source: _Source = ASSUMPTION


@settings
class BreathingError(_Term):
    """Motion of the lung by breathing between scope and target, see `uncertainty.risk.patient_errors`.

    Args:
        distribution: "lognormal": the logarithm of the patient's motion is normal, and the procedure is at
            any time of the cycle.  "lognormal-in-window": it is in the plan's window, which needs the motion
            of the patient.
        median_mm: Median over patients of A, the motion from end-exhale to end-inhale that 95 % of the points
            of a lung do not exceed; 0 for none.
        patient_ln: Standard deviation of the logarithm of A.
    """

    unit: ClassVar[str] = "mm"
    distributions: ClassVar[tuple[str, ...]] = ("lognormal", IN_WINDOW)
    distribution: Annotated[str, text(f"'lognormal' or {IN_WINDOW!r}")] = "lognormal"
    median_mm: Annotated[
        float, quantity("median of the patients' motion by breathing", at_least=0.0, at_most=60.0)
    ] = 0.0
    patient_ln: Annotated[float, _size("patient", 1.5)] = 0.0
    source: _Source = ASSUMPTION

    @property
    def size(self) -> float:
        """The median motion, mm."""
        return self.median_mm

    def sized(self, size: float) -> "BreathingError":
        """Return the term with another median."""
        return replace(self, median_mm=size)

    def scaled(self, factor: float) -> "BreathingError":
        """Return the term with its median multiplied by a factor."""
        return self.sized(factor * self.median_mm)


Term = PositionError | AngleError | CurvatureError | BreathingError


def _require_fit(kind: str, term: Term | None) -> None:
    """Refuse a bias of not as many numbers as its kind has axes, and what only the scope's shaft does."""
    if term and term.distribution == RESTING and kind not in OF_SHAFT:
        raise impossible(f"{kind}.distribution", RESTING, f"{NORMAL} or {BOUNDED}: only the scope rests")
    bias = term.bias if term else ()
    if bias and len(bias) != AXES[kind]:
        raise impossible(f"{kind}.bias_{UNITS[kind]}", list(bias), f"{AXES[kind]} numbers")


@settings
class Place:
    """Errors of other sizes where the scope's tip stands in some of the airways, as classes of `ErrorModel`.

    Both generations are included; the trachea is 0.
    """

    lobe: Annotated[str, text("lobe of the scope's tip, any if empty", may_be_empty=True)] = ""
    generation_from: Annotated[int, quantity("least generation of its airway", at_least=0, at_most=99)] = 0
    generation_to: Annotated[int, quantity("greatest generation of it", at_least=0, at_most=99)] = 99
    scope_position: PositionError | None = None
    scope_direction: AngleError | None = None
    tube_rotation: AngleError | None = None
    tube_insertion: PositionError | None = None
    needle_curvature: CurvatureError | None = None
    needle_roll: AngleError | None = None
    needle_insertion: PositionError | None = None
    target_position: PositionError | None = None
    breathing: BreathingError | None = None
    vessel_border: PositionError | None = None

    def __post_init__(self) -> None:
        if self.lobe and not lobe_named(self.lobe):
            raise impossible("lobe", self.lobe, f"one of {', '.join(LOBES.values())}")
        if self.generation_to < self.generation_from:
            raise impossible("generation_to", self.generation_to, f"at least {self.generation_from}")
        if not self.terms:
            raise impossible("place", "no errors", f"a table of errors, such as [place.{next(iter(UNITS))}]")
        for kind, term in self.terms.items():
            _require_fit(kind, term)

    @property
    def terms(self) -> dict[str, Any]:
        """The errors that the place states, by kind."""
        return {kind: getattr(self, kind) for kind in UNITS if getattr(self, kind) is not None}

    def holds(self, lobe: str, generation: int) -> bool:
        """Tell whether the place contains an airway of a lobe, by its whole name, and of a generation."""
        here = not self.lobe or LOBES[lobe_named(self.lobe)] == lobe
        return here and self.generation_from <= generation <= self.generation_to


@settings
class ErrorModel:
    """How large the errors of devices, patient and images are; independent of each other.

    Without arguments there is no error at all; `load_errors` reads the presets, which state their sources.

    Args:
        scope_position: Position of the scope tip, along each axis.
        tube_rotation: Rotation of planar tubes together, or of each tube that is not planar.
        needle_roll: Angle of the needle about its axis at each arc.
        needle_insertion: Insertion at which each arc ends.
        target_position: Position of the target, along each axis.
        vessel_border: How far the vessels reach out of their masks, all of them alike; where it is 0, it is
            what the patient's own segmentation states, see `uncertainty.risk.patient_errors.model_for`.
        wall: What is known of the contact of shaft and wall, which errors of the distribution "resting" need;
            see `lungaccess.uncertainty.risk.patient_errors`.
        place: Other errors by the place of the scope's tip; of several that hold the last one counts.

    Raises:
        SettingsError: If a value is not finite, negative or absurd, a bias has not as many numbers as `AXES`
            says, or errors are about the resting shaft and no wall is stated.
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
    vessel_border: PositionError = PositionError()
    wall: WallContact | None = field(default=None, metadata={LEFT_OUT_IF_EMPTY: True})
    place: tuple[Place, ...] = _optional()

    def __post_init__(self) -> None:
        for kind in UNITS:
            _require_fit(kind, self.term(kind))
        if self.wall is None and self.rests:
            raise impossible("wall", None, f"the table [wall], which errors of distribution {RESTING!r} need")

    @property
    def rests(self) -> bool:
        """Whether errors are about where the scope's shaft rests, anywhere."""
        stated = [*map(self.term, UNITS), *(term for each in self.place for term in each.terms.values())]
        return any(term.distribution == RESTING for term in stated)

    def at(self, lobe: str, generation: int) -> "ErrorModel":
        """Return the model of a place of the scope's tip: its lobe, "" if not known, and its generation."""
        terms: dict[str, Any] = {}
        for each in self.place:
            terms |= each.terms if each.holds(lobe, generation) else {}
        return replace(self, place=(), **terms)

    def term(self, kind: str) -> Term:
        """Return the error of a kind, by its name in `UNITS`."""
        found: Term = getattr(self, kind)
        return found

    def only(self, kind: str, size: float | None = None) -> "ErrorModel":
        """Return the model with errors of one kind only, scaled to a size if one is given."""
        term = self.term(kind)
        kept: dict[str, Any] = {kind: term if size is None else term.sized(size)}
        return ErrorModel(wall=self.wall, **kept)

    def scaled(self, factor: float) -> "ErrorModel":
        """Return the model with all sizes multiplied by a factor."""
        terms: dict[str, Any] = {kind: self.term(kind).scaled(factor) for kind in UNITS}
        places = (
            replace(each, **{kind: term.scaled(factor) for kind, term in each.terms.items()})
            for each in self.place
        )
        return replace(self, place=tuple(places), **terms)

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
        biased = [kind for kind in AXES if self.term(kind).bias and (with_needle or kind not in OF_NEEDLE)]
        means = ", ".join(f"{kind.replace('_', ' ')} {_listed(self.term(kind))}" for kind in biased)
        size = {kind: self.term(kind).size for kind in UNITS}
        straight = self.needle_curvature.straight_share
        of_needle = (
            f"needle {size['needle_insertion']:g} mm and {size['needle_roll']:g}°, its curvature "
            f"{100.0 * size[CURVATURE]:.0f} %{f' ({100.0 * straight:g} % go straight)' if straight else ''}, "
        )
        breathing = f", breathing {size[BREATHING]:.1f} mm" if size[BREATHING] else ""
        border = f", border of vessels {size[VESSEL_BORDER]:.1f} mm" if size[VESSEL_BORDER] else ""
        return (
            f"scope tip {size['scope_position']:g} mm and {size['scope_direction']:g}°, "
            f"tubes {size['tube_insertion']:g} mm and {size['tube_rotation']:g}°, "
            f"{of_needle if with_needle else ''}target {size['target_position']:g} mm{breathing}{border}"
            f"{f', bias of {means}' if means else ''}"
            f"{', about where the shaft rests on the wall' if self.rests else ''}"
            f"{', others in some places' if self.place else ''}"
        )


def _listed(term: Term) -> str:
    """Return the bias of a term in words."""
    return " / ".join(f"{each:g}" for each in term.bias) + {"deg": "°"}.get(term.unit, f" {term.unit}")


def with_known(errors: ErrorModel, kind: str, size: float) -> ErrorModel:
    """Return a model in which a kind of error has another size everywhere; else SettingsError."""
    if kind not in UNITS:
        raise SettingsError(
            f"There is no kind of error {kind!r}",
            expected=f"one of {', '.join(UNITS)}",
            remedy=did_you_mean(kind, UNITS),
        )
    left = [each for each in errors.place if each.terms.keys() != {kind}]
    nothing: dict[str, Any] = {kind: None}
    known: dict[str, Any] = {kind: errors.term(kind).sized(size)}
    return replace(errors, place=tuple(replace(each, **nothing) for each in left), **known)

"""The headline of a plan: whether its geometry was accepted, and how likely it succeeds, always together."""

from __future__ import annotations

import math
from enum import StrEnum
from typing import TYPE_CHECKING

from anatomy.lobes import FISSURES_UNKNOWN
from anatomy.records import frozen_value
from anatomy.words import plural
from lungaccess.appraisal.grade import Grade, grade_of_chance
from lungaccess.risk.assessment import MISSES

if TYPE_CHECKING:
    from lungaccess.checking import CheckReport
    from lungaccess.risk import RiskReport, Share

FAILURES = {
    "vessel": "touches a vessel",
    "pleura": "touches the pleura",
    "fissure": "touches a fissure",
    "airway": "touches an airway",
    "stays in the airway": "stays in the airway",
}
"""What a failed draw does, by the names of `lungaccess.risk.STRUCTURES`."""


class Geometry(StrEnum):
    """What is known of the geometry of a plan."""

    PROVED = "proved and checked"
    """The planner proved it, and the independent check accepts it."""
    REFUSED = "refused"
    """The independent check refuses it."""
    UNCHECKED = "not checked"


@frozen_value
class Headline:
    """The verdict of the check and the chance of success of one plan.

    Parameters
    ----------
    geometry : Geometry
    refusals : int
        Findings of the check that are not ok.
    risk : RiskReport or None
        The estimate of success; None if there is none, as for a refused plan.
    fissures_unknown : bool
        Whether fissures must not be crossed, and the patient has no mask of them.
    """

    geometry: Geometry
    refusals: int = 0
    risk: RiskReport | None = None
    fissures_unknown: bool = False

    @classmethod
    def of(cls, report: CheckReport | None, risk: RiskReport | None) -> Headline:
        """Return the headline of a check, or of none, and of an estimate, or of none."""
        if report is None:
            return cls(geometry=Geometry.UNCHECKED, risk=risk)
        geometry = Geometry.PROVED if report.accepted else Geometry.REFUSED
        unknown = any(each.name == "patient.fissures" for each in report.unchecked)
        return cls(geometry=geometry, refusals=len(report.refusals), risk=risk, fissures_unknown=unknown)

    @property
    def success(self) -> Share | None:
        """The chance of success; None where it was not estimated."""
        return None if self.risk is None else self.risk.succeeds

    @property
    def grade(self) -> Grade:
        """The worse of geometry and chance of success: accepted geometry alone is never good."""
        of_geometry = {
            Geometry.PROVED: Grade.UNKNOWN if self.fissures_unknown else Grade.GOOD,
            Geometry.UNCHECKED: Grade.UNKNOWN,
            Geometry.REFUSED: Grade.POOR,
        }[self.geometry]
        return max(of_geometry, grade_of_chance(self.success))

    @property
    def verdict(self) -> str:
        """The grade in words."""
        if self.geometry == Geometry.REFUSED:
            return "refused: do not use"
        if self.grade == Grade.UNKNOWN:
            return "not known to succeed"
        return {Grade.GOOD: "likely to succeed", Grade.FAIR: "may fail", Grade.POOR: "likely to fail"}[
            self.grade
        ]

    @property
    def failures(self) -> tuple[tuple[str, Share], ...]:
        """The most frequent failure in words, and the most frequent touch if that is another one."""
        if self.risk is None:
            return ()
        happened = [(name, share) for name, share in self.risk.failures if share.count]
        touches = [each for each in happened if each[0] != MISSES]
        first = happened[:1]
        chosen = first + ([touches[0]] if touches and first[0][0] == MISSES else [])
        return tuple((self._failure(name), share) for name, share in chosen)

    def _failure(self, name: str) -> str:
        if name == MISSES and self.risk is not None:
            return f"ends more than {self.risk.radius_mm:.1f} mm from the target"
        return FAILURES[name]

    @property
    def text(self) -> str:
        """The headline in sentences: geometry first, then the chance of success and what fails most often."""
        return f"{self._geometry()} {self._chance()}"

    def _geometry(self) -> str:
        if self.geometry == Geometry.REFUSED:
            return f"Refused by the independent check ({plural(self.refusals, 'finding')})."
        return f"{self.geometry_words.capitalize()}."

    @property
    def geometry_words(self) -> str:
        """What is known of the geometry, and that fissures are not checked where they are not known."""
        missing = f", fissures not checked: {FISSURES_UNKNOWN}" if self.fissures_unknown else ""
        return f"geometry {self.geometry}{missing}"

    def _chance(self) -> str:
        if self.risk is None:
            return "Chance of success not estimated."
        low, high = self.risk.succeeds.interval
        words = (
            f"Estimated to succeed in {of_hundred(self.risk.succeeds.value)} of 100 (95 % interval "
            f"{of_hundred(low)} to {of_hundred(high, up=True)}) under the errors of '{self.risk.model.label}'"
        )
        failures = " and ".join(
            f"{name} ({of_hundred(share.value, up=True)} of 100)" for name, share in self.failures
        )
        return f"{words}; most often {failures}." if failures else f"{words}; no draw failed."

    @property
    def chance_words(self) -> str:
        """The chance of success alone, for the cell of a table."""
        if self.risk is None:
            return "not estimated"
        low, high = self.risk.succeeds.interval
        interval = f"{of_hundred(low)} to {of_hundred(high, up=True)}"
        return f"{of_hundred(self.risk.succeeds.value)} of 100 ({interval})"

    @property
    def details(self) -> tuple[str, ...]:
        """What the estimate rests on, in sentences: draws, what counts as success, and the errors' sizes."""
        if self.risk is None:
            return ()
        model, label = self.risk.model, self.risk.model.label
        sizes = model.words(with_needle=self.risk.with_needle)
        last = "needle ends" if self.risk.with_needle else "tubes end"
        assumed = ", ".join(kind.replace("_", " ") for kind in model.assumed)
        return (
            f"{plural(self.risk.samples, 'draw')}, seed {self.risk.seed}; the devices are not corrected on "
            "their way.",
            f"Success: the {last} within {self.risk.radius_mm:.1f} mm of the target "
            f"({self.risk.radius_origin}) and nothing forbidden is touched.",
            f"Errors of '{label}': {sizes}. Assumed, with no published source: {assumed or 'none'}.",
        )

    def to_mapping(self) -> dict[str, object]:
        """Return the headline as plain JSON values; None where something was not estimated."""
        from anatomy.settings import to_mapping

        risk = self.risk
        first = self.failures[:1]
        return {
            "text": self.text,
            "grade": self.grade.key,
            "verdict": self.verdict,
            "geometry": str(self.geometry),
            "fissures_unknown": self.fissures_unknown,
            "success": None if risk is None else _share(risk.succeeds),
            "most_frequent_failure": {"what": first[0][0], **_share(first[0][1])} if first else None,
            "failures": None if risk is None else {name: _share(share) for name, share in risk.failures},
            "draws": None if risk is None else risk.samples,
            "seed": None if risk is None else risk.seed,
            "goal_radius_mm": None if risk is None else risk.radius_mm,
            "goal_radius_origin": None if risk is None else risk.radius_origin,
            "errors": None if risk is None else {**to_mapping(risk.model), "name": risk.model.label},
            "errors_assumed": None if risk is None else list(risk.model.assumed),
        }


def _share(share: Share) -> dict[str, object]:
    return {"probability": share.value, "interval_95": list(share.interval)}


def of_hundred(probability: float, *, up: bool = False) -> str:
    """Return a probability as a number of 100, rounded down, or up where the greater number is the worse.

    Near 0 and 100 it has one decimal, so that neither is stated where it does not hold.

    Examples
    --------
    >>> of_hundred(0.0065), of_hundred(0.428), of_hundred(0.9996), of_hundred(0.428, up=True)
    ('0.6', '42', '99.9', '43')
    """
    steps = 1.0 if 0.1 <= probability <= 0.9 else 10.0
    exact = round(100.0 * steps * probability, 6)
    return f"{(math.ceil(exact) if up else math.floor(exact)) / steps:g}"

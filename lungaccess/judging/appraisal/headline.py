"""The headline of a plan: how likely it succeeds, and whether its geometry was accepted, always together."""

from enum import IntEnum, StrEnum

from anatomy.base.records import frozen_value
from anatomy.base.settings import to_mapping
from anatomy.base.words import of_hundred, plural, range_of_hundred
from lungaccess.judging.checking import CheckReport
from lungaccess.judging.checking.outcome import NEEDLE_LOAD
from lungaccess.planning.procedure.report import NO_PATH
from lungaccess.planning.success.estimate import Estimate, chance_of
from lungaccess.plans.chance import Chance
from lungaccess.uncertainty.risk.assessment import MISSES
from lungaccess.uncertainty.risk.statistics import Share

GOOD_FROM = 0.90
"""From here on fewer than one procedure in ten has to be repeated or fails."""
FAIR_FROM = 0.50
"""Below this a plan fails more often than it succeeds."""


class Grade(IntEnum):
    """How good the news is; of several parts, the greatest value, the worst part, holds for the whole."""

    GOOD = 0
    FAIR = 1
    UNKNOWN = 2
    """Something was not checked or not estimated: worse than fair, because nothing is known."""
    POOR = 3

    @property
    def mark(self) -> str:
        """A character that tells the grade without its colour."""
        return "✓!?✗"[self]

    @property
    def colour(self) -> str:
        """A colour for pictures and notebooks, dark enough for white paper."""
        return ("#00704A", "#8A5A00", "#8A5A00", "#B00020")[self]

    @property
    def key(self) -> str:
        """The grade in JSON and in style sheets."""
        return self.name.lower()


def grade_of_chance(success: Share | None) -> Grade:
    """Return the grade of a chance of success, by the lower end of its 95 % interval.

    The lower end decides, so that few draws cannot make a grade better than many would.
    """
    if success is None:
        return Grade.UNKNOWN
    low, _high = success.interval
    if low >= GOOD_FROM:
        return Grade.GOOD
    return Grade.FAIR if low >= FAIR_FROM else Grade.POOR


FAILURES = {
    "vessel": "touches a vessel", "pleura": "touches the pleura", "fissure": "touches a fissure",
    "airway": "touches an airway", "stays in the airway": "stays in the airway", NO_PATH: "has no path left",
}  # fmt: skip
"""The failures in words, by the names of `lungaccess.uncertainty.risk.STRUCTURES` and `NO_PATH`."""

BESIDE_TARGET = (
    "The plan was made for a window of the breath: in the phase of the masks it ends beside the target."
)


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

    Args:
        refusals: Findings of the check that are not ok.
        estimate: The estimate of success, or what the plan states of one; None if there is none, as for a
            refused plan.
        fissures_unknown: Why fissures are not checked; empty if they are, or may be crossed.
        fissure_chance: With what chance a fissure is crossed, as far as that is known.
        needle_load: What the needle does to the tubes that aim it, where the plan does not count it; empty
            where nothing.
        without_measuring: How often the plan succeeds in open loop, where the estimate is of a procedure that
            measures.
        has_aim: Whether the plan was made for a window of the breath, and ends beside the target of the
            masks' phase.
    """

    geometry: Geometry
    refusals: int = 0
    estimate: Estimate | None = None
    fissures_unknown: str = ""
    fissure_chance: float | None = None
    needle_load: str = ""
    without_measuring: Share | None = None
    has_aim: bool = False

    @classmethod
    def of(
        cls, report: CheckReport | None, estimate: Estimate | None, without_measuring: Share | None = None
    ) -> "Headline":
        """Return the headline of a check, or of none, and of an estimate, or of none."""
        if report is None:
            return cls(geometry=Geometry.UNCHECKED, estimate=estimate)
        geometry = Geometry.PROVED if report.accepted else Geometry.REFUSED
        unchecked = {each.name: each.detail for each in report.unchecked}
        chances = {each.name: each.value for each in report.findings}
        return cls(
            geometry=geometry,
            refusals=len(report.refusals),
            estimate=estimate,
            fissures_unknown=unchecked.get("patient.fissures", ""),
            fissure_chance=chances.get("fissure.chance"),
            needle_load=unchecked.get(NEEDLE_LOAD, ""),
            without_measuring=without_measuring,
            has_aim=any(each.name == "window.of_aim" for each in report.findings),
        )

    @property
    def chance(self) -> Chance | None:
        """What was counted; None where nothing was."""
        return None if self.estimate is None else chance_of(self.estimate)

    @property
    def success(self) -> Share | None:
        """The chance of success; None where it was not computed."""
        chance = self.chance
        return None if chance is None else Share(count=chance.successes, samples=chance.samples)

    @property
    def grade(self) -> Grade:
        """The worse of geometry and chance of success: accepted geometry alone is never good."""
        return max(self.geometry_grade, grade_of_chance(self.success))

    @property
    def geometry_grade(self) -> Grade:
        """The grade of the geometry: it is not known where something that decides it is not counted."""
        return {
            Geometry.PROVED: Grade.UNKNOWN if self.not_counted else Grade.GOOD,
            Geometry.UNCHECKED: Grade.UNKNOWN,
            Geometry.REFUSED: Grade.POOR,
        }[self.geometry]

    @property
    def not_counted(self) -> tuple[str, ...]:
        """What the geometry leaves out, in words: fissures that are not known, the load of the needle."""
        missing = (("fissures", self.fissures_unknown), ("needle's load", self.needle_load))
        return tuple(name for name, is_missing in missing if is_missing)

    @property
    def verdict(self) -> str:
        """The grade in words."""
        if self.geometry == Geometry.REFUSED:
            return "refused: do not use"
        return ("likely to succeed", "may fail", "not known to succeed", "likely to fail")[self.grade]

    @property
    def all_failures(self) -> dict[str, Share]:
        """Everything that made procedures fail, by its name, the most frequent first."""
        chance = self.chance
        if chance is None:
            return {}
        counts = sorted(chance.failures.items(), key=lambda item: (-item[1], item[0] != MISSES))
        return {name: Share(count=count, samples=chance.samples) for name, count in counts}

    @property
    def failures(self) -> tuple[tuple[str, Share], ...]:
        """The most frequent failure in words, and the most frequent touch if that is another one."""
        happened = [(name, share) for name, share in self.all_failures.items() if share.count]
        touches = [each for each in happened if each[0] != MISSES]
        first = happened[:1]
        chosen = first + ([touches[0]] if touches and first[0][0] == MISSES else [])
        return tuple((self._failure(name), share) for name, share in chosen)

    def _failure(self, name: str) -> str:
        chance = self.chance
        if name == MISSES and chance is not None:
            far = f"ends more than {chance.radius_mm:.1f} mm from the target"
            return f"ends without {chance.tissue}" if chance.tissue else far
        return FAILURES[name]

    @property
    def text(self) -> str:
        """The headline in sentences: how often it succeeds and why it fails, and its geometry.

        A refusal stands first: such a plan has no chance.
        """
        if self.geometry == Geometry.REFUSED:
            return f"{self.reasons.capitalize()}. {self.chance_text}"
        return f"{self.chance_text} {self.geometry_words.capitalize()}."

    @property
    def geometry_words(self) -> str:
        """What is known of the geometry, and what is not checked."""
        missing = f", fissures not checked: {self.fissures_unknown}" if self.fissures_unknown else ""
        if self.fissure_chance:
            missing += f", fissure crossed in {of_hundred(self.fissure_chance, up=True)} of 100"
        load = f", needle's load not counted: {self.needle_load}" if self.needle_load else ""
        return f"geometry {self.geometry}{missing}{load}"

    @property
    def reasons(self) -> str:
        """Why the verdict is what it is, in one sentence without its full stop: failures and geometry."""
        if self.geometry == Geometry.REFUSED:
            return f"refused by the independent check ({plural(self.refusals, 'finding')})"
        chance = "chance of success not computed" if self.success is None else self._why
        return f"{chance}; {self.geometry_words}"

    @property
    def _why(self) -> str:
        """Why procedures fail most often, with the numbers."""
        failures = " and ".join(
            f"{name} ({of_hundred(share.value, up=True)} of 100)" for name, share in self.failures
        )
        return f"fails most because it {failures}" if failures else "none of them failed"

    @property
    def chance_text(self) -> str:
        """How often the plan succeeds, why it fails, and under what, in sentences."""
        chance, success = self.chance, self.success
        if chance is None or success is None:
            return "Chance of success not computed."
        open_loop = self.without_measuring
        means = f", that is to have {chance.tissue}" if chance.tissue else ""
        left = "" if open_loop is None else f" Without measuring: {of_hundred(open_loop.value)} of 100."
        return (
            f"Estimated to succeed in {of_hundred(success.value)} of 100 procedures (95 % interval "
            f"{range_of_hundred(success.interval)}){means}; {self._why}. "
            f"Procedure '{chance.procedure}', errors of '{chance.errors}'.{left}"
        )

    @property
    def chance_words(self) -> str:
        """The chance of success alone, for the cell of a table."""
        if self.success is None:
            return "not computed"
        return f"{of_hundred(self.success.value)} of 100 ({range_of_hundred(self.success.interval)})"

    @property
    def details(self) -> tuple[str, ...]:
        """What the estimate rests on, in sentences: draws, what counts as success, and the errors' sizes."""
        chance = self.chance
        if chance is None:
            return ()
        drawn = f"{plural(chance.samples, 'draw')}, seed {chance.seed}"
        if self.is_stated:
            drawn += ", which its search never saw; as the plan states, not computed again"
        assumed = ", ".join(kind.replace("_", " ") for kind in chance.assumed)
        return (
            f"{drawn}. {chance.corrections}",
            f"Success: {chance.success_words} and nothing forbidden is touched.",
            *((BESIDE_TARGET,) if self.has_aim else ()),
            f"Errors of '{chance.errors}': {chance.sizes}. Assumed, with no published source: "
            f"{assumed or 'none'}.",
        )

    @property
    def is_stated(self) -> bool:
        """Whether the chance is that which the plan states."""
        return isinstance(self.estimate, Chance)

    def to_mapping(self) -> dict[str, object]:
        """Return the headline as plain JSON values; None where something was not computed."""
        chance, first = self.chance, self.failures[:1]
        open_loop = self.without_measuring
        counted = {name: share.to_mapping() for name, share in self.all_failures.items()}
        return {
            "text": self.text,
            "grade": self.grade.key,
            "verdict": self.verdict,
            "geometry": str(self.geometry),
            "fissures_unknown": bool(self.fissures_unknown),
            "fissure_chance": self.fissure_chance,
            "needle_load": self.needle_load or None,
            "success": None if self.success is None else self.success.to_mapping(),
            "without_measuring": None if open_loop is None else open_loop.to_mapping(),
            "stated_by_plan": self.is_stated,
            "most_frequent_failure": {"what": first[0][0], **first[0][1].to_mapping()} if first else None,
            "failures": None if chance is None else counted,
            "draws": None if chance is None else chance.samples,
            "seed": None if chance is None else chance.seed,
            "counts_as_success": None if chance is None else chance.success_words,
            "goal_radius_mm": None if chance is None else chance.radius_mm,
            "goal_radius_origin": None if chance is None else chance.radius_origin,
            "procedure": None if chance is None else chance.procedure,
            "errors": None if chance is None else _errors(chance, self.estimate),
            "errors_assumed": None if chance is None else list(chance.assumed),
        }


def _errors(chance: Chance, estimate: Estimate | None) -> dict[str, object]:
    """Return the error model by its keys, or of what a plan states its name and sizes."""
    if estimate is None or isinstance(estimate, Chance):
        return {"name": chance.errors, "sizes": chance.sizes}
    return {**to_mapping(estimate.model), "name": chance.errors}

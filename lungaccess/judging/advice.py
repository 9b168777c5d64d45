"""What would lift the chance of success of a plan: tried, each by itself, and never guessed."""

from collections.abc import Callable, Iterator

import numpy as np

from anatomy.base.kernel_clock import working_s
from anatomy.base.records import frozen_value
from anatomy.base.words import of_hundred
from anatomy.lung import Lung
from lungaccess.judging.appraisal import Appraisal
from lungaccess.judging.checking import Checker
from lungaccess.planning import run
from lungaccess.planning.coupled import Atlas
from lungaccess.planning.success import chance_of, estimate_success
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import RESTING, UNITS, ErrorModel, with_known
from lungaccess.problem.procedures import Procedure, load_procedure, procedure_names
from lungaccess.problem.request import Limits, Request
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from lungaccess.uncertainty.risk import Share

GOOD = 0.9
"""A plan that succeeds so often is left without advice."""
DRAWS, SIMULATED = 2000, 250
"""Draws of each trial in open loop, and procedures of one that measures: a half is known to 1 and 3 %."""
PASSES = 3
"""So many passes are tried."""
KNOWN = {
    "scope_position": 0.5, "scope_direction": 0.5, "tube_rotation": 1.0, "tube_insertion": 0.2,
    "needle_curvature": 0.05, "needle_roll": 2.0, "needle_insertion": 0.3, "target_position": 0.5,
    "breathing": 1.0,
}  # fmt: skip
"""Sizes of errors that careful calibration or tracking is taken to reach, an assumption of each kind, in mm,
degrees or, of the curvature, its logarithm."""


@frozen_value
class Advice:
    """One thing that lifts the chance: what succeeds with it on trial, and the words `plan` needs for it."""

    words: str
    success: Share
    options: tuple[str, ...]

    @property
    def sentence(self) -> str:
        """The advice as a sentence."""
        return f"With {self.words}: {of_hundred(self.success.value)} of 100."

    def to_mapping(self) -> dict[str, object]:
        """Return plain JSON values."""
        return {"words": self.words, **self.success.to_mapping(), "options": list(self.options)}


class _Adviser:
    """Tries what could lift the chance of a plan; see `advise`."""

    def __init__(
        self,
        plan: Plan,
        lung: Lung,
        errors: ErrorModel | None,
        procedure: Procedure | None,
        atlas_of: Callable[[System], Atlas | None],
        systems: tuple[System, ...],
    ) -> None:
        self._plan, self._lung, self._atlas_of, self._systems = plan, lung, atlas_of, systems
        self._errors = errors or load_errors()
        self._procedure = procedure or load_procedure()
        self._checker = Checker(lung)

    def trials(self) -> Iterator[Advice | None]:
        """Yield what each trial shows, the quickest trials first; None where there is nothing to show."""
        yield from self._passes()
        yield from self._errors_known()
        yield from self._procedures()
        yield from self._points()
        yield from self._presets()

    def _estimated(self, plan: Plan, errors: ErrorModel, procedure: Procedure) -> Share:
        samples = DRAWS if procedure.is_open_loop else SIMULATED
        return estimate_success(
            plan, self._lung, errors=errors, procedure=procedure, samples=samples, seed=plan.seed
        ).succeeds

    def _errors_known(self) -> Iterator[Advice]:
        for kind, size in KNOWN.items():
            term = self._errors.term(kind)
            if term.size <= size and term.distribution != RESTING:
                continue
            unit = UNITS[kind] if UNITS[kind] != "ln" else "as a logarithm"
            yield Advice(
                words=f"{kind.replace('_', ' ')} known to {size:g} {unit}",
                success=self._estimated(self._plan, with_known(self._errors, kind, size), self._procedure),
                options=("--known", f"{kind}={size:g}"),
            )

    def _procedures(self) -> Iterator[Advice]:
        for name in procedure_names():
            other = load_procedure(name)
            if name == self._procedure.name or other.is_open_loop:
                continue
            yield Advice(
                words=f"procedure {name}, {other.description[:1].lower()}{other.description[1:].rstrip('.')}",
                success=self._estimated(self._plan, self._errors, other),
                options=("--procedure", name),
            )

    def _passes(self) -> Iterator[Advice | None]:
        """Try more passes of the tool: planned together, or at the same point where no atlas is at hand."""
        plan = self._plan
        target = Target(lps_mm=plan.target_lps, origin=plan.target_origin)
        for count in range(len(plan.passes) + 1, PASSES + 1) if plan.system.tool is not None else ():
            found = self._planned(plan.system, target, count) or plan.with_further([plan] * (count - 1))
            yield self._of_plan(found, f"{count} passes", ("--passes", str(count)))

    def _points(self) -> Iterator[Advice | None]:
        """Try other points of the nodule."""
        nodules, plan = self._lung.nodules, self._plan
        if nodules is None or not plan.target_origin.startswith("nodule"):
            return
        radius_mm = 5.0 if plan.chance is None else plan.chance.radius_mm
        for offset in np.concatenate([np.eye(3), -np.eye(3)]):
            # Other points of a nodule lie so far from its centre, as a share of its radius.
            point = plan.target_lps + 0.5 * radius_mm * offset
            if not nodules.at(point, False):
                continue
            found = self._planned(plan.system, Target(lps_mm=point, origin=plan.target_origin))
            text = ",".join(f"{value:.1f}" for value in point)
            yield self._of_plan(
                found, f"another point of the nodule, lps:{text}", ("--target", f"lps:{text}")
            )

    def _presets(self) -> Iterator[Advice | None]:
        plan = self._plan
        target = Target(lps_mm=plan.target_lps, origin=plan.target_origin)
        added = f" ({plan.system.tool.name})" if plan.system.tool is not None else ""
        for system in self._systems:
            if system.name != plan.system.name:
                options = ("--system", system.name.removesuffix(added))
                yield self._of_plan(self._planned(system, target), f"device {system.name}", options)

    def _of_plan(self, found: Plan | None, words: str, options: tuple[str, ...]) -> Advice | None:
        if found is None or not self._checker.check(found).accepted:
            return None
        success = self._estimated(found, self._errors, self._procedure)
        return Advice(words=words, success=success, options=options)

    def _planned(self, system: System, target: Target, passes: int = 1) -> Plan | None:
        """Return the plan of a short search for success, None without one or where no atlas is at hand."""
        atlas = self._atlas_of(system)
        if atlas is None:
            return None
        request = Request(
            lung=self._lung, target=target, systems=(system,), errors=self._errors, passes=passes,
            # Seconds of the search with another device or to another point.
            procedure=load_procedure(), seed=self._plan.seed, limits=Limits(time_s=0.6),
        )  # fmt: skip
        try:
            *_, best = run(request, atlas=atlas, counterfactuals=False)
        except NoPlan:
            return None
        return best


def advise(
    plan: Plan,
    lung: Lung,
    appraisal: Appraisal,
    *,
    errors: ErrorModel | None = None,
    procedure: Procedure | None = None,
    atlas_of: Callable[[System], Atlas | None] = lambda _system: None,
    systems: tuple[System, ...] = (),
    # Seconds that all trials may take.
    time_s: float = 5.0,
) -> tuple[Advice, ...]:
    """Return what lifts the chance of success of a plan most, the best first; nothing for a good plan.

    Errors that are known better, procedures, other points of the nodule and presets are tried one by one,
    under the same errors and procedure otherwise, until the time is up.

    Args:
        appraisal: Of the plan: an accepted one whose chance of success is known.
        atlas_of: Returns the atlas of a system if it is at hand, else None: making one takes too long.
    """
    success = appraisal.headline.success
    if success is None or success.value >= GOOD:
        return ()
    chance = None if appraisal.risk is None else chance_of(appraisal.risk)
    if not procedure and chance and chance.procedure in procedure_names():
        procedure = load_procedure(chance.procedure)
    began, found = working_s(), []
    for each in _Adviser(plan, lung, errors, procedure, atlas_of, systems).trials():
        # A chance that is higher by less than this may be so by the luck of the draws.
        if each is not None and each.success.value > success.value + 0.03:
            found.append(each)
        if working_s() - began > time_s:
            break
    # So many pieces of advice are given, the best first.
    return tuple(sorted(found, key=lambda each: -each.success.value)[:5])

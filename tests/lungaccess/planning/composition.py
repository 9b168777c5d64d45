"""Every goal with every constraint and kind of system: what is done, and what is refused and why.

`python -m tests.lungaccess.planning.composition` writes docs/reference/composition.md.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import lungaccess as la
from anatomy.base.errors import SettingsError, TargetError
from anatomy.build import build_lung
from anatomy.lung import Lung
from anatomy.phantom import make_phantom
from lungaccess.judging import answer, answer_with_several
from lungaccess.planning.coupled.search.direct_candidates import direct_candidates
from lungaccess.planning.driver import holds
from lungaccess.planning.success import finder, ratings
from lungaccess.problem.request import Request, StatedPlace
from lungaccess.problem.system import System, load_system
from lungaccess.problem.target import Target, point_target
from lungaccess.problem.task import Task
from tests.lungaccess.conftest import breathing
from tests.lungaccess.planning.coupled.planning import KUNTZ_SEED, KUNTZ_TARGET
from tests.lungaccess.two_curved_tubes import COARSE, two_curved_tubes

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "composition.md"
DONE = "done"
OFF_MM = np.array([0.7, -0.9, 0.5])
"""Targets lie so far from tips of the atlas: not where the enumeration ends."""


def scope_depth_mm(plan: la.Plan, _lung: Lung) -> float:
    """A function of one's own: how deep the scope goes."""
    return float(plan.scope.length_from_carina_mm)


OPEN_LOOP = {"procedure": la.load_procedure("open-loop")}
GOALS: dict[str, dict[str, Any]] = {
    "a cost": {"goal": "default"},
    "a weighted sum": {"goal": "tissue=1,length=0.5"},
    "success, open loop": {"goal": "success", **OPEN_LOOP},
    "success, measuring": {"goal": "success", "procedure": la.load_procedure("measured-tip")},
    "window": {"goal": "window"},
    "a function": {"goal": scope_depth_mm},
}
SYSTEMS = ("planar tubes and needle", "planar tubes alone", "twisted tubes and needle", "twisted tubes alone")
CONSTRAINTS = (
    "none", "phases", "exit", "scope tip", "fissures", "least clearance", "gap", "two processes", "kuntz2015",
    "several systems",
)  # fmt: skip
COMMANDS = ("plan", "alternatives")
FEW = ratings.Rounds(pool=4, of_a_tip=2, draws=(32,), kept=(), fresh=32)
FEWER = ratings.Rounds(pool=1, of_a_tip=1, draws=(4,), kept=(), fresh=4)
"""So few candidates and draws show whether a cell can be done."""


@dataclass(frozen=True)
class Cell:
    """One combination."""

    goal: str
    constraint: str
    system: str
    command: str


def cells() -> Iterator[Cell]:
    """Yield all combinations."""
    for goal, constraint, system, command in product(GOALS, CONSTRAINTS, SYSTEMS, COMMANDS):
        yield Cell(goal, constraint, system, command)


class Table:
    """Runs cells on a small lung that breathes."""

    def __init__(self, lung: Lung) -> None:
        self.lung = lung
        self._atlases: dict[Any, la.Atlas] = {}

    @cache  # noqa: B019  # One table in a process.
    def case(self, name: str) -> tuple[System, la.Atlas, Target]:
        """Return a kind of system with its atlas and a target that it reaches in many ways."""
        thin = load_system("ultrathin")
        scope, twisted = replace(thin.scope, outer_diameter_mm=2.0), two_curved_tubes()
        systems = {
            SYSTEMS[0]: thin,
            SYSTEMS[1]: replace(thin, name="tubes", scope=scope, needle=None, fissures_allowed=True),
            SYSTEMS[2]: twisted,
            SYSTEMS[3]: replace(twisted, name="twisted alone", needle=None),
        }
        atlas = self.atlas_of(systems[name])
        return systems[name], atlas, self._best_target(systems[name], atlas)

    def atlas_of(self, system: System) -> la.Atlas:
        """Return a coarse atlas of a system, made once for equal tubes, margins and rules."""
        key = (system.scope, system.tubes, system.margins, system.fissures_allowed)
        if key not in self._atlases:
            planar = {"rotations": 12, "stop_spacing_mm": 4.0}
            self._atlases[key] = la.build_atlas(
                self.lung, system, **(planar if system.tubes.planar else COARSE)
            )
        return replace(self._atlases[key], system=system)

    def _best_target(self, system: System, atlas: la.Atlas) -> Target:
        if system.name == "ultrathin":
            return la.resolve_target(self.lung, KUNTZ_TARGET)
        found: list[tuple[int, Target]] = []
        for entry in np.linspace(0, atlas.deployments.count - 1, 30).astype(int):
            try:
                goal = point_target(self.lung, atlas.deployments.positions[entry] + OFF_MM)
            except TargetError:
                continue
            task = Task(lung=self.lung, system=system, target=goal)
            found.append((len(direct_candidates(task, atlas).clear()), goal))
        return max(found, key=lambda each: each[0])[1]

    @cache  # noqa: B019  # One table in a process.
    def _any_plan(self, name: str) -> la.Plan:
        system, atlas, target = self.case(name)
        return list(la.plan(self.lung, system, target, goal="default", atlas=atlas, iterations=0))[-1]

    def asked(self, cell: Cell) -> tuple[Any, dict[str, Any]]:
        """Return the system and the words of a request."""
        system, _atlas, _target = self.case(cell.system)
        words: dict[str, Any] = {"seed": KUNTZ_SEED, "iterations": 1, **GOALS[cell.goal]}
        match cell.constraint:
            case "phases":
                words["phases"] = (0.2, 0.6)
            case "exit":
                point = np.asarray(self._any_plan(cell.system).tube.exit.point_lps)
                words["place"] = StatedPlace(kind="exit", lps_mm=point, within_mm=6.0)
            case "scope tip":
                point = np.asarray(self._any_plan(cell.system).scope.lps_from_scope_tip)[:3, 3]
                words["place"] = StatedPlace(kind="scope tip", lps_mm=point, within_mm=3.0)
            case "fissures":
                words["fissures_allowed"] = True
            case "least clearance":
                words["least_clearance_mm"] = 1.1
            case "gap":
                words["gap"] = 50.0
            case "two processes":
                words["processes"] = 2
            case "kuntz2015":
                words |= {"method": "kuntz2015", "iterations": 3000}
            case "several systems":
                other = replace(system, name="another", description="the same by another name")
                return [system, other], words
        return system, words

    def run(self, cell: Cell) -> str:
        """Return DONE, or why a cell is refused; a plan has to be accepted and to keep its constraints."""
        _system, _atlas, target = self.case(cell.system)
        systems, words = self.asked(cell)
        ask: Callable[..., Any] = answer if cell.command == "plan" else answer_with_several
        few = mock.patch.multiple(
            ratings, OPEN_LOOP=FEW, MEASURED=FEWER, SCREENING=FEWER, EXACT=replace(ratings.EXACT, pool=4)
        )
        try:
            with few, mock.patch.object(finder, "BY_COST", 3000 if cell.constraint == "kuntz2015" else 5):
                request = Request.of(self.lung, systems, target, **words)
                found = list(ask(request, atlas_of=self.atlas_of, counterfactuals=False))
        except SettingsError as error:
            return error.found
        except la.NoPlan as failure:
            return f"NO PLAN: {failure}"
        plans = [getattr(each, "plan", each) for each in found]
        for plan in (plans[-1], plans[0]):
            report = la.check(plan, self.lung)
            assert report.accepted, [str(each) for each in report.refusals]
            assert holds(request, plan)
        if cell.command == "plan":
            assert request.goal.value(plans[-1]) is not None
        return DONE


def page(outcomes: dict[Cell, str]) -> str:
    """Return the page of a table: what is refused, then that all else is done."""
    reasons: dict[str, list[Cell]] = {}
    for cell, outcome in outcomes.items():
        if outcome != DONE:
            reasons.setdefault(outcome, []).append(cell)
    count = sum(outcome == DONE for outcome in outcomes.values())
    lines = [
        "# What goes together",
        "",
        "Goals, constraints and kinds of systems compose: "
        f"of {len(outcomes)} combinations on a small phantom that breathes {count} are done, "
        "each with a plan that the check accepts, and the others are refused or find no plan, for the "
        "reasons below. "
        "The table is made by `python -m tests.lungaccess.planning.composition`, and a test runs it.",
        "",
        f"- Goals: {'; '.join(GOALS)}.",
        f"- Constraints: {'; '.join(CONSTRAINTS)}.",
        f"- Systems: {'; '.join(SYSTEMS)}.",
        f"- Commands: {', '.join(COMMANDS)}. Studies, explorer, tour and reports hand over the same request.",
        "",
        "| not done | with | of the systems | why |",
        "|---|---|---|---|",
    ]
    for reason, refused in reasons.items():
        goals = _named([each.goal for each in refused], GOALS)
        constraints = _named([each.constraint for each in refused], CONSTRAINTS)
        systems = _named([each.system for each in refused], SYSTEMS)
        lines.append(f"| {goals} | {constraints} | {systems} | {reason} |")
    return "\n".join(lines) + "\n"


def _named(found: Iterable[str], of: Collection[str]) -> str:
    """Return the names in their order, each once, or that these are all."""
    names = dict.fromkeys(found)
    return "all" if names.keys() == set(of) else "; ".join(names)


def main() -> None:
    """Run all cells and write the page."""
    phantom = make_phantom(seed=3, size="small")
    table = Table(breathing(phantom, build_lung(phantom.images)))
    outcomes = {}
    for cell in cells():
        outcomes[cell] = table.run(cell)
        print(cell, outcomes[cell], flush=True)
    PAGE.write_text(page(outcomes), encoding="utf-8")


if __name__ == "__main__":
    main()

"""Explain why a search found no plan: part by part, the most useful first, until the time is spent."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, cast

from anatomy.base.kernel_clock import working_cpu_s
from anatomy.lung import Lung
from lungaccess.judging.answering import Attempt, first_attempt
from lungaccess.judging.appraisal import DRAWS, SEED
from lungaccess.judging.checking import Checker
from lungaccess.judging.explanation.blocking import arc_beyond_limits, look_along, map_starts
from lungaccess.judging.explanation.explanation import (
    DONE,
    NOT_TRIED,
    TIME_IS_UP,
    Change,
    Explanation,
    Part,
    Surroundings,
)
from lungaccess.planning import coupled
from lungaccess.planning.one_system import run
from lungaccess.planning.reachability import ReachVerdict, UnreachableProof
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.view import best_view_words
from lungaccess.problem.preset_order import least_invasive_first, presets_by_invasiveness
from lungaccess.problem.request import Limits, Request
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task, objective_of
from lungaccess.uncertainty.risk import assess
from stages.needle import DEFAULT, Objective, needle_environment

DEFAULT_TIME_S = 10.0
"""All parts of a patient whose atlases are cached take about so long, and a user still waits."""
NO_NEEDLE = "the system has no needle"

SHARED, KEPT, TO_BE_MADE = range(3)
"""The cost of a preset's atlas: nothing, as it is the system's own; a file to read; many seconds."""

AtlasOf = Callable[[System, Callable[[float], None]], coupled.Atlas]
IsKept = Callable[[System], bool]


class OutOfTime(Exception):  # noqa: N818
    """The time for the explanation is spent."""


def explain_no_plan(
    lung: Lung,
    system: System,
    target: Target,
    failure: NoPlan,
    *,
    atlas: coupled.Atlas | None = None,
    objective: str | Objective = DEFAULT,
    seed: int = 0,
    time_s: float | None = DEFAULT_TIME_S,
    atlas_of: AtlasOf | None = None,
    is_kept: IsKept | None = None,
    on_part: Callable[[str], None] | None = None,
) -> Explanation:
    """Return what can be learned from a search that found no plan.

    Each part does the same whenever it is done, so that the same input gives the same explanation as far as
    the time goes.  Parts that were not done are named in `Explanation.parts`.

    Args:
        atlas: The system's; made here if None.
        time_s: No part begins after so many seconds of processor time, and long ones end; None for no limit.
            Getting kernels does not count, and one preset is tried even if no time is left.
        atlas_of: Returns the atlas of a system, and tells a function the share of it made; `build_atlas` if
            None.
        is_kept: Tells whether `atlas_of` need not make the atlas of a system, as
            `lungaccess.planning.coupled.atlas_is_kept` does: such presets are tried first.  None is taken to
            be kept if it is not given.
    """
    own = atlas or coupled.build_atlas(lung, system)
    task = Task(lung=lung, system=system, target=target, objective=objective_of(lung, objective), seed=seed)
    made = Explainer(
        task, own, time_s,
        atlas_of or (lambda other, progress: coupled.build_atlas(lung, other, progress=progress)),
        is_kept or (lambda _system: False), on_part or (lambda _name: None),
    )  # fmt: skip
    return made.explanation(failure)


class Explainer:
    """Does the parts of one explanation, and keeps the time."""

    def __init__(
        self,
        task: Task,
        atlas: coupled.Atlas,
        time_s: float | None,
        atlas_of: AtlasOf,
        is_kept: IsKept,
        on_part: Callable[[str], None],
    ) -> None:
        self._began = working_cpu_s()
        self._task, self._atlas, self._time_s = task, atlas, time_s
        self._atlas_of, self._is_kept, self._on_part = atlas_of, is_kept, on_part
        self._at_any_time = False
        self._direct = coupled.direct_candidates(task, atlas)
        self._checker = Checker(task.lung)
        self._parts: list[Part] = []
        self._found: dict[str, Any] = {}

    def explanation(self, failure: NoPlan) -> Explanation:
        """Do all parts for which there is time, the most useful first."""
        own = self._task.system
        others = presets_by_invasiveness(fissures_allowed=own.fissures_allowed or None, tool=own.tool)
        known = {own.name, *failure.attempts}
        untried = [each for each in others if each.name not in known]
        tried: list[Attempt] = []
        task, found = self._task, self._found
        self._part_of_needle("what blocks the direct arcs", self._what_blocks)
        self._part_of_needle("map of the starts", self._starts)
        if self._task.with_fissures:
            self._part_of_needle("crossing a fissure", self._through_fissures)
        self._part("nearest point that is reached", self._neighbour)
        costs = {each.name: self._atlas_cost(each) for each in untried}
        for cost in (SHARED, KEPT, TO_BE_MADE):
            if cost == TO_BE_MADE:
                self._part_of_needle("change of the needle", self._needle_changes)
                self._part("share of the surroundings that is reached", self._shares)
            for system in untried:
                if costs[system.name] == cost:
                    attempt = partial(self._attempt, system, tried)
                    self._part(f"preset {system.name}", attempt, at_any_time=not tried)
        self._part("change of the bronchoscope", self._scope_changes)
        self._part_of_needle("proof that the target is unreachable", self._proof)
        done = {attempt.system.name for attempt in tried}
        order = {each.name: n for n, each in enumerate(least_invasive_first([a.system for a in tried]))}
        changes = found.pop("changes", [])
        made = Explanation(
            patient_name=task.lung.name,
            system=task.system,
            target=task.target,
            with_fissures=task.with_fissures,
            failure=failure,
            attempts=tuple(sorted(tried, key=lambda attempt: order[attempt.system.name])),
            untried=tuple(each.name for each in untried if each.name not in done),
            changes=tuple(sorted(changes, key=lambda each: each.change.relative_change)),
            parts=tuple(self._parts),
            ultrasound=best_view_words(task.lung, task.target.lps_mm, self._atlas.motions.tips),
            **found,
        )
        chances = {
            name: assess(each, task.lung, samples=DRAWS, seed=SEED).succeeds
            for name, each in made.plans.items()
        }
        return replace(made, chances=chances, time_s=working_cpu_s() - self._began)

    def _part(self, name: str, do: Callable[[], None], *, at_any_time: bool = False) -> None:
        """Do a part, unless the time is up before or during it and it is not one for any time."""
        self._on_part(name)
        self._at_any_time = at_any_time
        try:
            self._alive()
            do()
        except OutOfTime:
            self._parts.append(Part(name=name, outcome=NOT_TRIED, why=TIME_IS_UP))
        else:
            self._parts.append(Part(name=name, outcome=DONE))

    def _part_of_needle(self, name: str, do: Callable[[], None]) -> None:
        """Do a part that looks at paths of the needle, unless the system has none."""
        if self._task.system.needle is None:
            self._parts.append(Part(name=name, outcome=NOT_TRIED, why=NO_NEEDLE))
        else:
            self._part(name, do)

    @property
    def _arcs(self) -> coupled.DirectArcs:
        """The direct arcs of the needle."""
        if not isinstance(self._direct, coupled.DirectArcs):
            self._task.system.require_needle("A direct arc")
        return cast(coupled.DirectArcs, self._direct)

    def _alive(self) -> None:
        if self._at_any_time or self._time_s is None:
            return
        if working_cpu_s() - self._began > self._time_s:
            raise OutOfTime

    def _alive_share(self, _share: float) -> None:
        self._alive()

    def _what_blocks(self) -> None:
        blocking, arc = look_along(self._arcs)
        self._found |= {"blocking": blocking, "blocked_arc": arc}
        if arc is None:
            self._found["arc_beyond_limits"] = arc_beyond_limits(self._arcs)

    def _starts(self) -> None:
        self._found["starts"] = map_starts(self._arcs)

    def _through_fissures(self) -> None:
        """Try the direct arcs from the same deployments with fissures that are no obstacles."""
        lung, margins = self._task.lung, self._task.system.margins
        needle = self._task.system.require_needle("A direct arc")
        environment = needle_environment(lung, needle, margins, with_fissures=False)
        blockers = self._arcs.blockers(self._arcs.in_workspace, environment)[0]
        self._found["through_fissures"] = bool((blockers == 0).any())

    def _neighbour(self) -> None:
        if self._atlas.deployments.count:
            found = Surroundings(self._direct).nearest(self._alive)
            if found is not None and self._checker.check(found.plan, self._task.system).accepted:
                self._found["neighbour"] = found

    def _shares(self) -> None:
        if self._atlas.deployments.count:
            self._found["shares"] = tuple(Surroundings(self._direct).shares(self._alive))

    def _shares_atlas(self, system: System) -> bool:
        own = self._task.system
        return (system.scope, system.tubes, system.margins, system.fissures_allowed) == (
            own.scope, own.tubes, own.margins, own.fissures_allowed
        )  # fmt: skip

    def _atlas_cost(self, system: System) -> int:
        if self._shares_atlas(system):
            return SHARED
        return KEPT if self._is_kept(system) else TO_BE_MADE

    def _attempt(self, system: System, tried: list[Attempt]) -> None:
        task = self._task
        if self._shares_atlas(system):
            atlas = replace(self._atlas, system=system)
        else:
            atlas = self._atlas_of(system, self._alive_share)
        # Each preset is searched this long: those that reach the target mostly do so with a direct arc.
        asked = Request.by_cost(replace(task, system=system), limits=Limits(iterations=20))
        tried.append(first_attempt(run(asked, atlas=atlas, counterfactuals=False), system, self._checker))

    def _needle_changes(self) -> None:
        self._keep(coupled.needle_changes(self._task, self._atlas))

    def _scope_changes(self) -> None:
        self._keep(coupled.scope_changes(self._task, self._atlas, self._alive_share))

    def _keep(self, found: Iterator[coupled.Counterfactual]) -> None:
        """Check changes and keep them, each as soon as it is found."""
        if not self._atlas.deployments.count:
            return
        for change in found:
            accepted = self._checker.check(change.plan, change.plan.system).accepted
            self._found.setdefault("changes", []).append(Change(change=change, accepted=accepted))
            self._alive()

    def _proof(self) -> None:
        task = self._task
        if len(self._arcs.in_workspace) or not task.system.tubes.planar:
            # What a deployment of the atlas has in its workspace cannot be proved to be in none; the proof
            # knows planar tubes only.
            self._found["verdict"] = ReachVerdict(proved=False, boxes=0)
            return
        proof = UnreachableProof(
            task.lung, task.system, with_fissures=task.with_fissures, between=self._alive
        )
        self._alive()
        # Boxes for the proof: a tenth of what `certify` looks at, which can take half a minute.
        self._found["verdict"] = proof.prove(
            task.target.lps_mm, most_boxes=2_000_000, progress=self._alive_share
        )

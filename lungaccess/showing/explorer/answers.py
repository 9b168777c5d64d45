"""The answers to the questions of the page, each a generator of parts; one instance serves a process."""

import time
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.kernel_clock import working_cpu_s
from anatomy.base.typed import Float, Int
from anatomy.base.words import plural
from anatomy.grid import Volume
from anatomy.lung import Lung
from lungaccess.planning import run, tips_near
from lungaccess.planning.coupled import Atlas, FeasibleExits, feasible_exits, open_atlas
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem import System, describe_place, fissures_are_obstacles, load_patient
from lungaccess.problem.goals import Goal
from lungaccess.problem.request import Request
from lungaccess.showing.explorer import questions as ask
from lungaccess.showing.explorer.changed_system import ChosenPlace, plan_command, system_of
from lungaccess.showing.explorer.opening import looked, opened, outlined, with_nodule
from lungaccess.showing.explorer.painting import Painting
from lungaccess.showing.explorer.patient import image_parts, patient_ct, patient_facts, scene_parts, target_of
from lungaccess.showing.explorer.questions import WhatIf
from lungaccess.showing.explorer.worker import Asked, KeptPlan, Part, PatientSource, Turn
from lungaccess.showing.report.html.deployment import packed_plan
from lungaccess.uncertainty.breathing.window import with_window
from stages.tube import exit_points, shapes_digest

TELL_EVERY_S = 0.25
"""Exits and plans that become better are sent so often: more often, nobody sees the difference."""


class Answers:
    """Holds the patient and the latest atlases, and answers questions.

    Args:
        folder: Where files that the page may fetch are written.
    """

    def __init__(self, source: PatientSource, folder: Path) -> None:
        self._source, self._folder = source, folder
        self._own = {system.name: system for _path, system in source.own}
        self._lung: Lung | None = None
        self._atlases: OrderedDict[tuple[Any, ...], Atlas] = OrderedDict()
        self._before = self._atlases
        self._appraiser: Any = None
        self._painting: Painting | None = None
        self._reached: dict[tuple[Any, ...], Int] = {}

    def parts(self, asked: Asked, turn: Turn) -> Iterator[Part | None]:
        """Answer a question; see `lungaccess.showing.explorer.worker.Answering`."""
        answer = getattr(self, f"_{asked.name}")
        yield from answer(asked, turn)

    @property
    def lung(self) -> Lung:
        """The patient, read when it is first needed."""
        if self._lung is None:
            self._lung = load_patient(
                self._source.patient, cache=self._source.cache, accept=self._source.accept
            )
        return self._lung

    def _system(self, what_if: WhatIf) -> System:
        return system_of(what_if, self._own)

    def _atlas(self, system: System, turn: Turn) -> Atlas:
        """Return the atlas of a system, from memory, from the cache, or made while its progress is sent."""
        key = (
            system.scope, system.tubes, system.margins, fissures_are_obstacles(self.lung, system),
            shapes_digest(system.tubes),
        )  # fmt: skip
        told = time.monotonic()

        def progress(share: float) -> None:
            nonlocal told
            turn.check()
            if time.monotonic() - told >= TELL_EVERY_S:
                told = time.monotonic()
                turn.tell("deployment atlas", round(share, 4))

        if key not in self._atlases:
            self._atlases[key] = open_atlas(
                self.lung, system, cache=self._source.cache, progress=progress, before=self._before.get(key)
            )
        self._atlases.move_to_end(key)
        # In memory; others come from the cache within a second.
        while len(self._atlases) > 3:
            self._atlases.popitem(last=False)
        return replace(self._atlases[key], system=system)

    def _look(self, asked: Asked, _turn: Turn) -> Iterator[Part]:
        yield looked(asked.question)

    def _open(self, asked: Asked, turn: Turn) -> Iterator[Part]:
        yield from opened(asked.question, self._source, self._folder, turn)

    def _outline(self, asked: Asked, turn: Turn) -> Iterator[Part]:
        question, point = asked.question, np.array(asked.question.point)
        if question.take:
            yield with_nodule(point, self._source, turn)
            return
        shown, size = outlined(self.lung, self._ct(), point)
        yield Part({"answer": "outline", **size, **image_parts(shown, self._source, question.point)})

    def _paint(self, asked: Asked, turn: Turn) -> Iterator[Part]:
        """Correct the masks, then make lung and atlas anew here, so that the other processes find both."""
        question: ask.PaintQuestion = asked.question
        if self._painting is None:
            turn.tell("reading the masks")
            self._painting = Painting.of(self._source, self.lung)
        system = self._system(question.what_if)
        self._atlas(system, turn)
        if question.tool == "open":
            return
        around = question.points[-1] if question.points else tuple(self.lung.tree.carina_lps.tolist())
        size_ml = self._painting.draw(question, self._ct)
        lung = self._painting.renewed(turn.tell)
        self.renew(self._source, lung)
        # Before the atlas, in which a later stroke may take the place of this one.
        turn.send(
            Part(
                {"answer": "painted", "size_ml": size_ml, **image_parts(lung, self._source, around)},
                source=self._source,
                renewed=True,
            )  # fmt: skip
        )
        self._atlas(system, turn)
        yield from ()

    def renew(self, source: PatientSource, lung: Lung | None = None) -> None:
        """Take the patient again, of which a person corrected the masks."""
        self._source, self._lung = source, lung
        self._before, self._atlases = self._atlases, OrderedDict()
        self._reached.clear()
        self._appraiser = None

    def _ct(self) -> Volume:
        """Return the CT of the patient."""
        ct = patient_ct(self._source.ct)
        if ct is None:
            raise SettingsError("The patient came without a CT", remedy="Start the explorer with --ct")
        return ct

    def _patient(self, asked: Asked, _turn: Turn) -> Iterator[Part]:
        yield Part({"answer": "patient", **patient_facts(self.lung, self._source)})

    def _scene(self, asked: Asked, _turn: Turn) -> Iterator[Part]:
        for message in scene_parts(self.lung, self._source):
            yield Part({"answer": "scene", **message})

    def _image(self, asked: Asked, _turn: Turn) -> Iterator[Part]:
        yield Part({"answer": "image", **image_parts(self.lung, self._source, asked.question.around)})

    def _slice(self, asked: Asked, _turn: Turn) -> Iterator[Part]:
        from lungaccess.showing.explorer.patient import ct_slice

        question, ct = asked.question, self._ct()
        plane = question.origin, question.across, question.down
        yield Part({"answer": "slice"}, {"hu": ct_slice(ct, *plane, question.columns, question.rows)})

    def _place(self, asked: Asked, _turn: Turn) -> Iterator[Part]:
        place = describe_place(self.lung, asked.question.point)
        yield Part(
            {
                "answer": "place", "lps_mm": place.lps_mm.tolist(), "tissue": place.tissue,
                "lobe": self.lung.region_at(place.lps_mm), "distance_mm": dict(place.distance_mm),
                "may_be_target": place.may_be_target,
            }
        )  # fmt: skip

    def _prepare(self, asked: Asked, turn: Turn) -> Iterator[Part]:
        system = self._system(asked.question.what_if)
        atlas = self._atlas(system, turn)
        motions, tree = atlas.motions, self.lung.tree
        yield Part(
            {
                "answer": "prepared", "system": system.name, "deployments": atlas.deployments.count,
            },
            {
                "tips": motions.tips[:, :6].astype(np.float32),
                "turned": motions.turned.astype(np.uint8),
                "depth_mm": tree.distance_from_root_mm[motions.tree_point].astype(np.float32),
                "deployments": np.bincount(atlas.deployments.site, minlength=motions.count).astype(np.int32),
            },
        )  # fmt: skip

    def _ready(self, asked: Asked, turn: Turn) -> Iterator[Part]:
        self._atlas(self._system(asked.question.what_if), turn)
        yield from ()

    def _exits(self, asked: Asked, turn: Turn) -> Iterator[Part | None]:
        question = asked.question
        system = self._system(question.what_if)
        target = target_of(self.lung, question.target)
        system.require_needle("The list of feasible exits")
        atlas = self._atlas(system, turn)
        tips = None if question.scope_tip is None else tips_near(atlas, _tip(atlas, question.scope_tip))
        told = -np.inf
        for found in feasible_exits(self.lung, system, target, atlas=atlas, scope_tips=tips):
            now = time.monotonic()
            if not (found.is_complete or now - told >= TELL_EVERY_S):
                yield None
                continue
            told = now
            best = found.best
            entries = found.entries[best]
            yield Part(
                {
                    "answer": "exits", "complete": found.is_complete, "words": _exits_words(found),
                    "deployments": len(found.entries), "target_lps": target.lps_mm.tolist(),
                },
                {
                    "points": found.exit_lps.astype(np.float32),
                    "cost": found.cost[best].astype(np.float32),
                    "clearance_mm": found.clearance_mm.astype(np.float32),
                    "length_mm": found.length_mm[best].astype(np.float32),
                    "count": found.sizes.astype(np.int32),
                    "entry": entries.astype(np.int32),
                    "tip": atlas.deployments.site[entries].astype(np.int32),
                },
            )  # fmt: skip

    def _plan(self, asked: Asked, turn: Turn) -> Iterator[Part | None]:
        question: ask.PlanQuestion = asked.question
        system = self._system(question.what_if)
        target = target_of(self.lung, question.target)
        atlas = self._atlas(system, turn)
        place = _place_of(atlas, question)
        own = {each.name: path for path, each in self._source.own}
        command = plan_command(self._source.patient, question, system, own, self._source.cache, place)
        request = Request.of(
            self.lung, system, target, goal=question.goal, seed=question.seed,
            iterations=question.iterations, place=None if place is None else place.stated,
        )  # fmt: skip
        began, cpu_began = time.monotonic(), working_cpu_s()
        curve: list[tuple[float, float, float]] = []
        told, last, shown = -np.inf, None, None

        def part(found: Plan, *, final: bool) -> Part:
            """Return a plan for the page; one that it knows already without its curves."""
            message = {
                "answer": "plan", "final": final, "digest": found.digest, "curve": curve,
                "cost": float(found.cost), "goal": _goal_words(request.goal, found),
                "iterations": found.iterations, "system": system.name, "way": _way_words(found, self.lung),
                "cpu_s": working_cpu_s() - cpu_began, "command": command,
                "needle_mm": None if found.needle is None else found.needle.length_mm,
                "scope_tip_lps": np.asarray(found.scope.lps_from_scope_tip)[:3, 3].tolist(),
                "exit_lps": np.asarray(found.tube.exit.point_lps).tolist(), **_least_clearance(found),
            }  # fmt: skip
            if found is not shown:
                message["packed"] = packed_plan(found, self.lung, "", sections=False)
            kept = KeptPlan(digest=found.digest, text=found.to_json(), curve=tuple(curve))
            return Part(message, plan=kept)

        try:
            for found in run(
                request, atlas=atlas, counterfactuals=False, on_progress=lambda _event: turn.give_way()
            ):
                last, value = found, request.goal.value(found)
                if value is not None:
                    curve.append((time.monotonic() - began, float(found.iterations), value))
                if time.monotonic() - told >= TELL_EVERY_S:
                    told = time.monotonic()
                    yield part(found, final=False)
                    shown = found
                else:
                    yield None
        except NoPlan as failure:
            reasons = {name: int(count) for name, count in failure.reasons.items() if count}
            why = {"found": failure.found, "remedy": failure.remedy, "reasons": reasons}
            yield Part({"answer": "no_plan", "target_lps": target.lps_mm.tolist(), **why})
            return
        if last is not None:
            yield part(last if last.window is not None else with_window(last, self.lung), final=True)

    def _reach(self, asked: Asked, turn: Turn) -> Iterator[Part | None]:
        from lungaccess.showing.explorer.exports import reach_parts

        system = self._system(asked.question.what_if)
        atlas = self._atlas(system, turn)
        yield from reach_parts(self.lung, system, atlas, asked.question.around, self._reached, turn)

    def _appraise(self, asked: Asked, turn: Turn) -> Iterator[Part]:
        from lungaccess.judging.advice import advise
        from lungaccess.judging.appraisal import Appraiser
        from lungaccess.showing.explorer.exports import ADVICE_S, appraisal_words

        found = self._plan_asked(asked)
        if self._appraiser is None:
            self._appraiser = Appraiser(self.lung)
        appraisal = self._appraiser.appraise(found)
        window = None if found.window is None else found.window.words
        motion = "The patient came without a motion: nothing is known of its breathing"
        yield Part(
            {
                "answer": "appraisal", "digest": found.digest, **appraisal.to_mapping(),
                **appraisal_words(appraisal), "window": window or motion,
                "advice": [each.sentence for each in advise(found, self.lung, appraisal, time_s=ADVICE_S)],
            }
        )  # fmt: skip

    def _explain(self, asked: Asked, turn: Turn) -> Iterator[Part]:
        from lungaccess.showing.explorer.exports import explanation_part

        system = self._system(asked.question.what_if)
        target, atlas = target_of(self.lung, asked.question.target), self._atlas(system, turn)
        cache = self._source.cache
        yield explanation_part(self.lung, system, target, asked.question, atlas, cache, turn)

    def _export(self, asked: Asked, turn: Turn) -> Iterator[Part]:
        from lungaccess.showing.explorer.exports import export_file

        turn.tell(f"making {asked.question.what}")
        found = self._plan_asked(asked)
        curve = () if asked.plan is None else asked.plan.curve
        file = export_file(found, self.lung, asked.question.what, self._folder, curve, self._source.ct)
        yield Part({"answer": "file", "name": asked.question.what, "bytes": file.stat().st_size}, file=file)

    def _plan_asked(self, asked: Asked) -> Plan:
        """Return the plan that a question is about."""
        if asked.plan is None:
            raise SettingsError(
                "The plan is not known", expected="the digest of a plan of this page", remedy="Plan again"
            )
        return Plan.from_json(asked.plan.text)


def _place_of(atlas: Atlas, question: ask.PlanQuestion) -> ChosenPlace | None:
    """Return the place that a plan is asked to go through: the exit of a deployment, or a tip of the scope.

    Raises SettingsError if the atlas has no such deployment or tip.
    """
    if question.entry is not None:
        _require_below(question.entry, atlas.deployments.count, "deployment")
        chosen = np.array([question.entry])
        points = exit_points(atlas.system.tubes, atlas.motions.tips, atlas.deployments, chosen)
        return ChosenPlace.of("exit", points[0])
    if question.scope_tip is not None:
        return ChosenPlace.of("scope tip", _tip(atlas, question.scope_tip))
    return None


def _tip(atlas: Atlas, tip: int) -> Float:
    """Return the place `(3,)` of a tip of the scope."""
    _require_below(tip, atlas.motions.count, "tip of the scope")
    return atlas.motions.tips[tip, :3]


def _require_below(number: int, count: int, what: str) -> None:
    if number >= count:
        raise SettingsError(f"There is no {what} {number}", expected=f"a number below {count}")


def _exits_words(found: FeasibleExits) -> str:
    """Return how many exits there are, or what stopped all arcs."""
    tried = f" ({found.tried} of {found.in_workspace} positions of the tubes tried so far)"
    more = "" if found.is_complete else tried
    if found.count:
        return f"{plural(found.count, 'place')} to leave the airway with one clear arc{more}"
    if not found.in_workspace:
        return "From no position of the tubes does the needle get as far as the target in one arc"
    most_first = sorted(found.blocked.items(), key=lambda each: -each[1])
    stopped = ", ".join(f"{name} stops {count}" for name, count in most_first)
    return f"No single arc is clear from {found.in_workspace} positions of the tubes{more}: {stopped}"


def _goal_words(goal: Goal, found: Plan) -> dict[str, str]:
    """Return what a plan was made good at, and how good it is, in words."""
    value = goal.value(found)
    text = "not known yet" if value is None else goal.said(value)
    return {"words": goal.words_with_unit, "value": text}


def _least_clearance(found: Plan) -> dict[str, Any]:
    """Return the least clearance of a plan in mm, and in words of what to what."""
    values = [
        (mm, f"{device.replace('_', ' ')} to {'pleura' if name == 'outside' else name}")
        for device, each in found.clearance_mm.items()
        for name, mm in each.items()
    ]
    least, words = min(values)
    return {"least_mm": float(least), "risk": f"least clearance: {words} {least:.1f} mm"}


def _way_words(found: Plan, lung: Lung) -> str:
    """Return how the devices come to the target."""
    scope, needle = found.scope, found.needle
    last = "no needle"
    if needle is not None:
        last = f"needle {needle.length_mm:.0f} mm in {plural(len(needle.arcs), 'arc')}"
    return (
        f"scope {scope.length_from_carina_mm:.0f} mm beyond the carina; out of airway "
        f"{lung.branch_words(found.tube.exit.branch)}; {found.insertions}; {last}"
    )

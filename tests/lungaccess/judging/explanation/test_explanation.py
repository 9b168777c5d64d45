"""What is learned from a `NoPlan` is true: its figures are recomputed, its plans are accepted."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, BRANCH_SHIFT, OBSTACLES, OUTSIDE, VESSEL
from lungaccess.judging.answering import Attempt
from lungaccess.judging.explanation import FAILS, explain, explain_no_plan, explanation_record, sections
from lungaccess.judging.explanation.blocking import MOST_ARCS
from lungaccess.judging.explanation.explanation import Explanation
from lungaccess.judging.explanation.kernels import STEP_MM
from lungaccess.planning.coupled import DirectArcs
from lungaccess.problem.preset_order import presets_by_invasiveness
from lungaccess.problem.system import System
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from stages.needle import direct_arcs
from tests.stages.scenes import lung_of

SYSTEM = la.load_system("ultrathin")
FAR_TARGET = "lps:27.9,-25.7,39.2"
"""No single arc of the system's needle leads there; one of a tighter needle would."""
AtlasOf = Callable[[System, Callable[[float], None]], la.Atlas]


@pytest.fixture(scope="module")
def atlas_of(small_lung: Lung) -> AtlasOf:
    """Coarse atlases of the small lung, each made once."""
    made: dict[str, la.Atlas] = {}

    def atlas(system: System, _progress: Callable[[float], None] = lambda _share: None) -> la.Atlas:
        if system.name not in made:
            made[system.name] = la.build_atlas(
                small_lung, system, rotations=12, stop_spacing_mm=4.0, site_spacing_mm=2.0
            )
        return made[system.name]

    return atlas


def no_plan(lung: Lung, system: System, target: Target, atlas: la.Atlas) -> la.NoPlan:
    with pytest.raises(la.NoPlan) as caught:
        list(la.plan(lung, system, target, atlas=atlas, iterations=5, counterfactuals=False, goal="default"))
    return caught.value


@pytest.fixture(scope="module")
def far(small_lung: Lung, atlas_of: AtlasOf) -> Explanation:
    """Of a target outside the workspace of every deployment, without a limit of time."""
    target, atlas = la.resolve_target(small_lung, FAR_TARGET), atlas_of(SYSTEM, lambda _share: None)
    failure = no_plan(small_lung, SYSTEM, target, atlas)
    return explain_no_plan(small_lung, SYSTEM, target, failure, atlas=atlas, time_s=None, atlas_of=atlas_of)


@pytest.fixture(scope="module")
def walled(small_lung: Lung) -> tuple[Lung, Target]:
    """A shell of vessel about a target that is reached without it."""
    target = la.resolve_target(small_lung)
    centres = small_lung.grid.lps(np.argwhere(small_lung.labels >= 0)).reshape(*small_lung.labels.shape, 3)
    distance = np.linalg.norm(centres - target.lps_mm, axis=-1)
    labels = small_lung.labels.copy(order="F")
    labels[(distance > 4.0) & (distance < 5.5)] = VESSEL
    return lung_of(labels, small_lung.grid, small_lung.tree), target


@pytest.fixture(scope="module")
def blocked(walled: tuple[Lung, Target]) -> tuple[Explanation, la.Atlas]:
    lung, target = walled
    atlas = la.build_atlas(lung, SYSTEM)
    failure = no_plan(lung, SYSTEM, target, atlas)
    # Only what needs no other atlas.
    return explain_without(lung, target, failure, atlas), atlas


def explain_without(lung: Lung, target: Target, failure: la.NoPlan, atlas: la.Atlas) -> Explanation:
    def none(_system: System, _progress: Callable[[float], None]) -> la.Atlas:
        raise explain.OutOfTime

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(explain.coupled, "scope_changes", lambda *_: iter(()))
        return explain_no_plan(lung, SYSTEM, target, failure, atlas=atlas, time_s=None, atlas_of=none)


@pytest.mark.slow
class TestBlocked:
    """The target is walled in by a vessel."""

    def test_the_blocking_structure_is_the_shell(self, blocked: tuple[Explanation, la.Atlas]) -> None:
        explanation, _atlas = blocked
        first = explanation.blocking[0]
        assert first.place.kind == "a vessel"
        assert sum(each.arcs for each in explanation.blocking) == first.of <= MOST_ARCS
        assert explanation.blocked_arc is not None

    def test_the_least_violation_is_what_the_exact_distances_say(
        self, blocked: tuple[Explanation, la.Atlas], walled: tuple[Lung, Target]
    ) -> None:
        """Along the arc, which ends at the target, exact clearance is lacking by the stated amount."""
        arc, (lung, target) = blocked[0].blocked_arc, walled
        assert arc is not None
        np.testing.assert_allclose(arc.points_lps[-1], target.lps_mm, atol=1e-6)
        past_exit = arc.points_lps[math.ceil(SYSTEM.needle.exit_exemption_mm / STEP_MM) + 1 :]
        clearance = lung.exact_clearance_mm(past_exit, OBSTACLES, cap_mm=3.0)
        assert arc.required_mm == pytest.approx(0.9)
        assert (arc.required_mm - clearance).max() <= arc.shortfall_mm + 1e-9
        # The shell is 1.5 mm thick, and the clearance lacks on both sides of it.
        assert 1.5 < arc.blocked_mm < 12.0
        spot = arc.structure.lps_mm
        assert lung.exact_clearance_mm(spot[None], OBSTACLES, cap_mm=3.0)[0] < arc.required_mm

    def test_no_arc_violates_less(self, blocked: tuple[Explanation, la.Atlas], walled: Any) -> None:
        """Every arc within the limits is blocked by the planner's own proof, too."""
        explanation, atlas = blocked
        lung, target = walled
        arcs = DirectArcs(Task(lung=lung, system=SYSTEM, target=target), atlas)
        labels = arcs.blockers(arcs.in_workspace)[0]
        assert not (labels == 0).any()
        starts = explanation.starts
        assert starts is not None
        assert starts.counts[FAILS["a vessel"]] == np.count_nonzero(labels == VESSEL)
        assert sum(starts.counts.values()) == atlas.deployments.count
        outside = atlas.deployments.count - len(arcs.in_workspace)
        assert starts.counts[FAILS["out of reach"]] == outside

    def test_the_nearest_point_is_reached_and_lies_beyond_the_shell(
        self, blocked: tuple[Explanation, la.Atlas], walled: tuple[Lung, Target]
    ) -> None:
        neighbour, (lung, target) = blocked[0].neighbour, walled
        assert neighbour is not None
        away = np.linalg.norm(neighbour.plan.target_lps - target.lps_mm)
        assert away == pytest.approx(neighbour.from_target_mm)
        assert 5.5 < away < 12.0
        assert la.check(neighbour.plan, lung, SYSTEM).accepted

    def test_what_is_reachable_is_not_proved_unreachable(self, blocked: Any) -> None:
        assert not blocked[0].verdict.proved
        assert "cannot be proved this way" in str(sections(blocked[0]))

    def test_what_was_not_tried_is_no_no(self, blocked: tuple[Explanation, la.Atlas]) -> None:
        explanation, _atlas = blocked
        untried = {*la.preset_names()} - {SYSTEM.name}
        assert set(explanation.untried) == untried and not explanation.attempts
        assert {part.name for part in explanation.not_tried} == {f"preset {name}" for name in untried}
        assert "no other preset" not in explanation.headline and "not tried" in explanation.headline
        tried = [each["tried"] for each in explanation_record(explanation)["presets"]]
        assert tried == [False] * 6


@pytest.mark.slow
class TestFar:
    """The target is out of reach."""

    def test_every_part_was_done(self, far: Explanation) -> None:
        assert not far.not_tried and not far.untried
        names = [attempt.system.name for attempt in far.attempts]
        assert names == [
            "lung-default", "stylet-needle", "tubes-only", "thin-scope", "flexure-needle", "therapeutic-scope"
        ]  # fmt: skip

    def test_the_arc_beyond_the_limits_ends_at_the_target_and_exceeds_one(self, far: Explanation) -> None:
        arc = far.arc_beyond_limits
        assert arc is not None and far.blocked_arc is None and not far.blocking
        np.testing.assert_allclose(arc.points_lps[-1], far.target.lps_mm, atol=1e-6)
        length = np.linalg.norm(np.diff(arc.points_lps, axis=0), axis=1).sum()
        assert arc.length_mm == pytest.approx(length, rel=2e-3)
        assert (
            arc.radius_mm < arc.least_radius_mm
            or arc.length_mm > arc.most_length_mm
            or arc.turn_deg > arc.most_turn_deg
        )
        needles = [each.needle for each in presets_by_invasiveness() if each.needle is not None]
        assert any(
            arc.radius_mm >= each.min_radius_of_curvature_mm and arc.length_mm <= each.max_length_mm
            for each in needles
        )

    def test_presets_that_reach_it_have_plans_that_the_check_accepts(
        self, far: Explanation, small_lung: Lung, atlas_of: AtlasOf
    ) -> None:
        for attempt in far.attempts:
            assert attempt.succeeded == (f"plan-{attempt.system.name}.json" in far.plans)
            assert attempt.succeeded != (attempt.failure is not None)
        for name, plan in far.plans.items():
            assert la.check(plan, small_lung, plan.system).accepted, name
            if name != "plan-nearest.json":
                np.testing.assert_array_equal(plan.target_lps, far.target.lps_mm)

    def test_no_plan_is_named_without_its_chance_of_success(self, far: Explanation) -> None:
        assert set(far.chances) == set(far.plans)
        helps = [each for each in far.attempts if each.succeeded]
        helps += [each for each in far.changes if each.accepted]
        assert far.advice.count("(succeeds in ") == len(helps)

    def test_the_record_is_json_and_names_the_files(self, far: Explanation, tmp_path: Path) -> None:
        written = la.save_explanation(far, tmp_path)
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted(written)
        record = json.loads((tmp_path / "no_plan.json").read_text())
        assert record == json.loads(json.dumps(explanation_record(far), allow_nan=False))
        assert record["found"] is False and record["accepted"] is False
        named = {each["plan"] for each in record["presets"]} | {each["plan"] for each in record["changes"]}
        assert named - {None} <= set(written)
        for name in set(written) - {"no_plan.json"}:
            la.Plan.load(tmp_path / name)
        lps, ras = record["target"]["lps_mm"], record["target"]["ras_mm"]
        assert ras == [-lps[0], -lps[1], lps[2]]

    def test_the_same_input_gives_the_same_explanation(
        self, far: Explanation, small_lung: Lung, atlas_of: AtlasOf
    ) -> None:
        again = explain_no_plan(
            small_lung, SYSTEM, far.target, far.failure, atlas=atlas_of(SYSTEM, lambda _s: None),
            time_s=None, atlas_of=atlas_of,
        )  # fmt: skip
        one, two = explanation_record(far), explanation_record(again)
        assert one.pop("explain_cpu_s") > 0.0 and two.pop("explain_cpu_s") > 0.0
        assert one == two


@pytest.mark.slow
def test_when_the_time_is_up_the_rest_is_listed_and_no_claim_is_made(
    far: Explanation, small_lung: Lung, atlas_of: AtlasOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that ticks once a look: whatever it allows, parts done and not done are all parts."""
    atlas = atlas_of(SYSTEM, lambda _share: None)
    everything = {part.name for part in far.parts}
    for time_s in (0.5, 4.5):
        ticks = count()
        monkeypatch.setattr(explain, "working_cpu_s", lambda ticks=ticks: float(next(ticks)))
        made = explain_no_plan(
            small_lung, SYSTEM, far.target, far.failure, atlas=atlas, time_s=time_s, atlas_of=atlas_of
        )
        assert {part.name for part in made.parts} == everything
        assert made.not_tried and made.verdict is None and made.untried
        assert "no other preset" not in made.headline
        titles = [section.title for section in sections(made)]
        assert "Not tried: nothing follows from these" in titles
    assert [part.outcome for part in made.parts][:3] == ["done"] * 3


@pytest.mark.slow
def test_a_headline_names_the_least_invasive_preset_that_does(far: Explanation) -> None:
    report: Any = type("Report", (), {"accepted": True})()
    done = tuple(
        replace(each, report=report, plan=far.neighbour and far.neighbour.plan, failure=None)
        if each.system.name not in ("lung-default", "stylet-needle", "tubes-only", "thin-scope")
        else Attempt(system=each.system, failure=la.NoPlan("No", reasons={}, main_reason="it is too thick"))
        for each in far.attempts
    )
    headline = replace(far, attempts=done, chances={}).headline
    assert headline.startswith("No plan found with ultrathin: ")
    least = "flexure-needle would reach it, the least invasive other preset with a plan"
    assert headline.endswith(f"; {least} (6 of 6 other presets tried)")


@pytest.mark.slow
def test_an_airway_that_blocks_is_named_by_its_branch(
    walled: tuple[Lung, Target], blocked: tuple[Explanation, la.Atlas]
) -> None:
    """A shell of airway wall of a known branch instead of the vessel."""
    lung, target = walled
    labels = lung.labels.copy(order="F")
    branch = int(np.argmax(lung.tree.generation))
    near = np.linalg.norm(
        lung.grid.lps(np.argwhere(labels >= 0)).reshape(*labels.shape, 3) - target.lps_mm, axis=-1
    )
    labels[(near > 4.0) & (near < 5.5) & (labels & OUTSIDE == 0)] = AIRWAY | (branch + 1) << BRANCH_SHIFT
    other = lung_of(labels, lung.grid, lung.tree)
    atlas = blocked[1]
    arcs = DirectArcs(Task(lung=other, system=SYSTEM, target=target), atlas)
    entries = atlas.deployments
    chosen = arcs.in_workspace
    found = direct_arcs(
        arcs.evaluator.environment, entries.positions[chosen], entries.tangents[chosen],
        entries.branch[chosen], target.lps_mm,
    )[0]  # fmt: skip
    assert (found != 0).all() and (found > 0).any()
    from lungaccess.judging.explanation.blocking import look_along

    kinds = {each.place.kind: each.place.name for each in look_along(arcs)[0]}
    generation = int(lung.tree.generation[branch])
    assert f"(branch {branch} (" in kinds["an airway"] and f"generation {generation})" in kinds["an airway"]

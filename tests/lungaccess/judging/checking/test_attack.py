"""Random plans of a synthetic patient are accepted, and every kind of mutant of them is refused."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lungaccess as la
from anatomy.base.settings import override
from anatomy.lung import Lung
from experiments import check_attack
from experiments.support.mutants import random_plans
from experiments.support.mutants.all import MUTATIONS
from experiments.support.mutants.mutant import Case
from lungaccess.judging.checking import Checker, check
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task, objective_of
from tests.lungaccess.two_curved_tubes import COARSE, two_curved_tubes

PLANS_A_SYSTEM = 3
MUTANTS_OF_A_KIND = 2
WITHOUT_EXPLANATION = (
    "lungaccess.planning.coupled.explanation.explain",
    lambda *_, **__: la.NoPlan("No plan", reasons={}),
)
"""Why there is no plan is of no interest here."""


def systems() -> list[la.System]:
    """A preset, two curved tubes, and a device that crosses fissures, bends tightly and bears its needle."""
    preset = la.load_system("ultrathin")
    own = {
        "name": "own",
        "fissures_allowed": True,
        "needle.max_curvature_per_mm": 0.02,
        "needle.exit_exemption_mm": 3.0,
        "needle_preloaded": True,
        "needle.slotted_segments": ({"length_mm": 380.0, "stiffness_factor": 0.04, "strain_factor": 0.75},),
        "tubes.max_lateral_sweep_mm": 2.0,
        "tubes.inner.curved_length_mm": 20.0,
        "margins.registration_margin_mm": 0.2,
    }
    return [preset, override(preset, own), two_curved_tubes()]


@pytest.fixture(scope="module")
def checks(small_lung: Lung) -> Any:
    return check_attack.PlanCheck(small_lung)


@pytest.fixture(scope="module")
def made(small_lung: Lung) -> list[tuple[Any, Any, Plan]]:
    """Systems, targets and plans: made in all the ways there are, and one of several arcs for each system."""
    found = []
    for number, system in enumerate(systems()):
        rng = np.random.default_rng(number)
        coarse = {"rotations": 12, "stop_spacing_mm": 4.0, "site_spacing_mm": 3.0}
        atlas = la.build_atlas(small_lung, system, **(coarse if system.tubes.planar else COARSE))
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(*WITHOUT_EXPLANATION)
            drawn = drawn_plans(small_lung, system, atlas, rng, random_plans.plans_to)
            mine = list(islice(drawn, PLANS_A_SYSTEM))
            mine.append(next(drawn_plans(small_lung, system, atlas, rng, bent_plans)))
        found += [(system, plan.target_lps, plan) for plan in mine]
    return found


def drawn_plans(lung: Lung, system: la.System, atlas: Any, rng: Any, way: Any) -> Iterator[Plan]:
    """Yield plans to random targets, without end; `way` plans to one target."""
    while True:
        target = random_plans.random_target(lung, atlas, rng)
        if target is not None:
            yield from way(lung, system, target, atlas, rng)


def bent_plans(lung: Lung, system: la.System, target: Target, atlas: Any, rng: Any) -> Iterator[Plan]:
    """Yield plans of several arcs from deployments near a target."""
    task = Task(
        lung=lung, system=system, target=target, objective=objective_of(lung, "length"), method="bent", seed=0
    )
    yield from random_plans.bent_plans(task, atlas, rng)


@pytest.fixture(scope="module")
def cases(made: list[tuple[Any, Any, Plan]], checks: Any, small_lung: Lung) -> list[tuple[Any, Any, Case]]:
    return [
        (
            system,
            target,
            Case(
                lung=small_lung, plan=plan, report=checks.of_plan(plan, system, target), other=made[n - 1][2]
            ),
        )
        for n, (system, target, plan) in enumerate(made)
    ]


def test_every_plan_is_accepted(cases: list[tuple[Any, Any, Case]]) -> None:
    assert [case.report.refusals for _, _, case in cases] == [()] * len(cases)
    assert len({case.plan.method for _, _, case in cases}) > 1
    assert any(len(case.plan.needle.arcs) > 1 for _, _, case in cases)
    assert any(case.plan.fissures_are_obstacles for _, _, case in cases)


@pytest.mark.parametrize("kind", MUTATIONS)
def test_every_kind_of_mutant_is_refused(kind: str, cases: list[tuple[Any, Any, Case]], checks: Any) -> None:
    rng = np.random.default_rng(0)
    refused = 0
    for n in range(200):
        system, target, case = cases[n % len(cases)]
        mutant = MUTATIONS[kind](case, rng)
        if mutant is not None:
            assert not checks.of_mutant(mutant, system, target).accepted, f"mutant {n} of {kind}"
            refused += 1
        if refused == MUTANTS_OF_A_KIND:
            return
    raise AssertionError(f"{kind} made {refused} mutants")


@settings(max_examples=15)
@given(seed=st.integers(0, 2**32), number=st.integers(0, 2 * PLANS_A_SYSTEM - 1))
def test_random_mutants_are_refused(
    seed: int, number: int, cases: list[tuple[Any, Any, Case]], checks: Any
) -> None:
    system, target, case = cases[number]
    kind, mutant = check_attack.mutate(case, np.random.default_rng(seed))
    assert not checks.of_mutant(mutant, system, target).accepted, kind


@pytest.mark.slow
def test_a_checker_that_has_seen_other_plans_says_the_same(
    cases: list[tuple[Any, Any, Case]], small_lung: Lung
) -> None:
    """What is kept from one plan to the next changes nothing."""
    checker = Checker(small_lung)
    for _ in range(2):
        for _system, _target, case in cases[:: PLANS_A_SYSTEM + 1]:
            assert checker.check(case.plan).findings == check(case.plan, small_lung).findings


@pytest.mark.slow
def test_a_run_that_was_interrupted_goes_on(
    small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(random_plans, "PLANS_A_BATCH", 1)
    monkeypatch.setattr(*WITHOUT_EXPLANATION)
    monkeypatch.setattr(random_plans, "random_system", lambda _rng: la.load_system("ultrathin"))
    files = [tmp_path / name for name in ("at-once.jsonl", "in-parts.jsonl")]
    for file, parts in zip(files, [(2,), (1, 2)], strict=True):
        for plans in parts:
            check_attack.run("small", small_lung, plans, 2, 0, file, tmp_path)
    records = [[_lasting(each) for each in check_attack.read(file)] for file in files]
    assert records[0] == records[1]
    assert sum("accepted" in each for each in records[0]) == 2
    assert "all" in check_attack.table(check_attack.read(files[0]))


def _lasting(record: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in record.items() if not key.endswith("_s")}

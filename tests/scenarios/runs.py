"""Run a scenario: the best cost for each target or query, and everything that is wrong with the answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

import lungaccess as la
from anatomy.base.records import frozen_value
from anatomy.poses import pose
from lungaccess.planning.one_stage.needle import plan_needle
from lungaccess.problem.target import point_target
from stages.needle.path import Query, violation
from tests.scenarios.cases import NEEDLE_DEVICE, NEEDLE_ITERATIONS, NEEDLE_OBJECTIVE, PLANNERS, Anatomy, Case
from tests.scenarios.scenes import Scenes

STAGES = ("masks: ", "scope: ", "tube: ", "needle: ")
Cost = float | None


@frozen_value
class Answer:
    """What a search gave for one target.

    Args:
        cost: Of the best plan or path; None if there is none.
        digest: Changes with any byte of any plan, or of the reasons for having none.
        faults: What is wrong with the best plan, or with the reasons.
    """

    cost: Cost
    digest: str
    faults: tuple[str, ...] = ()


def answer_for(scenes: Scenes, case: Case, target_lps: Sequence[float]) -> Answer:
    """Plan to one target with the iterations of the case's planner, and judge the best plan."""
    lung, system = scenes.lung(case.anatomy), scenes.system(case.anatomy, case.device)
    planner = PLANNERS[case.planner]
    try:
        plans = list(
            la.plan(
                lung, system, point_target(lung, np.array(target_lps)), atlas=scenes.atlas(case),
                method=planner.method, goal=planner.objective, iterations=planner.iterations,
            )
        )  # fmt: skip
    except la.NoPlan as refusal:
        return Answer(cost=None, digest=f"{refusal} {dict(refusal.reasons)}", faults=_faults_of(refusal))
    best = plans[-1]
    report = scenes.checker(case.anatomy).check(best, system, target_lps=target_lps)
    faults = tuple(f"the check refuses {finding.name}" for finding in report.refusals)
    if not report.accepted and not faults:
        faults = ("the check refuses the plan",)
    return Answer(
        cost=best.costs[planner.objective], digest=" ".join(plan.digest for plan in plans), faults=faults
    )


def _faults_of(refusal: la.NoPlan) -> tuple[str, ...]:
    unknown = [reason for reason in refusal.reasons if not reason.startswith(STAGES)]
    faults = [f"the reason {reason!r} names no stage" for reason in unknown]
    if not any(refusal.reasons.values()):
        faults.append("no reason was counted")
    return tuple(faults)


def needle_answers(
    scenes: Scenes, anatomy: Anatomy, queries: Sequence[dict[str, Any]], planner: str
) -> list[Answer]:
    """Plan the needle for each stored query, and judge each path by the limits and proofs of its own."""
    lung, system = scenes.lung(anatomy), scenes.system(anatomy, NEEDLE_DEVICE)
    answers = []
    for stored in queries:
        start, target = pose(stored["start"], stored["direction"]), point_target(lung, stored["target"])
        found = plan_needle(
            lung, system, start, target, planner=planner, objective=NEEDLE_OBJECTIVE,
            iterations=NEEDLE_ITERATIONS,
        )  # fmt: skip
        if found.path is None:
            answers.append(Answer(cost=None, digest=found.outcome))
            continue
        asked = Query(lps_from_start=np.array(start), target=target.lps_mm, branch=found.branch)
        wrong = violation(found.environment, asked, found.path)
        answers.append(
            Answer(cost=found.cost, digest=found.path.arcs.tobytes().hex(), faults=(wrong,) if wrong else ())
        )
    return answers


def lost(stored: Sequence[Cost], found: Sequence[Cost]) -> list[int]:
    """Return the numbers of the targets that had a plan and have none."""
    pairs = enumerate(zip(stored, found, strict=True))
    return [number for number, (then, now) in pairs if then is not None and now is None]


def costlier(stored: Sequence[Cost], found: Sequence[Cost], tolerance: float) -> list[str]:
    """Tell for which targets the cost exceeds the stored one by more than the tolerance, or is no number."""
    out = []
    for number, (then, now) in enumerate(zip(stored, found, strict=True)):
        if then is not None and now is not None and not now <= then * (1.0 + tolerance):
            out.append(f"target {number}: {now:.4f} instead of {then:.4f}")
    return out

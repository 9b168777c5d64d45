"""Needles that do not follow their plans exactly, inserted blindly and with replanning on the way.

    python -m experiments.closed_loop [--quick] [--seed 1] [--results FOLDER] [--patient NAME] [--system NAME]

Random peripheral targets are planned for with `lungaccess.plan`.  From each start the needle is inserted
many times with errors drawn at random, in open and in closed loop: by size of the errors, and by curvature
held in reserve for a needle that bends too little.  What the errors are, and what counts as reached:
docs/explanation/replanning.md.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import lungaccess as la
from anatomy.base.errors import TargetError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.lung import Lung
from experiments.support.anatomies import PHANTOM, anatomy, default_anatomies
from experiments.support.insertion.figure import draw_insertions
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.planning.procedure.insertion import (
    TOLERANCE_MM,
    Errors,
    Outcome,
    Study,
    Summary,
    assumed_errors,
    study,
    summary,
)
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.target import point_target
from stages.needle.environment import NeedleEnvironment, needle_environment
from stages.needle.objective import Objective
from stages.needle.path import ArcPath, arc_transform
from stages.needle.query import Query
from stages.needle.replanning.insertion import tilt
from stages.needle.replanning.replanner import ITERATIONS, Replanner, ReplanSettings, with_reserve
from stages.needle.search.base import RestartingRRT

OBJECTIVE = Objective(inverse_clearance=1.0)
PLANNING_ITERATIONS = 3000
RESERVE = 0.1
RESERVES = (0.0, 0.1, 0.2)
REPLAN_LIMIT_MS = 20.0
SIZES = {"quick": (2, 8, 60), "full": (12, 30, 1000)}
"""Targets, insertions for each target and mode and level, and replans to time."""
SYSTEMS = {PHANTOM: "flexure-needle"}
DRAWN_RUNS = 12


LEVELS = {"no": 0.0, "half": 0.5, "full": 1.0, "double": 2.0}
WEAK = Errors(curvature_bias=-0.15, curvature_sd=0.05, position_noise_mm=0.2, direction_noise_deg=0.3)


@frozen_record
class Case:
    """A start, a target, and the plan for each curvature reserve."""

    query: Query
    plans: dict[float, ArcPath]


def cases_of(
    lung: Lung, system: la.System, environment: NeedleEnvironment, count: int, seed: int
) -> list[Case]:
    """Plan to random targets until `count` have a needle plan with every reserve."""
    curvature = (1.0 - max(RESERVES)) * system.needle.max_curvature_per_mm
    needle = replace(system.needle, max_curvature_per_mm=curvature)
    system = replace(system, name=f"{system.name} with a reserve", needle=needle)
    atlas = la.build_atlas(lung, system)
    cases: list[Case] = []
    for point in np.random.default_rng(seed).permutation(peripheral_targets(lung, 10 * count, seed)):
        try:
            found = next(
                la.plan(
                    lung,
                    system,
                    point_target(lung, point),
                    atlas=atlas,
                    iterations=100,
                    time_s=60.0,
                    goal="default",
                )
            )
        except la.NoPlan:
            continue
        start = found.needle.lps_from_start
        query = Query(lps_from_start=start, target=point, branch=found.exemption.branch)
        plans = {reserve: needle_plan(with_reserve(environment, reserve), query) for reserve in RESERVES}
        if all(plan is not None for plan in plans.values()):
            cases.append(Case(query=query, plans={r: p for r, p in plans.items() if p is not None}))
        if len(cases) == count:
            break
    return cases


def needle_plan(environment: NeedleEnvironment, query: Query) -> ArcPath | None:
    """Return the best path of a fixed number of iterations."""
    search = RestartingRRT(environment, query, objective=OBJECTIVE)
    for _ in range(100):
        if search.iterations >= PLANNING_ITERATIONS:
            break
        search.advance(PLANNING_ITERATIONS - search.iterations)
    return search.path


def inserted(
    environment: NeedleEnvironment, cases: Sequence[Case], errors: Errors, reserve: float, runs: int
) -> Study:
    """Insert needles to all targets."""
    studies = [
        study(
            environment, case.query, case.plans[reserve], errors, seeds=range(runs * n, runs * (n + 1)),
            objective=OBJECTIVE, replanning=ReplanSettings(curvature_reserve=reserve),
        )
        for n, case in enumerate(cases)
    ]  # fmt: skip
    return Study(
        open_loop=summary(run for made in studies for run in made.open_loop.insertions),
        closed_loop=summary(run for made in studies for run in made.closed_loop.insertions),
    )


def add_study(result: Result, label: str, made: Study) -> None:
    """Add the rows of open and closed loop."""
    for mode, found in (("open loop", made.open_loop), ("closed loop", made.closed_loop)):
        result.add(f"{label}, {mode}: reached", _percent(found, Outcome.REACHED), unit="%", note=_note(found))


def _percent(found: Summary, outcome: Outcome) -> float:
    return 100.0 * found.outcomes.get(outcome, 0) / len(found.insertions)


def _note(found: Summary) -> str:
    no_path = _percent(found, Outcome.NO_PATH) + _percent(found, Outcome.OUT_OF_LENGTH)
    return (
        f"{len(found.insertions)} insertions, 95 % interval {100.0 * found.reached_low:.1f} to "
        f"{100.0 * found.reached_high:.1f}; hit an obstacle {_percent(found, Outcome.HIT):.1f} %; no path "
        f"{no_path:.1f} %; tip error median "
        f"{found.median_error_mm:.2f} mm, 95 % within {found.error_95_mm:.2f} mm; least clearance "
        f"{found.clearance_mm:.2f} mm"
    )


def replan_times_ms(environment: NeedleEnvironment, cases: Sequence[Case], poses: int, seed: int) -> Float:
    """Return the CPU time of replans from poses beside the plans, the first of each kind left out.

    Each pose is off the plan by 0.5 mm in each coordinate and by 1 degree about two axes, the target by
    0.5 mm.
    """
    rng = np.random.default_rng(seed)
    times = []
    for number in range(-20, poses):
        case = cases[number % len(cases)]
        plan = case.plans[RESERVE]
        at = rng.uniform(0.0, 0.9) * plan.length_mm
        tip = frame_at(plan, at) @ tilt(np.radians(rng.rayleigh()), rng.uniform(0.0, 2.0 * np.pi))
        tip[:3, 3] += rng.normal(0.0, 0.5, 3)
        target = case.query.target + rng.normal(0.0, 0.5, 3)
        replanner = Replanner(
            environment, case.query, plan, objective=OBJECTIVE, seed=number + 20,
            settings=ReplanSettings(curvature_reserve=RESERVE),
        )  # fmt: skip
        began = time.process_time()
        replanner.replan(tip, target, at)
        if number >= 0:
            times.append(1e3 * (time.process_time() - began))
    return np.array(times)


def frame_at(plan: ArcPath, length_mm: float) -> Float:
    """Return the tip frame of a plan at a length."""
    frame = plan.lps_from_start
    for length, roll, curvature in plan.arcs:
        frame = frame @ arc_transform(min(length, length_mm), roll, curvature)
        length_mm -= length
        if length_mm <= 0.0:
            break
    return np.array(frame)


def add_replans(result: Result, times_ms: Float) -> None:
    """Add the CPU time of replans."""
    within = 100.0 * (times_ms < REPLAN_LIMIT_MS).mean()
    result.add(
        f"replan of {ITERATIONS} iterations: CPU time, median", float(np.median(times_ms)), unit="ms",
        note=f"{len(times_ms)} poses; 99 % within {np.quantile(times_ms, 0.99):.1f} ms, largest "
        f"{times_ms.max():.1f} ms; {within:.1f} % within {REPLAN_LIMIT_MS:g} ms",
    )  # fmt: skip


def insert_all(
    result: Result, environment: NeedleEnvironment, cases: list[Case], runs: int
) -> dict[str, Study]:
    """Add the rows by size of the errors and by reserve; return the studies of all sizes above 0."""
    by_level = {}
    for name, size in LEVELS.items():
        by_level[name] = inserted(environment, cases, assumed_errors(size), RESERVE, runs)
        add_study(result, f"{name} errors", by_level[name])
    for reserve in RESERVES:
        made = inserted(environment, cases, WEAK, reserve, runs)
        add_study(result, f"needle that bends 15 % too little, reserve {reserve:g}", made)
    return {name: made for name, made in by_level.items() if LEVELS[name] > 0.0}


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--patient", default=default_anatomies()[-1], metavar="NAME")
    parser.add_argument("--system", metavar="NAME", help="default: lung-default; phantom: flexure-needle")
    options = parser.parse_args()
    n_targets, runs, poses = SIZES[setting_of(options)]
    result = Result(
        name="closed_loop", title="Insertion with errors, in open and closed loop",
        setting=setting_of(options), seeds=[options.seed],
    )  # fmt: skip
    lung = anatomy(options.patient)
    system = la.load_system(options.system or SYSTEMS.get(options.patient, "lung-default"))
    fissures = lung.has_fissures and not system.fissures_allowed
    environment = needle_environment(lung, system.needle, system.margins, with_fissures=fissures)
    cases = cases_of(lung, system, environment, n_targets, options.seed)
    if not cases:
        raise TargetError(
            f"{lung.name}: no target was found that the needle can be planned to with every reserve",
            remedy="Choose another system or patient",
        )
    lengths = [case.plans[RESERVE].length_mm for case in cases]
    result.conditions = {
        "anatomy": f"{lung.name}, system {system.name}",
        "targets": f"{len(cases)} peripheral ones, plans of {min(lengths):.0f} to {max(lengths):.0f} mm",
        "insertions": f"{runs} for each target, mode and level; reached: within {TOLERANCE_MM:g} mm",
        "errors": "full: curvature 8 % constant and 5 % along the way, roll 5 degrees and 10 degrees of "
        "walk, tracker 0.4 mm and 0.6 degrees, target drift 2 mm and walk 1 mm; an assumption, not measured",
    }
    by_level = insert_all(result, environment, cases, runs)
    add_replans(result, replan_times_ms(environment, cases, poses, options.seed))
    longest = cases[int(np.argmax(lengths))]
    at_target = inserted(environment, [longest], assumed_errors(1.0), RESERVE, min(runs, DRAWN_RUNS))
    result.figure = draw_insertions(lung, longest.query, longest.plans[RESERVE], at_target, by_level)
    write_result(result, options.results)


if __name__ == "__main__":
    main()

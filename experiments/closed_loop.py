"""Needles that do not follow their plans exactly, inserted blindly and with replanning on the way.

    python -m experiments.closed_loop [--quick] [--seed 1] [--results FOLDER] [--patient NAME] [--system NAME]

Random peripheral targets are planned for with `lungaccess.plan`.  Each needle is inserted many times with
errors drawn at random, in open and in closed loop: by size of the errors, and with a curvature that nobody
knows, which is learned on the way or not.  docs/explanation/replanning.md says what counts as reached.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

import lungaccess as la
from anatomy.base.errors import TargetError
from anatomy.base.typed import Float
from anatomy.lung import Lung
from experiments.support.anatomies import PHANTOM, anatomy, default_anatomies
from experiments.support.insertion.figure import draw_insertions
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.planning.procedure.insertion import (
    ITERATIONS,
    TOLERANCE_MM,
    Insertion,
    InsertionStudy,
    Outcome,
    Summary,
    insert_plan,
)
from lungaccess.plans.curves import needle_pieces
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import AngleError, CurvatureError, ErrorModel
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.target import point_target
from stages.needle.environment import needle_environment
from stages.needle.objective import Objective
from stages.needle.path import ArcPath, Query, arc_transform
from stages.needle.replanning.insertion import tilt
from stages.needle.replanning.replanner import Replanner

REPLAN_LIMIT_MS = 20.0
SIZES = {"quick": (2, 8, 60), "full": (20, 20, 1000)}
"""Targets, insertions for each target and level, and replans to time."""
SYSTEMS = {PHANTOM: "flexure-needle"}
LEVELS = {"no": 0.0, "half": 0.5, "whole": 1.0, "double": 2.0}
ROLL = AngleError(attempt_deg=5.0)
UNKNOWN = ErrorModel(needle_curvature=CurvatureError(attempt_ln=0.4), needle_roll=ROLL)
FACTORS = (0.5, 2.0)
SHARES = (1.0, 0.5)
"""Plans use so much of the needle's curvature."""


def plans_of(lung: Lung, system: la.System, share: float, count: int, seed: int) -> list[la.Plan]:
    """Plan to random targets with a share of the needle's curvature, until `count` have a plan."""
    needle = replace(system.needle, max_curvature_per_mm=share * system.needle.max_curvature_per_mm)
    held_back = replace(system, name=f"{system.name} with a reserve", needle=needle)
    atlas = la.build_atlas(lung, held_back)
    found: list[la.Plan] = []
    for point in np.random.default_rng(seed).permutation(peripheral_targets(lung, 10 * count, seed)):
        try:
            *_, best = la.plan(
                lung, held_back, point_target(lung, point), atlas=atlas, goal="default", iterations=100
            )
        except la.NoPlan:
            continue
        found.append(replace(best, system=replace(held_back, needle=system.needle)))
        if len(found) == count:
            break
    return found


def inserted(
    lung: Lung, plans: Sequence[la.Plan], errors: ErrorModel, runs: int, believed: ErrorModel | None = None
) -> list[InsertionStudy]:
    """Insert needles to all targets."""
    return [
        insert_plan(plan, lung, errors=errors, believed=believed, samples=runs, seed=runs * n)
        for n, plan in enumerate(plans)
    ]


def add_study(result: Result, label: str, made: Sequence[InsertionStudy]) -> None:
    """Add the rows of open and closed loop."""
    for mode, each in (("open loop", "open_loop"), ("closed loop", "closed_loop")):
        runs = [run for study in made for run in getattr(study, each).insertions]
        _add(result, f"{label}, {mode}: reached", runs)


def _add(result: Result, label: str, runs: Sequence[Insertion]) -> None:
    found = Summary.of(runs).to_mapping()
    low, high = (100.0 * end for end in found["reached"]["interval_95"])
    hit, no_path = (100.0 * found["outcomes"][each] / len(runs) for each in (Outcome.HIT, Outcome.NO_PATH))
    note = (
        f"{len(runs)} insertions, 95 % interval {low:.1f} to {high:.1f}; touched something {hit:.1f} %; "
        f"no path {no_path:.1f} %; tip error median {found['tip_error_median_mm']:.2f} mm, 95 % within "
        f"{found['tip_error_95_mm']:.2f} mm"
    )
    result.add(label, 100.0 * found["reached"]["probability"], unit="%", note=note)


def within_reach(study: InsertionStudy, run: Insertion, most_per_mm: float) -> bool:
    """Tell whether the true needle could come near enough to its target in free space."""
    start, away = study.query.lps_from_start, study.query.target - study.query.lps_from_start[:3, 3]
    ahead, radius = float(away @ start[:3, 2]), 1.0 / (min(run.factor, 1.0) * most_per_mm)
    aside = float(np.linalg.norm(away - ahead * start[:3, 2]))
    return float(np.hypot(radius - aside, ahead)) >= radius - study.tolerance_mm


def add_unknown(
    result: Result, lung: Lung, system: la.System, share: float, size: tuple[int, int, int]
) -> None:
    """Add the rows of needles whose curvature nobody knows, learned on the way or not."""
    count, runs, _poses = size
    plans = plans_of(lung, system, share, count, 1)
    for label, believed in (("learned", UNKNOWN), ("not learned", ErrorModel(needle_roll=ROLL))):
        reachable = [
            run
            for study in inserted(lung, plans, UNKNOWN, runs, believed)
            for run in study.closed_loop.insertions
            if FACTORS[0] <= run.factor <= FACTORS[1]
            and within_reach(study, run, system.needle.max_curvature_per_mm)
        ]
        if reachable:
            _add(result, f"unknown curvature, {label}, plans of {share:g} of it: reached", reachable)


def replan_times_ms(lung: Lung, plans: Sequence[la.Plan], poses: int, seed: int) -> Float:
    """Return the CPU time of replans from poses beside the plans, the first of each kind left out.

    Each pose is off the plan by 0.5 mm in each coordinate and by 1 degree about two axes, the target by
    0.5 mm.
    """
    rng = np.random.default_rng(seed)
    times = []
    for number in range(-20, poses):
        plan = plans[number % len(plans)]
        path = ArcPath(lps_from_start=plan.tube.lps_from_tip, arcs=needle_pieces(plan.needle))
        environment = needle_environment(
            lung, plan.system.needle, plan.system.margins, with_fissures=plan.fissures_are_obstacles
        )
        at = rng.uniform(0.0, 0.9) * path.length_mm
        tip = frame_at(path, at) @ tilt(np.radians(rng.rayleigh()), rng.uniform(0.0, 2.0 * np.pi))
        tip[:3, 3] += rng.normal(0.0, 0.5, 3)
        query = Query(lps_from_start=path.lps_from_start, target=np.array(plan.end_lps))
        replanner = Replanner(
            environment, query, path, objective=Objective.of(plan.objective), seed=number + 20,
            iterations=ITERATIONS,
        )  # fmt: skip
        began = time.process_time()
        replanner.replan(tip, query.target + rng.normal(0.0, 0.5, 3), at)
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


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--patient", default=default_anatomies()[-1], metavar="NAME")
    parser.add_argument("--system", metavar="NAME", help="default: thin-scope; phantom: flexure-needle")
    options = parser.parse_args()
    size = SIZES[setting_of(options)]
    result = Result(
        name="closed_loop", title="Insertion with errors, in open and closed loop",
        setting=setting_of(options), seeds=[options.seed],
    )  # fmt: skip
    lung = anatomy(options.patient)
    system = la.load_system(options.system or SYSTEMS.get(options.patient, "thin-scope"))
    plans = plans_of(lung, system, 1.0, size[0], options.seed)
    if not plans:
        raise TargetError(
            f"{lung.name}: no target was found that the needle can be planned to",
            remedy="Choose another system or patient",
        )
    result.conditions = {
        "anatomy": f"{lung.name}, system {system.name}",
        "targets": f"{len(plans)} peripheral ones",
        "insertions": f"{size[1]} for each target and level; reached: within {TOLERANCE_MM:g} mm",
        "errors": "whole: those of the preset breath-hold for needle and target, and its multiples",
    }
    by_level = {
        name: inserted(lung, plans, load_errors().scaled(factor), size[1]) for name, factor in LEVELS.items()
    }
    for name, made in by_level.items():
        add_study(result, f"{name} errors", made)
    for share in SHARES:
        add_unknown(result, lung, system, share, size)
    add_replans(result, replan_times_ms(lung, plans, size[2], options.seed))
    result.figure = draw_insertions(
        lung, by_level["whole"][0], {k: v for k, v in by_level.items() if LEVELS[k]}
    )
    write_result(result, options.results)


if __name__ == "__main__":
    main()

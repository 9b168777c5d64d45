"""Needles that do not follow their plans exactly, inserted blindly and with replanning on the way.

    python experiments/closed_loop.py PATIENT|phantom [--quick] [--system lung-default] [--png FILE]

Random peripheral targets are planned for with `lungaccess.plan`.  From each start the needle is inserted
many times with errors drawn at random, in open and in closed loop.  Three tables: by size of the errors, by
curvature held in reserve for a needle that bends too little, and CPU time of the replans.  What the errors
are, and what counts as reached: docs/replanning.md.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import matplotlib
import numpy as np
from kuntz2015_reachability import peripheral_targets

import lungaccess as la
from anatomy.build import build_lung
from anatomy.grid import Float
from anatomy.lung import Lung
from anatomy.phantom import phantom
from lungaccess.target import point_target
from stages.needle.insertion.closed_loop import TOLERANCE_MM, Outcome
from stages.needle.insertion.replanning import ITERATIONS, Replanner, ReplanSettings, with_reserve
from stages.needle.insertion.study import Study, Summary, study, summary
from stages.needle.insertion.truth import Errors, tilt
from stages.needle.objective import Objective
from stages.needle.path import ArcPath, arc_transform
from stages.needle.searches import Query, RestartingRRT
from stages.needle.space import NeedleSpace, needle_space

OBJECTIVE = Objective(inverse_clearance=1.0)
PLANNING_ITERATIONS = 3000
RESERVE = 0.1
RESERVES = (0.0, 0.1, 0.2)
REPLAN_LIMIT_MS = 20.0


def errors_of_size(size: float) -> Errors:
    """Return all errors together; those of size 1 are an assumption, not measured."""
    return Errors(
        curvature_sd=0.08 * size,
        curvature_wander_sd=0.05 * size,
        roll_sd_deg=5.0 * size,
        roll_wander_deg=10.0 * size,
        pull_per_mm=0.0003 * size,
        position_noise_mm=0.4 * size,
        direction_noise_deg=0.6 * size,
        target_drift_mm=2.0 * size,
        target_walk_mm=1.0 * size,
        target_noise_mm=0.4 * size,
    )


LEVELS = {"none": 0.0, "half": 0.5, "full": 1.0, "double": 2.0}
WEAK = Errors(curvature_bias=-0.15, curvature_sd=0.05, position_noise_mm=0.2, direction_noise_deg=0.3)


@dataclass(frozen=True, kw_only=True, eq=False)
class Case:
    """A start, a target, and the plan for each curvature reserve."""

    query: Query
    plans: dict[float, ArcPath]


def cases_of(lung: Lung, system: la.System, space: NeedleSpace, count: int, seed: int) -> list[Case]:
    """Plan to random targets until `count` have a needle plan with every reserve."""
    curvature = (1.0 - max(RESERVES)) * system.needle.max_curvature_per_mm
    needle = replace(system.needle, max_curvature_per_mm=curvature)
    system = replace(system, name=f"{system.name} with a reserve", needle=needle)
    atlas = la.build_atlas(lung, system)
    cases: list[Case] = []
    for point in np.random.default_rng(seed).permutation(peripheral_targets(lung, 10 * count, seed)):
        try:
            found = next(
                la.plan(lung, system, point_target(lung, point), atlas=atlas, iterations=100, time_s=60.0)
            )
        except la.NoPlan:
            continue
        start = found.needle.lps_from_start
        query = Query(lps_from_start=start, target=point, branch=found.exemption.branch)
        plans = {reserve: needle_plan(with_reserve(space, reserve), query) for reserve in RESERVES}
        if all(plan is not None for plan in plans.values()):
            cases.append(Case(query=query, plans={r: p for r, p in plans.items() if p is not None}))
        if len(cases) == count:
            break
    return cases


def needle_plan(space: NeedleSpace, query: Query) -> ArcPath | None:
    """Return the best path of a fixed number of iterations."""
    search = RestartingRRT(space, query, objective=OBJECTIVE)
    for _ in range(100):
        if search.iterations >= PLANNING_ITERATIONS:
            break
        search.advance(PLANNING_ITERATIONS - search.iterations)
    return search.path


def inserted(space: NeedleSpace, cases: Sequence[Case], errors: Errors, reserve: float, runs: int) -> Study:
    """Insert needles to all targets."""
    studies = [
        study(
            space, case.query, case.plans[reserve], errors, seeds=range(runs * n, runs * (n + 1)),
            objective=OBJECTIVE, replanning=ReplanSettings(curvature_reserve=reserve),
        )
        for n, case in enumerate(cases)
    ]  # fmt: skip
    return Study(
        open_loop=summary(run for made in studies for run in made.open_loop.insertions),
        closed_loop=summary(run for made in studies for run in made.closed_loop.insertions),
    )


def row(name: str, mode: str, made: Summary) -> str:
    """Return a line of a table."""
    percent = {outcome: 100.0 * count / len(made.insertions) for outcome, count in made.outcomes.items()}
    return (
        f"{name:>8} {mode:>7} {percent[Outcome.REACHED]:6.1f} "
        f"[{100 * made.reached_low:5.1f},{100 * made.reached_high:6.1f}] {percent[Outcome.HIT]:6.1f} "
        f"{percent[Outcome.NO_PATH] + percent[Outcome.OUT_OF_LENGTH]:8.1f} {percent[Outcome.MISSED]:7.1f} "
        f"{made.median_error_mm:8.2f} {made.error_95_mm:7.2f} {made.clearance_mm:10.2f}\n"
    )


def table(title: str, rows: Iterable[tuple[str, Study]]) -> None:
    """Print a table."""
    sys.stdout.write(
        f"\n{title}\n{'':>8} {'':>7} {'reach%':>6} {'[95 % interv.]':>14} {'hit%':>6} {'no path%':>8} "
        f"{'missed%':>7} {'med. mm':>8} {'95% mm':>7} {'clear. mm':>10}\n"
    )
    for name, made in rows:
        sys.stdout.write(row(name, "open", made.open_loop) + row(name, "closed", made.closed_loop))


def replan_times_ms(space: NeedleSpace, cases: Sequence[Case], poses: int, seed: int = 0) -> Float:
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
            space, case.query, plan, objective=OBJECTIVE, seed=number + 20,
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


def draw(lung: Lung, case: Case, at_case: Study, by_level: dict[str, Study], runs: int, file: str) -> None:
    """Draw the true paths to one target over a slice of the lung, and the tip errors of all."""
    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(13.0, 5.2), gridspec_kw={"width_ratios": [1.5, 1.0]})
    draw_paths(left, lung, case, at_case)
    for colour, (level, made) in zip(("C0", "C1", "C2"), list(by_level.items())[1:], strict=False):
        for style, mode in (("--", made.open_loop), ("-", made.closed_loop)):
            errors = np.sort([run.tip_error_mm for run in mode.insertions])
            kind = "open loop" if style == "--" else "closed loop"
            share = np.arange(1, len(errors) + 1) / len(errors)
            right.step(
                errors, 100.0 * share, style, where="post", color=colour, label=f"{level} errors, {kind}"
            )
    right.axvline(TOLERANCE_MM, color="0.5", lw=0.8)
    right.set(
        xscale="log", xlim=(0.05, 100.0), ylim=(0.0, 100.0), xlabel="tip error, mm", ylabel="insertions, %"
    )
    right.set_title(
        f"Tip error of {len(made.open_loop.insertions)} insertions each ({lung.name})", fontsize=10
    )
    right.legend(fontsize=8, loc="lower right")
    right.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(file, dpi=130)
    plt.close(figure)
    sys.stdout.write(f"\n{file}: paths of {runs} insertions to one target, and tip errors\n")


def draw_paths(axes: Any, lung: Lung, case: Case, made: Study) -> None:
    """Draw true paths in the plane of the plan, with what the plane cuts in grey."""
    start, target = case.query.lps_from_start, case.query.target
    ahead = (target - start[:3, 3]) / np.linalg.norm(target - start[:3, 3])
    aside = start[:3, 2] - (start[:3, 2] @ ahead) * ahead
    aside = aside / np.linalg.norm(aside) if np.linalg.norm(aside) > 1e-6 else start[:3, 0]

    def flat(points: Float) -> Float:
        return np.stack([(points - start[:3, 3]) @ ahead, (points - start[:3, 3]) @ aside], axis=-1)

    length = float(np.linalg.norm(target - start[:3, 3]))
    u, v = np.meshgrid(np.arange(-6.0, length + 10.0, 0.25), np.arange(-14.0, 14.0, 0.25), indexing="xy")
    cut = start[:3, 3] + u[..., None] * ahead + v[..., None] * aside
    inside = np.array([lung.label_at(point) != 0 for point in cut.reshape(-1, 3)]).reshape(u.shape)
    extent = (u.min(), u.max(), v.min(), v.max())
    axes.imshow(inside, origin="lower", extent=extent, cmap="Greys", vmin=0.0, vmax=2.5, aspect="auto")
    for colour, mode, name in (("C1", made.open_loop, "open loop"), ("C0", made.closed_loop, "closed loop")):
        for n, run in enumerate(mode.insertions):
            points, goal = flat(run.lps_from_tip[:, :3, 3]), flat(run.target_lps)
            axes.plot(*points.T, color=colour, lw=0.8, alpha=0.7, label=None if n else name)
            axes.plot(*points[-1], "x" if run.outcome is Outcome.HIT else ".", color=colour, ms=5)
            axes.plot(*np.stack([points[-1], goal]).T, color=colour, lw=0.6, ls=":")
            axes.plot(*goal, "+", color="0.2", ms=4)
    axes.plot([], [], "+", color="0.2", ms=4, label="where the target is in the end")
    axes.plot(*flat(case.plans[RESERVE].sample(0.5)[0]).T, "k--", lw=1.0, label="plan")
    axes.set(xlabel="towards the target, mm", ylabel="aside, mm", ylim=(-14.0, 14.0))
    axes.set_title("True paths to one target, full errors; grey: what the plane cuts", fontsize=10)
    axes.legend(fontsize=8, loc="lower left")


def main() -> None:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("patient", help="folder of a patient, or 'phantom'")
    parser.add_argument("--targets", type=int, default=10)
    parser.add_argument("--runs", type=int, default=40, help="insertions per target, mode and level")
    parser.add_argument("--poses", type=int, default=1000, help="replans to time")
    parser.add_argument("--system", default="lung-default")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--png", default="closed_loop.png")
    parser.add_argument("--quick", action="store_true", help="2 targets, 5 insertions, 50 replans")
    options = parser.parse_args()
    if options.quick:
        options.targets, options.runs, options.poses = 2, 5, 50
    if options.patient == "phantom":
        lung = build_lung(phantom(seed=3, size="small").images)
    else:
        lung = la.load_patient(options.patient)
    system = la.load_system(options.system)
    fissures = lung.has_fissures and not system.fissures_allowed
    space = needle_space(lung, system.needle, system.margins, with_fissures=fissures)
    cases = cases_of(lung, system, space, options.targets, options.seed)
    if not cases:
        sys.exit(f"{lung.name}: no target was found that the needle can be planned to with every reserve")
    lengths = [case.plans[RESERVE].length_mm for case in cases]
    sys.stdout.write(
        f"{lung.name}, {system.name}: {len(cases)} targets, plans of {min(lengths):.0f} to "
        f"{max(lengths):.0f} mm, {options.runs} insertions each; reached: within {TOLERANCE_MM:g} mm\n"
    )
    by_level = {
        name: inserted(space, cases, errors_of_size(size), RESERVE, options.runs)
        for name, size in LEVELS.items()
    }
    table(f"By size of the errors, curvature reserve {RESERVE:g}", by_level.items())
    by_reserve = {f"{reserve:g}": inserted(space, cases, WEAK, reserve, options.runs) for reserve in RESERVES}
    table("By curvature reserve, needle that bends 15 % too little", by_reserve.items())
    times = replan_times_ms(space, cases, options.poses)
    sys.stdout.write(
        f"\nReplans of {ITERATIONS} iterations, CPU time from {len(times)} poses: "
        f"median {np.median(times):.1f} ms, 99 % {np.quantile(times, 0.99):.1f} ms, "
        f"largest {times.max():.1f} ms, {100.0 * (times < REPLAN_LIMIT_MS).mean():.1f} % within "
        f"{REPLAN_LIMIT_MS:g} ms\n"
    )
    longest = cases[int(np.argmax(lengths))]
    runs = min(options.runs, 12)
    at_case = inserted(space, [longest], errors_of_size(1.0), RESERVE, runs)
    draw(lung, longest, at_case, by_level, runs, options.png)


if __name__ == "__main__":
    main()

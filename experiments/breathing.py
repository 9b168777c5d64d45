"""Rigid plans beside plans for a window of the breath: reach by phases, windows beside brute force, times.

    python -m experiments.breathing [--quick] [--results FOLDER] [--patients NAME ...] [--per-lung N]

Needs LUNGACCESS_DATA with `breathing/*.csv`, landmark pairs of other patients: the motion is borrowed, see
`experiments.support.borrowed_motion`.  The targets take the motions in turn.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import lungaccess as la
from anatomy.base.typed import Float
from experiments.support.anatomies import PATIENTS, anatomy, require_data
from experiments.support.borrowed_motion import borrowed_motion
from experiments.support.results import Result, setting_of, study_parser, write_result
from experiments.support.warped_voxels import BruteForce
from lungaccess.judging.checking import Checker
from lungaccess.plans.window import BreathingWindow
from lungaccess.problem import point_target

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PHASES, ITERATIONS = 200, 20
TOUCHING_MM = 1e-3
"""Brute force measures to this; a clearance less by more is a violation."""
WINDOW_SHARE = 0.2
"""A stretch of a quiet breath of 4 s that lasts about a second."""
RIGID, FOR_WINDOW = "rigid plan", "window plan"
COLOURS = {RIGID: "#8a8a8a", FOR_WINDOW: "#2a7f4f"}


@dataclass(frozen=True)
class Case:
    """A target with its two plans; a kind without a plan has no entry."""

    windows: dict[str, BreathingWindow]
    brute: dict[str, Float]
    violations: int
    accepted: int
    window_ms: float
    first_s: float
    whole_s: float

    def longest(self, kind: str) -> float:
        """Return the longest stretch of phases in which a plan of a kind is proved."""
        window = self.windows.get(kind)
        return 0.0 if window is None else float(np.diff(window.phases, axis=1).max(initial=0.0))


def rigid_plan(lung: la.Lung, atlas: la.Atlas, place: Float, seed: int) -> la.Plan | None:
    """Return the plan of least cost in the masks' phase."""
    options = {"atlas": atlas, "iterations": ITERATIONS, "seed": seed, "counterfactuals": False}
    try:
        *_, best = la.plan(lung, atlas.system, point_target(lung, place), **options, goal="default")
    except la.NoPlan:
        return None
    return best


def window_plan(lung: la.Lung, atlas: la.Atlas, place: Float, seed: int) -> tuple[la.Plan | None, Float]:
    """Return the plan of the widest window, and the CPU time of the first plan and of the search, s."""
    began, first = time.process_time(), np.nan
    found: list[la.Plan] = []
    options = {"atlas": atlas, "iterations": ITERATIONS, "seed": seed, "counterfactuals": False}
    try:
        for each in la.plan(lung, atlas.system, point_target(lung, place), **options, goal="window"):
            found.append(each)
            first = np.fmin(first, time.process_time() - began)
    except la.NoPlan:
        pass
    return found[-1] if found else None, np.array([first, time.process_time() - began])


def brute_force(plan: la.Plan, window: BreathingWindow, lung: la.Lung) -> tuple[Float, int]:
    """Return which of `PHASES` phases are good by brute force, and how many of the window are not."""
    brute, phases = BruteForce(plan, lung, lung.motion), np.linspace(0.0, 1.0, PHASES)
    spare = np.array([brute.clearance(phase).min() for phase in phases])
    miss = np.array([brute.miss_mm(phase) for phase in phases])
    held = np.array([window.holds(phase) for phase in phases])
    broken = held & ((spare < -TOUCHING_MM) | (miss > window.tolerance_mm + 1e-9))
    return (spare >= 0.0) & (miss <= window.tolerance_mm), int(broken.sum())


def case_of(lung: la.Lung, checker: Checker, atlas: la.Atlas, place: Float, seed: int) -> Case:
    """Plan to a target in both ways, and judge both plans by brute force and by the check."""
    made, (first_s, whole_s) = window_plan(lung, atlas, place, seed)
    windows, brute, violations, accepted, took = {}, {}, 0, 0, np.nan
    for kind, plan in ((RIGID, rigid_plan(lung, atlas, place, seed)), (FOR_WINDOW, made)):
        if plan is None:
            continue
        la.breathing_window(plan, lung)  # Compiled and in memory before the clock starts.
        began = time.process_time()
        windows[kind] = la.breathing_window(plan, lung)
        took = np.nanmax([took, 1000.0 * (time.process_time() - began)])
        brute[kind], broken = brute_force(plan, windows[kind], lung)
        violations += broken
        accepted += checker.check(replace(plan, window=windows[kind])).accepted
    return Case(windows, brute, violations, accepted, float(took), float(first_s), float(whole_s))


def cases_of(name: str, per_lung: int, seed: int) -> Iterator[Case]:
    """Yield the targets of a patient."""
    lung = anatomy(name)
    atlas = la.open_atlas(lung, la.load_system("thin-scope"))
    pairs = sorted(require_data("breathing").glob("*.csv"))
    moving = [replace(lung, motion=borrowed_motion(each, lung)) for each in pairs]
    checkers = [Checker(each) for each in moving]
    places = la.peripheral_targets(lung, per_lung, seed)
    window_plan(moving[0], atlas, places[0], seed)  # Compiled and in memory before the clock starts.
    for number, place in enumerate(places):
        turn = number % len(moving)
        yield case_of(moving[turn], checkers[turn], atlas, place, seed)


def _share(values: list[bool]) -> float:
    return 100.0 * float(np.mean(values))


REACHES: dict[str, Callable[[float], bool]] = {
    "in one phase": lambda longest: longest > 0.0,
    f"in {100.0 * WINDOW_SHARE:.0f} % of the breath on end": lambda longest: longest >= WINDOW_SHARE,
    "in all phases": lambda longest: longest >= 1.0,
}


def add_rows(result: Result, name: str, cases: list[Case]) -> None:
    """Add the rows of one patient."""
    for words, holds in REACHES.items():
        for kind in (RIGID, FOR_WINDOW):
            share = _share([holds(case.longest(kind)) for case in cases])
            result.add(f"{name}: targets reached {words}, {kind}", share, unit="%")
    pairs = [(case.windows[kind], case.brute[kind]) for case in cases for kind in case.windows]
    ratios = []
    for window, good in pairs:
        held = np.array([window.holds(phase) for phase in np.linspace(0.0, 1.0, PHASES)])
        ratios += [float((held & good).sum() / good.sum())] if good.any() else []
    result.add(f"{name}: plans judged at {PHASES} phases", float(len(pairs)))
    violations = sum(case.violations for case in cases)
    result.add(f"{name}: phases of windows that brute force finds blocked", float(violations))
    result.add(f"{name}: windows that the check accepts", float(sum(case.accepted for case in cases)))
    note = f"{_share([r >= 0.95 for r in ratios]):.0f} % of the plans have at least 95 %"
    result.add(
        f"{name}: window, share of brute force, median", 100.0 * np.median(ratios), unit="%", note=note
    )
    ms = np.array([case.window_ms for case in cases if case.windows])
    result.add(
        f"{name}: CPU time of a window, median",
        float(np.median(ms)),
        unit="ms",
        note=f"most {ms.max():.0f} ms",
    )
    first = np.array([case.first_s for case in cases if np.isfinite(case.first_s)])
    if len(first):
        note = f"90 %: {np.percentile(first, 90):.2f} s, most {first.max():.2f} s"
        result.add(
            f"{name}: CPU time of a first window plan, median", float(np.median(first)), unit="s", note=note
        )
    whole = np.array([case.whole_s for case in cases])
    result.add(f"{name}: CPU time of its search, median", float(np.median(whole)), unit="s")


def figure_of(found: dict[str, list[Case]]) -> Figure:
    """Draw the share of targets over the stretch of the breath in which a plan is proved."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 3.2))
    for column, (name, cases) in enumerate(found.items(), 1):
        axes = figure.add_subplot(1, len(found), column)
        asked = np.linspace(0.0, 1.0, 201)
        for kind, colour in COLOURS.items():
            longest = np.array([case.longest(kind) for case in cases])
            reached = [100.0 * float(((longest > 0.0) & (longest >= share)).mean()) for share in asked]
            axes.plot(100.0 * asked, reached, color=colour, label=kind)
        axes.axvline(100.0 * WINDOW_SHARE, color="#cccccc", linewidth=0.8, zorder=0)
        axes.set(xlim=(0, 100), ylim=(0, 100), title=f"{name}, {len(cases)} targets")
        axes.set_xlabel("phases on end in which a plan is proved, % of the breath", fontsize=8)
        if column == 1:
            axes.set_ylabel("targets reached, %")
            axes.legend(fontsize=8, frameon=False)
    figure.tight_layout()
    return figure


def main() -> None:
    """Measure, print, and write the result."""
    parser = study_parser(__doc__ or "")
    parser.add_argument("--patients", nargs="+", default=PATIENTS, metavar="NAME")
    parser.add_argument("--per-lung", type=int, help="targets in each lung (default: 30, quick 4)")
    options = parser.parse_args()
    setting = setting_of(options)
    per_lung = options.per_lung or (4 if options.quick else 30)
    result = Result(
        name="breathing", title="Reach while the lung breathes, and windows beside brute force",
        setting=setting,
        conditions={
            "motion": "borrowed: fields of five patients in quiet breathing carried onto the lungs, in turn",
            "masks": "taken to show end-exhale",
            "targets": f"{per_lung} peripheral ones in each lung",
            "plans": f"thin-scope, {ITERATIONS} iterations; rigid: least cost in the masks' phase; window: "
            "widest window",
        },
        seeds=[options.seed],
    )  # fmt: skip
    found = {}
    for name in options.patients:
        found[Path(name).name] = list(cases_of(name, per_lung, options.seed))
        add_rows(result, Path(name).name, found[Path(name).name])
    result.figure = figure_of(found)
    print(write_result(result, options.results))


if __name__ == "__main__":
    main()

"""Windows of breathing beside brute force on deformed voxels, with others' motion carried onto a patient.

python -m experiments.breathing_windows PATIENT PAIRS.csv [PAIRS.csv ...] [--per-lung N] [--plot FILE.png]

PAIRS are landmarks of other patients, see `experiments.support.borrowed_motion`: the motion is borrowed.  The
plans, one a peripheral target, take the motions in turn.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

import lungaccess as la
from experiments.support.borrowed_motion import borrowed_motion
from experiments.support.warped_voxels import BruteForce
from lungaccess.checking import Checker
from lungaccess.problem import point_target

PHASES, ITERATIONS, SEED = 200, 20, 0
TOUCHING_MM = 1e-3
"""Brute force measures to this; a clearance less by more is a violation."""


def plans_of(lung: la.Lung, per_lung: int) -> list[la.Plan]:
    """Return the best plan to each of some peripheral targets that has one."""
    system = la.load_system("lung-default")
    atlas = la.open_atlas(lung, system)
    limits = {"atlas": atlas, "iterations": ITERATIONS, "seed": SEED, "counterfactuals": False}
    found = []
    for place in la.peripheral_targets(lung, per_lung, SEED):
        try:
            *_, best = la.plan(lung, system, point_target(lung, place), **limits)
        except la.NoPlan:
            continue
        found.append(best)
    return found


def main() -> None:
    """Print each window beside the brute-force one, then a summary."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("patient")
    parser.add_argument("pairs", nargs="+")
    parser.add_argument("--per-lung", type=int, default=30)
    parser.add_argument("--plot", type=Path)
    options = parser.parse_args()
    lung = la.load_patient(options.patient)
    moving = []
    for pairs in options.pairs:
        began = time.process_time()
        motion = borrowed_motion(pairs, lung)
        print(f"{pairs}: prepared in {time.process_time() - began:.2f} s CPU", flush=True)
        moving.append(replace(lung, motion=motion))
    rows, shown = [], []
    phases = np.linspace(0.0, 1.0, PHASES)
    checkers = [Checker(each) for each in moving]
    for number, plan in enumerate(plans_of(lung, options.per_lung)):
        breathing = moving[number % len(moving)]
        la.breathing_window(plan, breathing)  # Compiled and in memory before the clock starts.
        began = time.process_time()
        window = la.breathing_window(plan, breathing)
        took = time.process_time() - began
        brute = BruteForce(plan, lung, breathing.motion)
        spare = np.array([brute.clearance(phase).min() for phase in phases])
        miss = np.array([brute.miss_mm(phase) for phase in phases])
        held = np.array([window.holds(phase) for phase in phases])
        good = (spare >= 0.0) & (miss <= window.tolerance_mm)
        broken = held & ((spare < -TOUCHING_MM) | (miss > window.tolerance_mm + 1e-9))
        accepted = checkers[number % len(moving)].check(replace(plan, window=window)).accepted
        share = (held & good).sum() / good.sum() if good.any() else np.nan
        rows.append(
            (held.mean(), good.mean(), share, broken.sum(), took, window.undecided_share, miss[-1], accepted)
        )
        shown.append((window, good))
        reasons = ", ".join(f"{each.reason} at {each.phase:.3f}" for each in window.limits)
        print(
            f"{number}: {held.mean():.3f} of {good.mean():.3f}, {1000 * took:.1f} ms; {reasons}", flush=True
        )
    table = np.array(rows, dtype=float)
    some = table[np.isfinite(table[:, 2])]
    print(f"{len(table)} plans; violations {int(table[:, 3].sum())}; check accepts {int(table[:, 7].sum())}")
    ratio = some[:, 0].sum() / some[:, 1].sum()
    print(f"window / brute force: median {np.median(some[:, 2]):.3f}, of the sums {ratio:.3f}")
    print(
        f"at least 95 %: {(some[:, 2] >= 0.95).mean():.2f} of the plans; undecided {table[:, 5].mean():.5f}"
    )
    print(f"ms a window: {np.percentile(1000 * table[:, 4], [50, 90, 100]).round(1)}")
    print(f"window, share of the breath: {np.percentile(table[:, 0], [25, 50, 75]).round(2)}; whole breath "
          f"{(table[:, 0] == 1.0).mean():.2f}, none {(table[:, 0] == 0.0).mean():.2f}")  # fmt: skip
    print(f"miss at full breath: median {np.median(table[:, 6]):.2f} mm")
    if options.plot:
        plot(shown, options.plot)


def plot(shown: list[tuple[la.BreathingWindow, np.ndarray]], path: Path) -> None:
    """Draw the window of each plan, and above it the brute-force one."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 0.16 * len(shown) + 1.2))
    axes = figure.add_subplot()
    order = sorted(shown, key=lambda each: each[0].share)
    for row, (window, good) in enumerate(order):
        axes.barh(row - 0.2, 1.0 / PHASES, 0.35, left=np.flatnonzero(good) / PHASES, color="#c9c9c9")
        for begin, end in window.phases:
            axes.barh(row + 0.2, end - begin, 0.35, left=begin, color="#2a7f4f")
    axes.set(xlabel="phase: 0 end-exhale, 1 end-inhale", ylabel="plan", xlim=(0.0, 1.0))
    axes.set_title("Proved window (green) and brute force at 200 phases (grey)", fontsize=9)
    figure.savefig(path, dpi=130, bbox_inches="tight")


if __name__ == "__main__":
    main()

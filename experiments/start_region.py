"""How well the safe start region ranks plans by their chance of success.

    python -m experiments.start_region PATIENT [PATIENT ...] [--plans 20] [--iterations 8]
        [--system ultrathin] [--seed 22] [--keep FOLDER]

One plan to each of many peripheral targets, fissures crossed.  Of each: the proved and the tried part, the
chance of success open loop (`lungaccess.assess`, default errors), the share of deviated tips of the tubes
from which a needle still has a path, and the chance with a procedure that measures the tip, alone or after
the scope (`lungaccess.simulate_procedure`).  How tight the proved part is follows from poses on its border,
and from others 1.5 and 2 times as far off.  Printed are the plans, and Spearman's rank correlations, over
the ranks within each patient.  FOLDER keeps the plans.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import lungaccess as la
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.planning.procedure import simulate_procedure
from lungaccess.plans.curves import needle_pieces
from lungaccess.plans.plan import Plan
from lungaccess.problem.procedures import ScopePlacing, load_procedure
from lungaccess.uncertainty.risk import RiskAssessor
from lungaccess.uncertainty.risk.deviations import deviated_pieces, deviated_starts
from stages.needle import (
    REACHING,
    ArcPath,
    NeedleEnvironment,
    Query,
    StartRegion,
    arc_transform,
    needle_environment,
    proved_factor,
    try_poses,
)

DRAWS = 2000
"""Deviated plans: a share of one half is then known to 2 %."""
PROCEDURES = 200
"""Simulated procedures of a plan: one half is then known to 7 %, which is enough to rank."""
MEASURES = (
    "proved factor", "proved volume", "proved offset", "proved tilt", "tried share", "tried near",
    "least clearance", "needle length", "cost",
)  # fmt: skip
WHOLE = {"offset_mm": 5.0, "tilt_rad": np.radians(7.0)}
"""A scope off by 1.3 mm and 2 degrees an axis puts the end of 40 mm of tubes off by 3 mm and 4 degrees."""
TIMES = (1.0, 1.5, 2.0)
BORDER = 1000
"""Poses on the border of a proved part."""
CHANCES = ("open loop", "path from tip", "tip measured", "measured-tip")
"""Nothing measured; a path from the deviated tip; the tip alone measured; the preset procedure."""


def plans_of(lung: Lung, system: la.System, count: int, iterations: int, seed: int) -> Iterator[Plan]:
    """Yield the last plan of a search to each of so many peripheral targets that have one."""
    made = 0
    for point in la.peripheral_targets(lung, count, seed):
        try:
            *_, plan = la.plan(
                lung, system, la.point_target(lung, point), iterations=iterations, seed=0, goal="default"
            )
        except la.NoPlan:
            continue
        yield plan
        made += 1
        if made == count:
            return


def kept_plans(
    lung: Lung, system: la.System, folder: Path | None, asked: argparse.Namespace
) -> Iterator[Plan]:
    """Yield the plans of a folder if it has any, else make them, and keep them there."""
    files = sorted(folder.glob(f"{lung.name}-*.json")) if folder else []
    if files:
        yield from (Plan.load(file) for file in files[: asked.plans])
        return
    for number, plan in enumerate(plans_of(lung, system, asked.plans, asked.iterations, asked.seed)):
        if folder:
            folder.mkdir(parents=True, exist_ok=True)
            plan.save(folder / f"{lung.name}-{number:02d}.json")
        yield plan


def measured(plan: Plan, lung: Lung) -> tuple[dict[str, float], float]:
    """Return all measures and chances of a plan, and the CPU seconds that the region took."""
    began = time.process_time()
    region = la.safe_start_region(plan, lung)
    spent = time.process_time() - began
    proved, tried = region.proved, region.tried
    values = {
        "proved factor": proved_factor(*asked_of(plan, lung, region.radius_mm), **WHOLE),
        "proved volume": proved.volume,
        "proved offset": float(proved.offsets_mm.max(initial=0.0)),
        "proved tilt": float(np.degrees(proved.tilts_rad.max(initial=0.0))),
        "tried share": tried.share(),
        "tried near": tried.share(2.0, np.radians(6.0)),
        "least clearance": min(
            away for name, away in plan.clearance_mm["needle"].items() if name != "fissure"
        ),
        "needle length": plan.needle.length_mm if plan.needle else 0.0,
        "cost": plan.cost,
        "open loop": la.assess(plan, lung, samples=DRAWS, each_kind=False).succeeds.value,
        "path from tip": share_of_tips(plan, lung, region.radius_mm),
    }
    whole = load_procedure("measured-tip")
    for procedure in (replace(whole, name="tip measured", scope=ScopePlacing()), whole):
        report = simulate_procedure(plan, lung, procedure=procedure, samples=PROCEDURES)
        values[procedure.name] = report.succeeds.value
    values |= {f"at {far:g}": share_at(plan, lung, region, far) for far in TIMES}
    return values, spent


def share_at(plan: Plan, lung: Lung, region: StartRegion, times: float) -> float:
    """Return the share of poses with a path, so many times as far off as the border of the proved part."""
    rng, frame, proved = np.random.default_rng(0), region.lps_from_start, region.proved
    aside = rng.normal(size=(BORDER, 3))
    aside *= times * proved.offset_mm / np.linalg.norm(aside, axis=1)[:, None]
    around, tilt = rng.uniform(0.0, 2.0 * np.pi, BORDER), times * proved.tilt_rad
    across = np.stack([np.cos(around), np.sin(around)], axis=1) @ frame[:3, :2].T
    tangents = np.cos(tilt) * frame[:3, 2] + np.sin(tilt) * across
    return share_of_poses(plan, lung, region.radius_mm, frame[:3, 3] + aside, tangents)


def share_of_tips(plan: Plan, lung: Lung, radius_mm: float) -> float:
    """Return the share of deviated tips of the tubes from which a clear path is found."""
    assessor = RiskAssessor(plan, lung)
    deviations = assessor.draws(DRAWS, 0).deviations(la.load_errors())
    starts, pieces = deviated_starts(plan, lung, deviations), deviated_pieces(plan, deviations)
    tubes = pieces[:, : pieces.shape[1] - assessor.n_arcs]
    frames = np.stack([tip_after(start, arcs) for start, arcs in zip(starts, tubes, strict=True)])
    return share_of_poses(plan, lung, radius_mm, frames[:, :3, 3], frames[:, :3, 2])


def share_of_poses(plan: Plan, lung: Lung, radius_mm: float, positions: Float, tangents: Float) -> float:
    """Return the share of start poses from which a clear path is found."""
    kinds = try_poses(*asked_of(plan, lung, radius_mm), positions, tangents, iterations=100, seed=0)
    return float(np.isin(kinds, REACHING).mean())


def asked_of(plan: Plan, lung: Lung, radius_mm: float) -> tuple[NeedleEnvironment, Query, ArcPath]:
    """Return what the functions of the needle stage are asked of a plan."""
    environment = needle_environment(
        lung, plan.system.require_needle("the study"), plan.system.margins,
        with_fissures=plan.fissures_are_obstacles, goal_tolerance_mm=radius_mm,
    )  # fmt: skip
    start = plan.tube.lps_from_tip
    query = Query(lps_from_start=start, target=plan.target_lps, branch=plan.exemption.branch)
    return environment, query, ArcPath(lps_from_start=start, arcs=needle_pieces(plan.needle))


def tip_after(start: Float, arcs: Float) -> Float:
    """Return the frame after arcs `(T, 4)` from a tip of the scope: point, tangent and +x axis `(9,)`."""
    frame = np.eye(4)
    frame[:3, 3], frame[:3, 2], frame[:3, 0] = start[:3], start[3:6], start[6:]
    frame[:3, 1] = np.cross(frame[:3, 2], frame[:3, 0])
    for length, roll, curvature, _radius in arcs:
        frame = frame @ arc_transform(length, roll, curvature)
    return frame


def correlation(rows: list[dict[str, float]], groups: list[str], measure: str, chance: str) -> float:
    """Return Spearman's correlation of a measure with a chance, over the ranks within each group."""
    from scipy.stats import rankdata

    ranked = []
    for name in (measure, chance):
        values = np.array([row[name] for row in rows])
        ranks = np.zeros(len(values))
        for group in sorted(set(groups)):
            part = np.array(groups) == group
            ranks[part] = (rankdata(values[part]) - 0.5) / part.sum() - 0.5
        ranked.append(ranks)
    return float(ranked[0] @ ranked[1] / np.sqrt((ranked[0] @ ranked[0]) * (ranked[1] @ ranked[1])))


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all plans, and print them with the correlations."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("patients", nargs="+", type=Path)
    parser.add_argument("--plans", type=int, default=20)
    parser.add_argument("--iterations", type=int, default=8)
    parser.add_argument("--system", default="ultrathin")
    parser.add_argument("--seed", type=int, default=22)
    parser.add_argument("--keep", type=Path)
    asked = parser.parse_args(arguments)
    system = replace(la.load_system(asked.system), name=f"{asked.system}, fissures", fissures_allowed=True)
    rows: list[dict[str, float]] = []
    groups: list[str] = []
    times: list[float] = []
    for patient in asked.patients:
        lung = la.load_patient(patient)
        for plan in kept_plans(lung, system, asked.keep, asked):
            values, spent = measured(plan, lung)
            rows.append(values)
            groups.append(lung.name)
            times.append(spent)
            told = "  ".join(f"{name} {value:.3g}" for name, value in values.items())
            sys.stdout.write(f"{lung.name}: {told}\n")
    # The first one compiles.
    sys.stdout.write(f"{len(rows)} plans, median {np.median(times[1:]):.2f} s of CPU for a region\n")
    for far in TIMES:
        shares = [row[f"at {far:g}"] for row in rows]
        sys.stdout.write(
            f"{far:g} times the proved part: median {np.median(shares):.3f}, least {min(shares):.3f}\n"
        )
    for measure in MEASURES:
        found = (f"{chance} {correlation(rows, groups, measure, chance):+.2f}" for chance in CHANCES)
        sys.stdout.write(f"{measure:16}  {'  '.join(found)}\n")


if __name__ == "__main__":
    main()

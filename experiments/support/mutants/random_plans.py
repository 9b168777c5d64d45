"""Random plans: random systems, coarse atlases, targets all over the lung, and all planners."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

import lungaccess as la
from anatomy import structures
from anatomy.base.errors import SettingsError, TargetError
from anatomy.base.settings import override
from anatomy.base.typed import Float
from anatomy.lung import Lung
from experiments.support.mutants.draws import Rng
from lungaccess.planning.coupled import DirectArcs
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.plans.assemble import assemble
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from lungaccess.problem.target import Target, nodule_target, point_target
from lungaccess.problem.task import Task, objective_of
from stages.needle import TERMS, ArcPath

TWISTED = "curved-outer"
"""A preset whose tubes are turned one against the other; it is asked for by name only."""
TARGETS = 100
PLANS_A_BATCH = 60
AT_A_TIME = 5
TRIED = 60
"""Deployments from which a needle of several arcs is tried."""
JOINT_ITERATIONS = 402
"""The joint refinement comes once, after 400 iterations."""


def random_system(rng: Rng) -> System:
    """Return a preset, or one with planar tubes and a needle with other sizes, limits and margins."""
    preset = la.load_system(str(rng.choice([*la.preset_names(), TWISTED])))
    if rng.random() < 0.2 or preset.needle is None or not preset.tubes.planar:
        return preset
    while True:
        scope, needle = preset.scope.outer_diameter_mm, preset.needle.diameter_mm
        edits: dict[str, Any] = {
            "name": "random",
            "scope.outer_diameter_mm": scope * rng.uniform(0.75, 1.2),
            "scope.lumen_margin_mm": rng.choice([0.0, rng.uniform(0.0, 0.5)]),
            "tubes.max_lateral_sweep_mm": rng.uniform(0.1, 2.0),
            "tubes.min_wall_angle_deg": rng.uniform(5.0, 40.0),
            "tubes.max_wall_run_mm": rng.uniform(2.0, 8.0),
            "tubes.max_extension_mm": rng.uniform(30.0, 60.0),
            "tubes.inner.curved_length_mm": rng.uniform(20.0, 60.0),
            "tubes.inner.precurvature_per_mm": rng.uniform(0.005, 0.035),
            "needle.diameter_mm": needle * rng.uniform(0.6, 1.3),
            "needle.max_curvature_per_mm": np.exp(rng.uniform(np.log(0.002), np.log(0.03))),
            "needle.max_length_mm": rng.uniform(60.0, 150.0),
            "needle.max_angle_from_start_deg": rng.uniform(20.0, 90.0),
            "needle.max_accumulated_turn_deg": rng.uniform(30.0, 180.0),
            "needle.exit_exemption_mm": rng.uniform(0.0, 8.0),
            "margins.segmentation_margin_mm": rng.uniform(0.0, 1.2),
            "margins.registration_margin_mm": rng.choice([0.0, rng.uniform(0.0, 0.5)]),
        }
        chosen = {key: value for key, value in edits.items() if key == "name" or rng.random() < 0.6}
        plain = {key: v if isinstance(v, str) else float(v) for key, v in chosen.items()}
        try:
            return override(preset, {**plain, "fissures_allowed": bool(rng.random() < 0.4)})
        except SettingsError:
            continue


@cache
def nodule_of(lung: Lung, number: int) -> Target | None:
    """Return a nodule as target, None if there is no such one."""
    try:
        return nodule_target(lung, number)
    except TargetError:
        return None


def random_target(lung: Lung, atlas: Atlas, rng: Rng) -> Target | None:
    """Return a nodule, a point anywhere in the lung, one beside an obstacle, or one ahead of a tube."""
    kind = rng.random()
    try:
        if kind < 0.1 and lung.nodules is not None:
            return nodule_of(lung, 1 + int(rng.integers(4)))
        entries = atlas.deployments
        if kind < 0.5 and entries.count:
            entry = int(rng.integers(entries.count))
            ahead, aside = rng.uniform(3.0, 80.0), 0.2 * rng.standard_normal(3)
            return point_target(lung, entries.positions[entry] + ahead * (entries.tangents[entry] + aside))
        return point_target(lung, free_point(lung, rng, beside_obstacle=kind > 0.85))
    except TargetError:
        return None


def free_point(lung: Lung, rng: Rng, *, beside_obstacle: bool) -> Float:
    """Return a point of the lung in no obstacle; beside one if asked for."""
    obstacles = structures.VESSEL | structures.OUTSIDE | structures.AIRWAY | structures.FISSURE
    field = lung.obstacle_field(with_fissures=True)
    while True:
        index = rng.uniform(-0.5, np.array(lung.grid.shape) - 0.5)
        point = np.asarray(lung.grid.lps(index))
        if lung.label_at(point) & obstacles == 0 and not (
            beside_obstacle and field.lower_bound_mm(point)[0] > 2.0
        ):
            return point


def plans_to(lung: Lung, system: System, target: Target, atlas: Atlas, rng: Rng) -> Iterator[Plan]:
    """Yield plans by a planner drawn at random; none if there is none."""
    objective, seed, kind = (
        str(rng.choice([term.key for term in TERMS])),
        int(rng.integers(2**31)),
        rng.random(),
    )
    if kind > 0.75 and system.needle is not None:
        yield from bent_plans(
            Task(
                lung=lung,
                system=system,
                target=target,
                objective=objective_of(lung, objective),
                method="bent",
                seed=seed,
            ),
            atlas,
            rng,
        )
        return
    try:
        if kind < 0.5:
            found = la.alternatives(
                lung, system, target, goal=objective, count=AT_A_TIME, separation_mm=3.0, atlas=atlas
            )
            yield from (each.plan for each in found)
            return
        paper = kind > 0.7 and system.needle is not None and system.tubes.planar
        method = "kuntz2015" if paper else "atlas"
        iterations = 200 if method == "kuntz2015" else int(rng.choice([1, 40, 150, JOINT_ITERATIONS]))
        found = la.plan(
            lung, system, target, goal=objective, method=method, seed=seed, iterations=iterations,
            atlas=atlas,
        )  # fmt: skip
        yield from list(found)[-AT_A_TIME:]
    except (la.NoPlan, TargetError):
        return


def bent_plans(task: Task, atlas: Atlas, rng: Rng) -> Iterator[Plan]:
    """Yield plans of several arcs at random, from deployments near the target, to where they end."""
    device = task.system.require_needle("A path of several arcs")
    arcs_to_target = DirectArcs(task, atlas)
    made = 0
    for entry in rng.permutation(arcs_to_target.in_workspace)[:TRIED]:
        candidate = arcs_to_target.proved(int(entry))
        if candidate is None:
            continue
        count = int(rng.integers(2, 6))
        arcs = np.stack(
            [
                rng.uniform(0.5, 25.0, count),
                rng.uniform(-np.pi, np.pi, count),
                device.max_curvature_per_mm * rng.choice([0.0, 1.0, rng.random()], count),
            ],
            axis=1,
        )
        path = ArcPath(lps_from_start=candidate.deployment.lps_from_tip, arcs=arcs)
        if (
            path.length_mm > device.max_length_mm
            or path.accumulated_turn_rad > np.deg2rad(device.max_accumulated_turn_deg)
            or path.max_angle_from_start_rad() > np.deg2rad(device.max_angle_from_start_deg)
        ):
            continue
        end = Target(lps_mm=path.frames()[-1][:3, 3], origin="point")
        # A path has to end at the target of its task, so each is proved in a task of its own.
        try:
            here = replace(task, target=end)
        except TargetError:
            continue
        if not CandidateEvaluator(here).proves(candidate.deployment, path):
            continue
        yield assemble(here, replace(candidate, path=path), iteration=0, timing={})
        made += 1
        if made == AT_A_TIME:
            return


def plans_of_batch(lung: Lung, rng: Rng) -> Iterator[tuple[System, Float, Plan]]:
    """Yield plans of one random system, with the system and the target that were asked for."""
    system = random_system(rng)
    atlas = la.build_atlas(
        lung, system, rotations=int(rng.choice([12, 24])), stop_spacing_mm=4.0, site_spacing_mm=3.0
    )
    made = 0
    for _ in range(TARGETS):
        target = random_target(lung, atlas, rng)
        if target is None:
            continue
        for plan in plans_to(lung, system, target, atlas, rng):
            yield system, plan.target_lps if plan.method == "bent" else target.lps_mm, plan
            made += 1
            if made == PLANS_A_BATCH:
                return

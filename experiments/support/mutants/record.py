"""False statements about a plan: its system, its patient, its clearances and costs."""

from __future__ import annotations

from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.settings import override, to_mapping
from experiments.support.mutants.draws import Rng, direction, far, signed
from experiments.support.mutants.mutant import Case, Mutant, Mutation, changed, with_system

SEEN_MM = 0.05
"""A stated clearance may be so much too large."""


def margins_edited(case: Case, rng: Rng) -> Mutant | None:
    """Margins smaller than those that were asked for, all else consistent."""
    key = str(rng.choice(["segmentation_margin_mm", "registration_margin_mm"]))
    value = getattr(case.plan.system.margins, key)
    if value <= 0.0:
        return None
    system = override(case.plan.system, {f"margins.{key}": value * float(rng.uniform(0.0, 0.99))})
    return Mutant(plan=with_system(case.plan, system), asked=True)


def device_edited(case: Case, rng: Rng) -> Mutant | None:
    """Another size or limit of a device than asked for, all else consistent."""
    part = str(rng.choice(["scope", "tubes", "tubes.outer", "tubes.inner", "needle"]))
    values: Any = to_mapping(case.plan.system)
    for key in part.split("."):
        values = values[key]
    if values is None:
        return None
    names = [k for k, v in values.items() if isinstance(v, float) and v > 0.0]
    name = str(rng.choice(names))
    try:
        system = override(case.plan.system, {f"{part}.{name}": values[name] * float(rng.uniform(0.7, 1.4))})
    except SettingsError:
        return None
    return Mutant(plan=with_system(case.plan, system), asked=True)


def scope_diameter_edited(case: Case, rng: Rng) -> Mutant | None:
    """The scope is as thick as the lumen is narrow, and thicker; the name is its own."""
    least = next((f.value for f in case.report.findings if f.name == "scope.fits"), None)
    if least is None:
        return None
    diameter = 2.0 * (least - case.plan.system.scope.lumen_margin_mm) + far(rng, 0.01, 5.0)
    try:
        system = override(case.plan.system, {"scope.outer_diameter_mm": diameter, "name": "own"})
    except SettingsError:
        return None
    return Mutant(plan=with_system(case.plan, system))


def device_too_weak(case: Case, rng: Rng) -> Mutant | None:
    """A device of its own name whose limit the plan breaks."""
    keys = {
        "needle.max_curvature_per_mm": "needle.curvature",
        "needle.max_length_mm": "needle.length.limit",
        "needle.max_angle_from_start_deg": "needle.angle.limit",
        "needle.max_accumulated_turn_deg": "needle.turn.limit",
        "needle.exit_exemption_mm": "exemption.length",
        "tubes.max_extension_mm": "tube.extension",
        "tubes.max_lateral_sweep_mm": "tube.sweep.limit",
        "tubes.max_strain": "tube.strain",
        "tubes.max_wall_run_mm": "tube.wall_run.limit",
        "tubes.min_wall_angle_deg": "tube.exit.angle.stated_limit",
    }
    key = str(rng.choice(list(keys)))
    finding = next((f for f in case.report.findings if f.name == keys[key]), None)
    if finding is None or finding.value is None or finding.value < 0.05 * (finding.limit or 1.0):
        return None
    if key == "tubes.max_lateral_sweep_mm" and finding.value < 0.9:
        return None
    value = np.rad2deg(finding.value) if finding.unit == "rad" else finding.value
    factor = far(rng, 1.1, 2.0)
    value = value * factor if finding.side == "at least" else value / factor
    try:
        system = override(case.plan.system, {key: float(value), "name": "own"})
    except SettingsError:
        return None
    return Mutant(plan=with_system(case.plan, system))


def required_edited(case: Case, rng: Rng) -> Mutant | None:
    """A required clearance that is not radius plus margins."""
    stated = dict(case.plan.required_clearance_mm)
    stated[str(rng.choice(list(stated)))] += signed(rng, 1e-6, 1.0)
    return Mutant(plan=changed(case.plan, required_clearance_mm=stated))


def identity_edited(case: Case, rng: Rng) -> Mutant | None:
    """Another patient, image, breath-hold, schema, system or fissure rule."""
    plan = case.plan
    edits: dict[str, Any] = {
        "patient_name": plan.patient_name + "x",
        "lung_key": plan.lung_key[:-1] + ("0" if plan.lung_key[-1] != "0" else "1"),
        "sources": {**plan.sources, "airway.nii.gz": "1" * 64},
        "breath_hold": "expiration" if plan.breath_hold != "expiration" else None,
        "schema": "lungaccess-plan-0",
        "software_version": " ",
        "system_fingerprint": plan.system_fingerprint[::-1],
        "fissures_are_obstacles": not plan.fissures_are_obstacles,
        "objective": "beauty",
    }
    key = str(rng.choice(list(edits)))
    return Mutant(plan=changed(plan, **{key: edits[key]}))


def target_moved(case: Case, rng: Rng) -> Mutant | None:
    """The target is not where the needle ends, or not the one asked for."""
    size = far(rng, 0.01, 30.0)
    point = case.plan.target_lps + size * direction(rng)
    if case.plan.target_origin.startswith("nodule"):
        point = case.plan.target_lps + 150.0 * direction(rng)
        return Mutant(plan=changed(case.plan, target_lps=point))
    return Mutant(plan=changed(case.plan, target_lps=point), asked=bool(rng.integers(2)))


def clearance_overstated(case: Case, rng: Rng) -> Mutant | None:
    """More clearance is stated than there is."""
    stage = str(rng.choice(list(case.plan.clearance_mm)))
    stated = {key: dict(value) for key, value in case.plan.clearance_mm.items()}
    name = str(rng.choice(list(stated[stage])))
    most = case.limit(f"{stage}.clearance.{name}.stated")
    if most is None or most > 19.5:
        return None
    stated[stage][name] = min(most + SEEN_MM + far(rng, 0.01, 10.0), 19.9)
    return Mutant(plan=changed(case.plan, clearance_mm=stated)) if stated[stage][name] > most + 0.06 else None


def clearance_understated(case: Case, rng: Rng) -> Mutant | None:
    """Much less clearance is stated than there is: not this plan's."""
    stage = str(rng.choice(list(case.plan.clearance_mm)))
    stated = {key: dict(value) for key, value in case.plan.clearance_mm.items()}
    name = str(rng.choice(list(stated[stage])))
    least = case.limit(f"{stage}.clearance.{name}.stated.least")
    slack = float(np.linalg.norm(case.lung.grid.spacing_mm)) + 0.25
    if least is None or least < slack + 0.01:
        return None
    stated[stage][name] = float(rng.uniform(0.0, least - slack - 0.01))
    return Mutant(plan=changed(case.plan, clearance_mm=stated))


def costs_edited(case: Case, rng: Rng) -> Mutant | None:
    """A cost that is not the needle's, or is missing."""
    costs = dict(case.plan.costs)
    name = str(rng.choice(list(costs)))
    # What is stated may be wrong by 2 % already, and by a voxel.
    least = {"length_mm": 1e-5, "cost_map": 0.01}.get(name, 0.0)
    if name != "length_mm":
        least += 0.05 * costs[name] + (2.1 if name == "voxel_sum" else 0.0)
    if rng.integers(8) == 0 and name != "voxel_sum":
        del costs[name]
    else:
        costs[name] += signed(rng, least, 10.0 * least)
    return Mutant(plan=changed(case.plan, costs=costs))


def sweep_edited(case: Case, rng: Rng) -> Mutant | None:
    """Sideways motion below what it is, or beyond the limit."""
    key, finding = [
        ("tube__lateral_sweep_mm", "tube.sweep.stated"),
        ("tube__follow_the_leader_error_mm", "tube.leader.stated"),
    ][int(rng.integers(2))]
    true = case.limit(finding) or 0.0
    if key == "tube__lateral_sweep_mm" and rng.integers(2):
        value = case.plan.system.tubes.max_lateral_sweep_mm + far(rng, 1e-3, 5.0)
    elif true < 0.05:
        return None
    else:
        value = float(rng.uniform(0.0, true - 0.03))
    return Mutant(plan=changed(case.plan, **{key: value}))


MUTATIONS: tuple[Mutation, ...] = (
    margins_edited,
    device_edited,
    scope_diameter_edited,
    device_too_weak,
    required_edited,
    identity_edited,
    target_moved,
    clearance_overstated,
    clearance_understated,
    costs_edited,
    sweep_edited,
)

"""First part of the check: is the plan intact, and does it belong to this patient and this device."""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from anatomy.base.errors import LungaccessError
from anatomy.base.settings import to_mapping
from anatomy.base.typed import Float
from anatomy.lobes import FISSURES_UNKNOWN
from lungaccess.judging.checking.findings import Findings
from lungaccess.plans.file import SCHEMA
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System, preset_named, system_fingerprint

if TYPE_CHECKING:
    from anatomy.lung import Lung

STRUCTURES = {"airway", "vessel", "outside", "fissure"}
"""The structures from which a plan may state clearances."""
MAX_NUMBER = 1e5
MAX_TOTAL_MM = 2000.0
MAX_CURVATURE_PER_MM = 1.0
MAX_STATES, MAX_ANGLE_RAD = 10_000, 100.0
"""No plan goes beyond these: they keep the check short on an absurd one."""


def check_record(
    plan: Plan, lung: "Lung", found: Findings, system: System | None, target_lps: Float | None
) -> bool:
    """Record all that needs no geometry; return whether geometry can be looked at."""
    bad = [name for name, size in _sizes(plan, "plan") if not math.isfinite(size)]
    if not found.true("record.finite", not bad, ", ".join(bad)):
        return False
    found.true("record.schema", plan.schema == SCHEMA, plan.schema)
    found.true("record.version", bool(plan.software_version.strip()), plan.software_version)
    try:
        # Reading compares the digest of what was read with that of what was written.
        Plan.from_json(plan.to_json())
        found.true("record.round_trip", True, "the plan as text is the same plan")
    except LungaccessError as error:
        found.true("record.round_trip", False, str(error))
    found.true("patient.name", plan.patient_name == lung.name, f"{plan.patient_name} against {lung.name}")
    found.true("patient.key", plan.lung_key == lung.key, f"{plan.lung_key} against {lung.key}")
    found.true("patient.sources", dict(plan.sources) == dict(lung.sources), "hashes of the image files")
    found.true("patient.breath_hold", plan.breath_hold == lung.breath_hold, str(plan.breath_hold))
    _check_system(plan, found, system)
    _check_required(plan, found)
    _check_fissures(plan, lung, found)
    if target_lps is not None:
        found.agrees("target.given", plan.target_lps, target_lps, 1e-6, "mm")
    return _check_lengths(plan, found)


def _check_fissures(plan: Plan, lung: "Lung", found: Findings) -> None:
    """The plan treats fissures as mask and system say; without a mask it states no distance from them."""
    allowed, known = plan.system.fissures_allowed, lung.has_fissures
    stated = any("fissure" in distances for distances in plan.clearance_mm.values())
    right = plan.fissures_are_obstacles == (known and not allowed) and (known or not stated)
    if right and not known and not allowed:
        found.unchecked("patient.fissures", FISSURES_UNKNOWN)
        return
    detail = f"obstacles: {plan.fissures_are_obstacles}; mask: {known}; system allows: {allowed}"
    found.true("patient.fissures", right, f"{detail}; distance stated: {stated}")


def _sizes(value: object, where: str) -> Iterator[tuple[str, float]]:
    """Yield the name and size of every number (or the largest of an array) in a record."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _sizes(inner, f"{where}.{key}")
    elif isinstance(value, tuple | list):
        for n, inner in enumerate(value):
            yield from _sizes(inner, f"{where}[{n}]")
    elif dataclasses.is_dataclass(value):
        for item in dataclasses.fields(value):
            yield from _sizes(getattr(value, item.name), f"{where}.{item.name}")
    elif isinstance(value, np.ndarray):
        yield where, float(np.abs(value).max(initial=0.0))
    elif isinstance(value, float | int | np.generic):
        yield where, abs(float(value))


def _check_system(plan: Plan, found: Findings, system: System | None) -> None:
    found.true(
        "system.fingerprint", plan.system_fingerprint == system_fingerprint(plan.system), plan.system.name
    )
    preset = preset_named(plan.system.name)
    if preset is not None:
        found.true("system.preset", plan.system == preset, "settings of the preset of that name")
    elif system is None:
        found.unchecked(
            "system.given", "devices and margins are those that the plan states: name yours to compare"
        )
    if plan.system.margins.total_mm == 0.0:
        found.unchecked(
            "system.margins", "all margins are 0: the plan keeps clear of the masks, not of what they miss"
        )
    if system is not None:
        same = to_mapping(plan.system) == to_mapping(system)
        found.true("system.given", same, "settings of the system that was asked for")


def _check_required(plan: Plan, found: Findings) -> None:
    wanted = wanted_clearance_mm(plan.system)
    names = {name for stage in plan.clearance_mm.values() for name in stage}
    known = set(plan.clearance_mm) == _in_tissue(plan.system) and names <= STRUCTURES
    found.true("clearance.names", known, ", ".join(sorted(names)))
    stated = plan.required_clearance_mm
    if found.true("clearance.required.names", set(stated) == set(wanted), ", ".join(stated)):
        for name, value in wanted.items():
            # Stated and recomputed sums of radii and margins agree up to rounding.
            found.agrees(f"clearance.required.{name}", stated[name], value, 1e-9, "mm")


def wanted_clearance_mm(system: System) -> dict[str, float]:
    """Return radius and margins of each device in tissue, by its name in a plan."""
    tubes, margin = system.tubes, system.margins
    extra = margin.segmentation_margin_mm + margin.registration_margin_mm
    wanted = {
        "outer_tube": 0.5 * tubes.outermost.outer_diameter_mm + extra,
        **{f"{name}_tube": 0.5 * tube.outer_diameter_mm + extra for name, tube in tubes.named},
    }
    if system.needle is not None:
        wanted["needle"] = 0.5 * system.needle.diameter_mm + extra
    return wanted


def _in_tissue(system: System) -> set[str]:
    """Return the names of the devices that leave the airway."""
    return {"tube"} if system.needle is None else {"tube", "needle"}


def _check_lengths(plan: Plan, found: Findings) -> bool:
    """Tell whether every length is positive and of a size that can be re-integrated."""
    tube, arcs = plan.tube, () if plan.needle is None else plan.needle.arcs
    planned, owned = plan.needle is not None, plan.system.needle is not None
    usable = found.true(
        "needle.present", planned == owned, f"the plan has one: {planned}; the system has one: {owned}"
    )
    if owned:
        usable &= found.true("needle.arcs", len(arcs) > 0, f"{len(arcs)} arcs")
    lengths = [tube.inner_insertion_mm, *(arc.length_mm for arc in arcs)]
    usable &= min(lengths) > 0.0 and sum(lengths) <= MAX_TOTAL_MM
    usable &= 0.0 <= tube.outer_insertion_mm <= tube.inner_insertion_mm
    if plan.system.tubes.middle is not None:
        usable &= tube.outer_insertion_mm <= tube.middle_insertion_mm <= tube.inner_insertion_mm
    bent = np.abs(tube.shape.arcs[:, 2]).max(initial=0.0)
    usable &= len(tube.shape.arcs) > 0 and float(bent) <= MAX_CURVATURE_PER_MM
    usable &= bool((tube.shape.arcs[:, 0] >= 0.0).all()) and tube.shape.arcs[:, 0].sum() <= MAX_TOTAL_MM
    states = plan.scope.states
    usable &= 0 < len(states) <= MAX_STATES and float(np.abs(states[:, 1:]).max()) <= MAX_ANGLE_RAD
    usable &= float(np.abs(states[:, 0]).max()) <= MAX_TOTAL_MM
    usable &= float(np.abs([arc.curvature_per_mm for arc in arcs]).max(initial=0.0)) <= MAX_CURVATURE_PER_MM
    geometry = (plan.scope, plan.tube, plan.needle, plan.exemption, plan.target_lps)
    usable &= all(size <= MAX_NUMBER for part in geometry for _, size in _sizes(part, ""))
    return found.true("record.lengths", usable, "lengths positive, in order and not absurd")

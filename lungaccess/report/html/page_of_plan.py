"""The page of a plan: it plays in the anatomy, with slices, charts, limits, risk and provenance."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from anatomy.errors import SettingsError
from anatomy.records import frozen_record
from anatomy.words import plural
from lungaccess.appraisal import DRAWS, SEED, Appraiser
from lungaccess.report.html import tables, words
from lungaccess.report.html.deployment import device_points, packed_plan
from lungaccess.report.html.document import TARGET_BUTTON, scene_figure, write_page
from lungaccess.report.html.meshes import start_meshes, structure_meshes
from lungaccess.report.html.volumes import page_image

if TYPE_CHECKING:
    from anatomy.grid import Volume
    from anatomy.lung import Lung
    from lungaccess.appraisal import Appraisal
    from lungaccess.plans.plan import Plan
    from lungaccess.risk import ErrorModel
    from stages.needle import StartRegion

MODULES = ("motion.js", "charts.js", "bronchoscopy.js", "plan.js")
THICKER = "; seen from afar, devices are drawn thicker than they are"


@frozen_record
class PageOptions:
    """What a plan's page shows besides the plan.

    Parameters
    ----------
    alternatives : sequence of Plan
        Other plans of the same lung, shown on demand.
    ct : Volume or None
        CT in HU; the slices show the structures without it.
    ct_name : str
        What the CT is, for people.
    cost_over_time : path or None
        CSV that `lungaccess plan` wrote beside the plan.
    errors : ErrorModel or None
        The errors under which the chance of success is estimated; the default ones if None.
    risk_samples, risk_seed : int
        Draws of that estimate and their seed, see `lungaccess.appraisal.Appraiser`; 0 samples for none.
    instructions : bool
        Whether the steps that bring the scope to its place are listed.
    """

    alternatives: Sequence[Plan] = ()
    ct: Volume | None = None
    ct_name: str = ""
    cost_over_time: Path | None = None
    errors: ErrorModel | None = None
    risk_samples: int = DRAWS
    risk_seed: int = SEED
    instructions: bool = True


def plan_page(
    plan: Plan, lung: Lung, path: str | os.PathLike[str], options: PageOptions | None = None
) -> Path:
    """Write the page of a plan to one HTML file that opens offline.

    The surfaces are smoothed and simplified and only for looking at; every number comes from the plan, the
    check and the exact distances.

    Parameters
    ----------
    lung : Lung
        The patient that the plan was made for.
    path : path of an HTML file in an existing folder

    Raises
    ------
    FileError
        If the file cannot be written.
    PlanFileError
        If the plan was made for another lung.
    AnatomyError
        If the CT does not hold the plan.
    """
    chosen = options or PageOptions()
    plans = (plan, *chosen.alternatives)
    appraiser = Appraiser(lung, chosen.errors, draws=chosen.risk_samples, seed=chosen.risk_seed)
    appraisals = [appraiser.appraise(each, each_kind=each is plan) for each in plans]
    first = appraisals[0]
    region = start_region_of(plan, lung) if first.accepted else None
    parts = {
        "title": words.text(f"Plan for {plan.patient_name}"),
        "headline": words.headline(first.headline),
        "limits": tables.limits_section(first),
        "summary": _summary(plan),
        "scene": scene_figure(more_views=TARGET_BUTTON, more_notes=THICKER),
        "image_source": words.text(image_source(lung, chosen.ct_name if chosen.ct is not None else "")),
        "plans": tables.plans_section(plans, appraisals),
        "key_numbers": tables.key_section(plan, lung),
        "findings": tables.check_section(first.check),
        "instructions": tables.instructions_section(plan, lung)
        if chosen.instructions
        else "<p>Left out.</p>",
        "risk": tables.risk_section(first.risk, "" if region is None else region.words),
        "provenance": tables.provenance_section(plan, lung),
    }
    return write_page(path, "plan.html", MODULES, page_data(plans, appraisals, lung, chosen, region), parts)


def start_region_of(plan: Plan, lung: Lung) -> StartRegion | None:
    """Return the safe start region of a plan; None where the plan has no needle or the region is refused."""
    from lungaccess.risk import safe_start_region

    try:
        return safe_start_region(plan, lung)
    except SettingsError:
        return None


def page_data(
    plans: Sequence[Plan],
    appraisals: Sequence[Appraisal],
    lung: Lung,
    options: PageOptions,
    region: StartRegion | None = None,
) -> dict[str, Any]:
    """Return what the scripts of the page draw, as plain JSON values."""
    near = np.concatenate([device_points(each) for each in plans])
    return {
        "page": "plan",
        "patient": lung.name,
        "structures": structure_meshes(lung) + ([] if region is None else start_meshes(region)),
        "plans": [
            {**packed_plan(each, lung, tables.plan_name(n)), **appraisal.to_mapping()}
            for n, (each, appraisal) in enumerate(zip(plans, appraisals, strict=True))
        ],
        **page_image(lung, near, options.ct),
        "cost_over_time": cost_history(options.cost_over_time),
    }


def image_source(lung: Lung, ct_name: str) -> str:
    """Say what the slices show."""
    if ct_name:
        return f"CT: {ct_name}"
    return f"No CT was given: the slices show the structures of the masks of {lung.name}"


def cost_history(path: Path | None) -> list[list[float]]:
    """Return seconds and best cost from a CSV of `lungaccess plan`; empty if there is none."""
    if path is None or not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [[float(row["elapsed_s"]), float(row["best_cost"])] for row in rows if row.get("best_cost")]


def _summary(plan: Plan) -> str:
    x, y, z = (float(c) for c in plan.target_lps)
    needle = plan.needle
    of_needle = "no needle: the tip of the tubes is at the target"
    if needle is not None:
        of_needle = f"needle {needle.length_mm:.1f} mm in {plural(len(needle.arcs), 'arc')}"
    facts = (
        f"{plan.system.name}; scope to generation {plan.scope.generation}, "
        f"{plan.scope.length_from_carina_mm:.0f} mm beyond the carina; {plan.insertions}; "
        f"{of_needle}; target at LPS "
        f"{x:.1f}, {y:.1f}, {z:.1f} mm"
    )
    # Why this system, if it was chosen among several: the last sentence of its choice.
    return words.text(". ".join((facts, *plan.system_choice[-1:])))

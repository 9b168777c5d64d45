"""The page of a plan: it plays in the anatomy, with slices, charts, limits, risk and provenance."""

from __future__ import annotations

import csv
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.words import plural
from lungaccess.judging.appraisal import Appraiser
from lungaccess.planning import with_front
from lungaccess.planning.procedure import load_procedure, procedure_names
from lungaccess.plans.chance import Chance
from lungaccess.showing.report.html import breathing, phase, tables, words
from lungaccess.showing.report.html.deployment import device_points, packed_plan
from lungaccess.showing.report.html.document import TARGET_BUTTON, scene_figure, slice_controls, write_page
from lungaccess.showing.report.html.glance import glance_section
from lungaccess.showing.report.html.meshes import start_meshes, structure_meshes
from lungaccess.showing.report.html.risk import risk_section
from lungaccess.showing.report.html.trade_off import CAPTION, trade_off_svg
from lungaccess.showing.report.html.volumes import image_words, page_image
from lungaccess.uncertainty.risk import error_preset_names, load_errors

if TYPE_CHECKING:
    from anatomy.grid import Volume
    from anatomy.lung import Lung
    from lungaccess.judging.appraisal import Appraisal
    from lungaccess.planning.procedure import Procedure
    from lungaccess.plans.plan import Plan
    from lungaccess.uncertainty.risk import ErrorModel
    from stages.needle import StartRegion

MODULES = (
    "motion.js", "charts.js", "bronchoscopy.js", "tip_section.js", "breath.js", "player.js", "device_page.js",
    "plan.js",
)  # fmt: skip
NO_REGION = "No safe start region"
THICKER = "; seen from afar, devices are drawn thicker than they are"
FOLLOW = '<label><input type="checkbox" id="follow" checked> follow the foremost tip</label>'
"""Of the slices: whether they go with the devices, or with the cross."""


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
    errors, procedure, risk_samples, risk_seed
        Of the estimate of success, see `lungaccess.judging.appraisal.Appraiser`: 0 samples for none.  If all
        are None, a plan that states its chance shows that, and its alternatives are estimated as it was.
    instructions : bool
        Whether the steps that bring the scope to its place are listed.
    """

    alternatives: Sequence[Plan] = ()
    ct: Volume | None = None
    ct_name: str = ""
    cost_over_time: Path | None = None
    errors: ErrorModel | None = None
    procedure: Procedure | None = None
    risk_samples: int | None = None
    risk_seed: int | None = None
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
    appraisals = _appraised(plans, lung, chosen)
    first = appraisals[0]
    region = start_region_of(plan, lung) if first.accepted else "Not computed for a refused plan"
    drawn, told = (None, region) if isinstance(region, str) else (region, region.words)
    window = breathing.shown_window(plan, lung)
    data = page_data(plans, appraisals, lung, chosen, drawn)
    parts = {
        "title": words.text(f"Plan for {plan.patient_name}"),
        "glance": glance_section(first),
        "headline": words.headline(first.headline),
        "breathing": phase.window_headline(plan, lung, first.accepted),
        "phase_player": phase.player(window, first.accepted),
        "phase_chart": phase.chart(window),
        "phase_slices": phase.slices_note(window),
        "limits": tables.limits_section(first),
        "summary": summary(plan),
        "scene": scene_figure(more_views=TARGET_BUTTON, more_notes=THICKER),
        "image_source": words.text(
            f"{image_source(lung, chosen.ct_name if chosen.ct is not None else '')}. "
            f"The page holds {image_words(data)}"
        ),
        "slice_controls": slice_controls(more=FOLLOW),
        "made_small": words.text(made_small(plan).capitalize()),
        "plans": _plans_section(plans, appraisals),
        "key_numbers": tables.key_section(plan, lung),
        "findings": tables.check_section(first.check),
        "instructions": tables.instructions_section(plan, lung)
        if chosen.instructions
        else "<p>Left out.</p>",
        "risk": risk_section(first.risk, told),
        "provenance": tables.provenance_section(plan, lung),
    }
    return write_page(path, "plan.html", MODULES, data, parts)


def _plans_section(plans: Sequence[Plan], appraisals: Sequence[Appraisal]) -> str:
    """Return a table that compares plans, and for several of them a drawing of what they trade."""
    rated = with_front(plans, [each.headline.chance for each in appraisals])
    if len(plans) == 1:
        return tables.plans_section(rated, appraisals)
    drawing = trade_off_svg(rated, first=0)
    figure = f"<figure>{drawing}<figcaption>{CAPTION} 0 is the plan.</figcaption></figure>" if drawing else ""
    return tables.plans_section(rated, appraisals) + figure


def _appraised(plans: Sequence[Plan], lung: Lung, options: PageOptions) -> list[Appraisal]:
    """Return the appraisals of a plan and its alternatives, whose chances are all of the same luck."""
    given = (options.errors, options.procedure, options.risk_samples, options.risk_seed)
    appraiser = Appraiser(lung, given[0], procedure=given[1], draws=given[2], seed=given[3])
    first = appraiser.appraise(plans[0], each_kind=True)
    if isinstance(first.risk, Chance) and len(plans) > 1:
        appraiser = _appraiser_like(first.risk, lung)
    return [first, *(appraiser.appraise(each) for each in plans[1:])]


def _appraiser_like(chance: Chance, lung: Lung) -> Appraiser:
    """Return what estimates other plans as a stated chance was; no estimate where that was by a file."""
    known = chance.errors in error_preset_names() and chance.procedure in procedure_names()
    if not known:
        return Appraiser(lung, draws=0)
    return Appraiser(
        lung, load_errors(chance.errors), procedure=load_procedure(chance.procedure), draws=chance.samples,
        seed=chance.seed,
    )  # fmt: skip


def start_region_of(plan: Plan, lung: Lung) -> StartRegion | str:
    """Return the safe start region of a plan, or in words why there is none."""
    from lungaccess.uncertainty.risk import safe_start_region

    try:
        return safe_start_region(plan, lung)
    except SettingsError as reason:
        return f"{NO_REGION}: {reason.found}"


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
        "made_small": made_small(plans[0]),
        **breathing.packed_breath(plans, lung),
    }


def made_small(plan: Plan) -> str:
    """Say what a search made small over its time."""
    return "best cost" if plan.chance is None else "chance of failure"


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


def summary(plan: Plan) -> str:
    """Return system, scope, tubes, needle and target of a plan in words."""
    x, y, z = (float(c) for c in plan.target_lps)
    needle = plan.needle
    of_needle = "no needle: the tip of the tubes is at the target"
    if needle is not None:
        of_needle = f"needle {needle.length_mm:.1f} mm in {plural(len(needle.arcs), 'arc')}"
    facts = (
        f"{plan.system.name}; scope to generation {plan.scope.generation}, "
        f"{plan.scope.length_from_carina_mm:.0f} mm beyond the carina; {plan.insertions}; "
        f"{of_needle}; target at LPS "
        f"{x:.1f}, {y:.1f}, {z:.1f} mm{_aim_words(plan)}"
    )
    # Why this system, if it was chosen among several: the last sentence of its choice.
    return words.text(". ".join((facts, *plan.system_choice[-1:])))


def _aim_words(plan: Plan) -> str:
    """Say where the devices end that were planned for a window; "" if they end at the target."""
    if plan.aim is None:
        return ""
    x, y, z = (float(c) for c in plan.aim.point_lps)
    beside = float(np.linalg.norm(plan.aim.point_lps - plan.target_lps))
    return (
        f", which moves: in the phase of the masks the devices end {beside:.1f} mm beside it, at their aim, "
        f"LPS {x:.1f}, {y:.1f}, {z:.1f} mm"
    )

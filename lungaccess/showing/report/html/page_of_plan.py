"""The page of a plan: it plays in the anatomy, with slices, charts, limits, risk and provenance."""

import csv
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.words import of_hundred, range_of_hundred
from anatomy.grid import Volume
from anatomy.lung import Lung
from lungaccess.judging.advice import Advice
from lungaccess.judging.appraisal import Appraisal, Appraiser, Headline, Limit
from lungaccess.judging.appraisal.headline import Grade, grade_of_chance
from lungaccess.planning import with_front
from lungaccess.plans.chance import Chance
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import error_preset_names, load_errors
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.goals import SUCCESS
from lungaccess.problem.nodules import target_words
from lungaccess.problem.procedures import Procedure, load_procedure, procedure_names
from lungaccess.showing.report.html import breathing, charts, tables, words
from lungaccess.showing.report.html.deployment import device_points, packed_plan, profile
from lungaccess.showing.report.html.document import scene_figure, slice_controls, write_page
from lungaccess.showing.report.html.meshes import start_meshes, structure_meshes
from lungaccess.showing.report.html.tables import resting_section, risk_section
from lungaccess.showing.report.html.trade_off import CAPTION, trade_off_svg
from lungaccess.showing.report.html.volumes import image_words, page_image
from stages.needle import StartRegion

MODULES = (
    "motion.js", "bronchoscopy.js", "tip_section.js", "breath.js", "player.js", "devices.js",
    "device_page.js", "plan.js",
)  # fmt: skip
FOLLOW = '<label><input type="checkbox" id="follow" checked> follow the foremost tip</label>'
"""The box that tells whether the slices go with the devices, or with the cross."""


@frozen_record
class PageOptions:
    """What a plan's page shows besides the plan.

    Args:
        alternatives: Other plans of the same lung, shown on demand.
        ct: CT in HU; the slices show the structures without it.
        ct_name: What the CT is, for people.
        cost_over_time: CSV that `lungaccess plan` wrote beside the plan.
        errors, procedure, risk_samples, risk_seed: Of the estimate of success, see
            `lungaccess.judging.appraisal.Appraiser`: 0 samples for none.  If all are None, a plan that states
            its chance shows that, and its alternatives are estimated as it was.
        appraisal: Of the plan; made with the former if None.
        instructions: Whether the steps that bring the scope to its place are listed.
        advice: What would lift the chance of success, see `lungaccess.judging.advice.advise`.
    """

    alternatives: Sequence[Plan] = ()
    ct: Volume | None = None
    ct_name: str = ""
    cost_over_time: Path | None = None
    errors: ErrorModel | None = None
    procedure: Procedure | None = None
    risk_samples: int | None = None
    risk_seed: int | None = None
    appraisal: Appraisal | None = None
    instructions: bool = True
    advice: Sequence[Advice] = ()


def plan_page(
    plan: Plan, lung: Lung, path: str | os.PathLike[str], options: PageOptions | None = None
) -> Path:
    """Write the page of a plan to one HTML file that opens offline.

    The surfaces are smoothed and simplified and only for looking at; every number comes from the plan, the
    check and the exact distances.

    Raises:
        FileError: If the file cannot be written.
        PlanFileError: If the plan was made for another lung.
        AnatomyError: If the CT does not hold the plan.
    """
    chosen = options or PageOptions()
    plans = (plan, *plan.passes[1:], *chosen.alternatives)
    appraisals = _appraised(plans, lung, chosen)
    first = appraisals[0]
    region = start_region_of(plan, lung) if first.accepted else "Not computed for a refused plan"
    drawn, told = (None, region) if isinstance(region, str) else (region, region.words)
    window = breathing.shown_window(plan, lung)
    moved: list[dict[str, Any]] = [{} if window is None else breathing.samples(each, lung) for each in plans]
    data = _page_data(plans, appraisals, lung, chosen, drawn, moved)
    parts = {
        "title": words.text(f"Plan for {plan.patient_name}"),
        "glance": glance_section(plan, first),
        "headline": words.headline(first.headline),
        "advice": words.advice(chosen.advice),
        "details": words.estimate_details(first.headline),
        "breathing": breathing.window_headline(plan, lung, first.accepted),
        "phase_player": breathing.player(window, first.accepted),
        "charts": _charts(plans, lung, moved)
        + charts.history_figure(
            cost_history(chosen.cost_over_time), "best cost" if plan.chance is None else SUCCESS.words
        ),
        "phase_slices": breathing.slices_note(window),
        "limits": tables.limits_section(first),
        "summary": summary(plan, lung),
        "scene": scene_figure(more_notes="; seen from afar, devices are drawn thicker than they are"),
        "image_source": words.text(
            f"{image_source(lung, chosen.ct_name if chosen.ct is not None else '')}. "
            f"The page holds {image_words(data)}"
        ),
        "slice_controls": slice_controls(more=FOLLOW),
        "plans": _plans_section(plans, appraisals),
        "key_numbers": tables.key_section(plan, lung),
        "findings": tables.check_section(first.check),
        "instructions": tables.instructions_section(plan, lung)
        if chosen.instructions
        else "<p>Left out.</p>",
        "risk": risk_section(first.risk, told) + (_resting(plan, lung, chosen) if first.accepted else ""),
        "provenance": tables.provenance_section(plan, lung),
    }
    return write_page(path, "plan.html", MODULES, data, parts)


def _charts(plans: Sequence[Plan], lung: Lung, moved: Sequence[Mapping[str, Any]]) -> str:
    """Return the charts of all plans, hidden but for those of the first."""
    return "".join(
        f'<div data-of-plan="{n}"{" hidden" if n else ""}>'
        f"{charts.plan_figures(each, profile(each, lung), found, lung.cost is not None)}</div>"
        for n, (each, found) in enumerate(zip(plans, moved, strict=True))
    )


def _resting(plan: Plan, lung: Lung, options: PageOptions) -> str:
    """Return what the resting shaft does to a plan, with the wall of the errors or else the usual one."""
    from lungaccess.uncertainty.risk import resting_rows, resting_tip
    from stages.scope import WallContact

    wall = (options.errors.wall if options.errors else None) or WallContact()
    return resting_section(resting_rows(resting_tip(plan, lung, wall), wall))


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
    first = options.appraisal or appraiser.appraise(plans[0], each_kind=True)
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
        return f"No safe start region: {reason.found}"


def _page_data(
    plans: Sequence[Plan],
    appraisals: Sequence[Appraisal],
    lung: Lung,
    options: PageOptions,
    region: StartRegion | None,
    moved: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return what the scripts of the page draw, as plain JSON values."""
    near = np.concatenate([device_points(each) for each in plans])
    passes = len(plans[0].passes)
    names = [tables.shown_name(n, passes) for n in range(len(plans))]
    return {
        "page": "plan",
        "patient": lung.name,
        "structures": structure_meshes(lung) + ([] if region is None else start_meshes(region)),
        "plans": [
            {**packed_plan(each, lung, name), "label": label, **appraisal.to_mapping()}
            for each, (name, label), appraisal in zip(plans, names, appraisals, strict=True)
        ],
        "passes": passes,
        **page_image(lung, near, options.ct),
        **breathing.packed_breath(plans, lung, moved),
    }


def image_source(lung: Lung, ct_name: str) -> str:
    """Say what the slices show."""
    if ct_name:
        return f"CT: {ct_name}"
    return f"No CT was given: the slices show the structures of the masks of {lung.name}"


def cost_history(path: Path | None) -> list[list[float]]:
    """Return seconds and the best value of the goal from a CSV of `lungaccess plan`; empty without one."""
    if path is None or not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [[float(row["elapsed_s"]), float(row["best"])] for row in rows if row.get("best")]


def summary(plan: Plan, lung: Lung) -> str:
    """Return system, scope, tubes and target of a plan in words; its lengths are among the numbers."""
    x, y, z = (float(c) for c in plan.target_lps)
    place = target_words(lung, plan.target_lps)
    passes = f"{len(plan.passes)} passes, of which the first is told; " if plan.further else ""
    facts = (
        f"{plan.system.name}; {passes}scope to generation {plan.scope.generation}; {plan.insertions}; target"
        f"{f': {place},' if place else ''} at LPS {x:.1f}, {y:.1f}, {z:.1f} mm{_aim_words(plan)}"
    )
    # Why this system, if it was chosen among several: the last sentence of its choice.
    return words.text(". ".join((facts, *plan.system_choice[-1:])))


def _aim_words(plan: Plan) -> str:
    """Say where the devices end that were planned for a window or a tool; "" if they end at the target."""
    if plan.aim is None:
        return ""
    x, y, z = (float(c) for c in plan.aim.point_lps)
    beside = float(np.linalg.norm(plan.aim.point_lps - plan.target_lps))
    if plan.system.tool is not None:
        return f"; the tip ends {beside:.1f} mm beyond it, so that the {plan.system.tool.name} lies there"
    return (
        f", which moves: in the phase of the masks the devices end {beside:.1f} mm beside it, at their aim, "
        f"LPS {x:.1f}, {y:.1f}, {z:.1f} mm"
    )


def glance_section(plan: Plan, appraisal: Appraisal) -> str:
    """Return the numbers that decide about a plan: chance, length of the way, time, and the nearest limit."""
    others = {name.removesuffix("_s"): seconds for name, seconds in plan.timing.items()}
    planning = others.pop("planning", None)
    value = "not stated" if planning is None else f"{planning:.1f} s"
    time = _tile("Planning time", None, value, ", ".join(f"{name} {s:.1f} s" for name, s in others.items()))
    tiles = [_chance(appraisal.headline), _way(plan), time, *map(_limit, appraisal.limits[:1])]
    return f'<ul class="glance" aria-label="At a glance">{"".join(tiles)}</ul>'


def _tile(what: str, grade: Grade | None, value: str, note: str, bar: str = "") -> str:
    """Return one of the things: its name, its value with the mark of a grade, and what belongs to it."""
    coloured = "" if grade is None else f' class="grade-{grade.key}"'
    mark = "" if grade is None else f'<span class="mark">{grade.mark}</span> '
    return (
        f"<li{coloured}><span class='what'>{words.text(what)}</span>"
        f"<strong>{mark}{words.text(value)}</strong>{bar}<span class='note'>{words.text(note)}</span></li>"
    )


def _chance(said: Headline) -> str:
    success = said.success
    if success is None:
        return _tile("Chance of success", Grade.UNKNOWN, "not computed", "")
    low, high = success.interval
    width = max(100.0 * (high - low), 1.0)
    bar = (
        '<span class="bar" aria-hidden="true">'
        f'<span style="margin-left:{min(100.0 * low, 99.0):.1f}%;width:{width:.1f}%"></span></span>'
    )
    note = f"95 % interval {range_of_hundred(success.interval)}"
    value = f"{of_hundred(success.value)} of 100"
    return _tile("Chance of success", grade_of_chance(success), value, note, bar)


def _way(plan: Plan) -> str:
    scope, tubes = plan.scope.length_from_carina_mm, plan.tube.inner_insertion_mm
    needle = 0.0 if plan.needle is None else plan.needle.length_mm
    last = f"needle {needle:.0f}" if needle else "no needle: the tubes end at the target"
    note = f"from the carina: scope {scope:.0f}, tubes {tubes:.0f}, {last}"
    return _tile("Length of the way", None, f"{scope + tubes + needle:.0f} mm", note)


def _limit(limit: Limit) -> str:
    note = f"{limit.what}: {limit.found_words}, needs {limit.bound_words}"
    if limit.ok:
        return _tile("Nearest limit", None, f"{limit.used_words} used", note)
    return _tile("Broken limit", Grade.POOR, "BROKEN", note)

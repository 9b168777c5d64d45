"""A plan in the breath, for its page: the displacement of the lung, and clearances at phases."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from anatomy.base.typed import Bool, Float
from anatomy.grid import Grid
from anatomy.lung import Lung
from anatomy.meshes import point_distances_mm
from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL
from lungaccess.judging.appraisal.headline import Grade
from lungaccess.judging.checking.boxes import Environment, Select, airway_except, has, labels_at
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingWindow
from lungaccess.showing.report.clock import PROVED, limit_names, on_rim, sectors
from lungaccess.showing.report.html import words
from lungaccess.showing.report.html.deployment import CAP_MM, NOT_MEASURED, profile_points, required_mm
from lungaccess.showing.report.html.volumes import packed_volume
from lungaccess.showing.report.pack import Packed, pack
from lungaccess.uncertainty.breathing.moving import Moving
from lungaccess.uncertainty.breathing.window import TOLERANCE_MM, miss_allowed

NO_WINDOW = (
    "The patient breathes, but the plan has no window: in which phases it is clear was not computed. "
    "lungaccess window computes it."
)

FIELD_STEP_MM = 0.02
"""Displacements are stored in such steps: finer than anything that is seen or measured."""
SAMPLES = 21
"""Phases at which clearances are computed: every 5 % of the breath, as often as the check looks."""
REACH_MM = 1.4 * CAP_MM
"""Tissue of the masks is looked at this near to the devices: enough for `CAP_MM` where it shrinks by 0.7."""


def shown_window(plan: Plan, lung: Lung) -> BreathingWindow | None:
    """Return the window that the page shows in motion; None where plan or patient have none."""
    return None if lung.motion is None else plan.window


def _field_data(plan: Plan, lung: Lung) -> Packed:
    """Return the displacement that moves the anatomy of a page: a volume in `FIELD_STEP_MM` for each axis."""
    moving = Moving.of(plan, lung)
    motion = moving.tissue
    counts = np.rint(np.moveaxis(moving.field, -1, 0) / FIELD_STEP_MM).astype(np.int32)
    grid = Grid.from_spacing(counts.shape[1:], 3 * [float(motion.frame[3])], motion.frame[:3])
    return {
        "step_mm": FIELD_STEP_MM,
        "fields": [packed_volume(grid, each, "i4", differences=True) for each in counts],
        "amplitude": motion.amplitude,
        "masks_phase": motion.masks_phase,
    }


def _breath_data(plan: Plan, lung: Lung, found: Mapping[str, Any]) -> Packed:
    """Return what carries tubes and needle of a plan, its window, and what of `samples` is in no chart."""
    moving, window = Moving.of(plan, lung), plan.window
    return {
        "centre_lps": moving.rigid.centre.tolist(),
        "displacement_mm": moving.rigid.displacement.tolist(),
        "gradient": moving.rigid.gradient.tolist(),
        "window": None if window is None else window.phases.tolist(),
        "warning_only": window is not None and window.warning_only,
        "samples": {
            "phases": found["phases"],
            "target_mm": found["target_mm"],
            "margins_mm": [pack(each, "f4") for each in found["margin_mm"]],
        },
    }


def samples(plan: Plan, lung: Lung) -> dict[str, Any]:
    """Return distances at `SAMPLES` phases: of the axes to each structure, and of their end to the target.

    The exact surfaces of the voxels are deformed, and distances measured to them.  "margin_mm" is what the
    needle has to spare; "spare_mm" the least beyond what is required, on tubes beyond their exit and needle,
    wherever tissue strays by the window's hysteresis; "allowed_mm" is how far from the target they may end.
    """
    moving, phases = Moving.of(plan, lung), np.linspace(0.0, 1.0, SAMPLES)
    points, along, start = profile_points(plan)
    share = 0.0 if plan.window is None else plan.window.hysteresis
    lever = np.linalg.norm(points - plan.scope.lps_from_scope_tip[:3, 3], axis=1)
    required = required_mm(plan, along, start)
    kept = (required + share * lever) / (1.0 - share)
    clearance = _clearances_at(plan, lung, moving, phases)
    clearance["airway"][:, along < plan.tube.exit.arc_length_mm] = NOT_MEASURED
    limited = {k: v for k, v in clearance.items() if k != "fissure" or plan.fissures_are_obstacles}
    margin = np.min(list(limited.values()), axis=0) - required
    free = along >= plan.tube.exit.arc_length_mm
    of_needle = len(plan.curves().needle.arc_length_mm)
    target = np.asarray(plan.target_lps)[None]
    ends = [moving.carried(points[-1:], phase) - moving.moved(target, phase) for phase in phases]
    return {
        "phases": phases.tolist(),
        "clearance_mm": clearance,
        "margin_mm": margin[:, -of_needle:],
        "spare_mm": {
            name: np.round((v - kept)[:, free].min(axis=1), 3).tolist() for name, v in limited.items()
        },
        "target_mm": np.round(np.linalg.norm(np.concatenate(ends), axis=1), 3).tolist(),
        "allowed_mm": miss_allowed(
            moving.tissue, TOLERANCE_MM if plan.window is None else plan.window.tolerance_mm, float(lever[-1])
        ),
    }


def _clearances_at(plan: Plan, lung: Lung, moving: Moving, phases: Float) -> dict[str, Float]:
    """Return exact distances `(K, N)` of tubes and needle to each structure, deformed, at phases `(K,)`.

    The rules are those of `deployment.profile`: up to `CAP_MM`, or less where tissue shrinks by more than
    `REACH_MM` allows for, and the pierced branch is passed over as long as it is exempt.
    """
    points, along, start = profile_points(plan)
    exempt = along <= start + plan.exemption.needle_length_mm
    structures = {"airway": has(AIRWAY), "vessel": has(VESSEL), "pleura": has(OUTSIDE)}
    if lung.has_fissures:
        structures["fissure"] = has(FISSURE)
    environment = Environment(lung)
    found = {
        name: _distances(points, select, lung, environment, moving, phases)
        for name, select in structures.items()
    }
    others = airway_except(plan.exemption.branch)
    found["airway"][:, exempt] = _distances(points[exempt], others, lung, environment, moving, phases)
    return found


def _distances(
    points: Float, select: Select, lung: Lung, environment: Environment, moving: Moving, phases: Float
) -> Float:
    """Return the distances `(K, N)` of carried points from a structure, 0 inside, at most `CAP_MM`."""
    carried = [moving.carried(points, phase) for phase in phases]
    places = [moving.pulled_back(each, phase) for each, phase in zip(carried, phases, strict=True)]
    mesh = environment.boxes(select, REACH_MM).surface_near(np.concatenate(places[::5]), REACH_MM)
    cap_mm = min(CAP_MM, REACH_MM * _least_stretch(moving, np.concatenate(places)))
    rows = []
    for at, place, phase in zip(carried, places, phases, strict=True):
        deformed = replace(mesh, vertices_lps=moving.moved(mesh.vertices_lps, phase))
        away = point_distances_mm(deformed, at, cap_mm)
        inside: Bool = select(labels_at(lung, place))
        rows.append(np.where(inside, 0.0, away))
    return np.array(rows)


def _least_stretch(moving: Moving, places: Float) -> float:
    """Return by what factor tissue within `REACH_MM` of places of the masks shortens lengths at most."""
    bounds, frame = moving.tissue.least_stretch(0), moving.tissue.frame
    low, high = places.min(axis=0) - REACH_MM, places.max(axis=0) + REACH_MM
    most = np.array(bounds.shape) - 1
    first, last = (
        np.clip(np.floor((end - frame[:3]) / frame[3]).astype(int), 0, most) for end in (low, high)
    )
    near = tuple(slice(a, b + 1) for a, b in zip(first, last, strict=True))
    return float(np.clip(bounds[near].min(), 0.0, 1.0))


def packed_breath(plans: Sequence[Plan], lung: Lung, found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the data of the page for all plans with their `samples`; empty where the first has none."""
    if not found[0]:
        return {}
    data = [_breath_data(each, lung, sampled) for each, sampled in zip(plans, found, strict=True)]
    return {"breath": {**_field_data(plans[0], lung), "plans": data}}


def window_headline(plan: Plan, lung: Lung, accepted: bool) -> str:
    """Return the sentence of the window with its clock for the top of the page; "" without a motion."""
    if lung.motion is None:
        return ""
    window = plan.window
    if window is None:
        grade, said, clock = Grade.UNKNOWN, NO_WINDOW, ""
    else:
        grade, said, clock = _grade_of_window(window, accepted), window.words, clock_svg(window, accepted)
        if not accepted:
            said = f"The check refuses this plan; its window is not confirmed. {said}"
    source = "" if window is None else f"<p class='note'>Motion: {words.text(window.motion_source)}.</p>"
    return (
        f'<div class="headline breath grade-{grade.key}">{clock}<div><p>'
        f'<span class="mark">{grade.mark}</span> <strong>Breathing.</strong> {words.text(said)}</p>'
        f"{source}</div></div>"
    )


def _grade_of_window(window: BreathingWindow, accepted: bool) -> Grade:
    """Return how good the news of a window is: a model of other people's lungs promises nothing."""
    if not accepted or not len(window.phases):
        return Grade.POOR
    return Grade.UNKNOWN if window.warning_only else Grade.GOOD


def clock_svg(window: BreathingWindow, accepted: bool) -> str:
    """Return the window on the clock of a breath; the page turns the hand "clock-hand"."""
    middle, radius = (100.0, 92.0), 62.0

    def at(phase: float, exhaling: bool = False, share: float = 1.0) -> str:
        x, y = on_rim(phase, exhaling=exhaling, radius=share * radius)
        return f"{middle[0] + x:.1f} {middle[1] - y:.1f}"

    parts = []
    for each in sectors(window):
        colour = _colour(window, accepted, each.proved)
        for exhaling in (False, True):
            arc = f"A{radius:.0f} {radius:.0f} 0 0 {0 if exhaling else 1} {at(each.end, exhaling)}"
            look = f'fill="none" stroke="{colour}" stroke-width="15"'
            parts.append(f'<path d="M{at(each.begin, exhaling)}{arc}" {look}/>')
    for phase, name in limit_names(window):
        x, y = at(phase, share=1.24).split()
        parts.append(f'<path d="M{at(phase, share=0.84)}L{at(phase, share=1.16)}" class="axis"/>')
        parts.append(f'<text x="{x}" y="{float(y) + 4:.1f}">{words.text(name)}</text>')
    for height, said in ((14, "end-exhale, 0 %"), (182, "end-inhale, 100 %")):
        parts.append(f'<text x="100" y="{height}" text-anchor="middle">{said}</text>')
    for aside, said in ((114, "in"), (84, "out")):
        parts.append(f'<text x="{aside}" y="96" text-anchor="middle" class="faint">{said}</text>')
    hand = f"M{at(window.masks_phase, share=0.45)}L{at(window.masks_phase, share=0.85)}"
    parts.append(f'<path id="clock-hand" d="{hand}" class="cursor"/>')
    return (
        f'<svg class="clock" viewBox="25 0 265 190" role="img" aria-label="{words.text(window.words)}">'
        f"{''.join(parts)}</svg>"
    )


def _colour(window: BreathingWindow, accepted: bool, proved: bool) -> str:
    """Return the colour of a stretch: green only where it is proved for this patient, and accepted."""
    if not proved:
        return "var(--shut)"
    return PROVED if accepted and not window.warning_only else "var(--fair)"


def player(window: BreathingWindow | None, accepted: bool) -> str:
    """Return the controls of the phase, with the window marked on the slider; "" without one."""
    if window is None:
        return ""
    stops = ", ".join(
        f"{_colour(window, accepted, each.proved)} {100 * each.begin:.1f}% {100 * each.end:.1f}%"
        for each in sectors(window)
    )
    return (
        '\n    <div class="breath-row" role="group" aria-label="Breathing">'
        '<button type="button" id="breathe">Breathe</button>'
        f'<span class="track" style="--stretches: linear-gradient(90deg, {stops})">'
        '<input type="range" id="phase" min="0" max="1000" step="1" '
        f'value="{round(1000 * window.masks_phase)}" aria-label="Phase of the breath"></span>'
        '<output id="phase-words" for="phase"></output></div>'
    )


def slices_note(window: BreathingWindow | None) -> str:
    """Return what the slices do with the phase."""
    if window is None:
        return ""
    return (
        " They breathe with the slider of the phase; beyond the pleura the motion is continued, and ribs do "
        "not move so."
    )

"""The text that lies in an exported folder and says what is in it."""

from __future__ import annotations

import textwrap

from lungaccess.judging.checking import CheckReport
from lungaccess.plans.plan import Plan

_MEANING = {
    "scene.mrml": "drag this into 3D Slicer (5.0 or later): it loads everything below it",
    "breathing.mrml": "the same for 3D Slicer (5.0 or later), moving with the breath: see BREATHING",
    "breathing_tissue.seq.mrb": "how the lung is displaced in each phase",
    "breathing_devices.seq.mrb": "how tubes and needle are carried in each phase",
    "scope.mrk.json": "the bronchoscope: curve, pose and radius at every point",
    "tubes.mrk.json": "the tubes beyond the scope: curve, pose and radius at every point",
    "needle.mrk.json": "the needle: curve, pose and radius at every point",
    "points.mrk.json": "scope tip, tube tip, exit through the airway wall, target",
    "aim.mrk.json": "where the devices end in the masks' phase, of a plan for a window of breathing",
    "scope.ply": "the bronchoscope, true to its radius",
    "tubes.ply": "the tubes, true to their radius",
    "needle.ply": "the needle, true to its radius",
    "start_region_proved.ply": "where the needle may start and head to, all of it proved",
    "start_region_tried.ply": "places from which half of the tried directions have a clear path",
    "airway_tree.vtp": "centreline of the airways with Radius, Generation and Branch; hidden at first",
    "anatomy.seg.nrrd": "the masks that were planned on, one label a voxel, with names and terminology",
    "route_custusx.txt": "the route for CustusX and Fraxinus: x y z flag, from target to trachea",
    "plan.json": "the plan itself, for lungaccess",
    "README.txt": "this text",
}


def readme(plan: Plan, report: CheckReport, files: tuple[str, ...], no_region: str = "") -> str:
    """Return what is in the folder, in which frame, and what the check says of the plan.

    `no_region` tells why there is no safe start region, if there is none.
    """
    target = ", ".join(f"{c:.1f}" for c in plan.target_lps)
    ras = ", ".join(f"{c:.1f}" for c in (-plan.target_lps[0], -plan.target_lps[1], plan.target_lps[2]))
    verdict = "ACCEPTS" if report.accepted else "REFUSES"
    width = max(len(name) for name in files)
    lines = [
        f"Plan for {plan.patient_name}, {plan.system.name}, made with lungaccess {plan.software_version}",
        f"Plan {plan.digest[:16]}, anatomy {plan.lung_key[:16]}",
        "",
        f"The independent check {verdict} this plan.",
        *(f"  {finding}" for finding in (*report.refusals, *report.unchecked)),
        "It says nothing of the chance of success, which `lungaccess risk` estimates.",
        *([f"No safe start region: {no_region}."] if no_region else []),
        "",
        "Research software, not a medical device. Not for the treatment of patients.",
        "",
        "FRAME. All files are in LPS millimetres and say so: x grows to the patient's left, y to the back,",
        "z to the head. 3D Slicer shows RAS: x and y change sign on its screen, nothing is mirrored.",
        f"Target in the files (LPS): {target}",
        f"Target on 3D Slicer's screen (RAS): {ras}",
        "",
        "POSES. The orientation of a control point holds a rotation row by row; its columns are the x, y and",
        "z axes of the device, and z points the way it moves.",
        "",
        *_breathing(plan, files),
        "MODELS are for display: those of the anatomy are simplified. Measure on anatomy.seg.nrrd.",
        "",
        *(f"{name.ljust(width)}  {_MEANING.get(name, 'surface of ' + name.split('.')[0])}" for name in files),
        "",
    ]
    return "\n".join(lines)


def _breathing(plan: Plan, files: tuple[str, ...]) -> tuple[str, ...]:
    """Return how to see the breath, and the window of the plan."""
    if "breathing.mrml" not in files:
        return ()
    window = plan.window
    said = "The plan has no window: lungaccess window computes it." if window is None else window.words
    return (
        *textwrap.wrap(f"BREATHING. {said}", 104),
        "Drag breathing.mrml into 3D Slicer instead of scene.mrml. The sequence browser in the toolbar",
        "chooses the phase, or replays the breath. Anatomy, scope and points move with the tissue, tubes and",
        "needle rigidly with the tip of the scope. The start region, of the masks' phase alone, stays.",
        "",
    )

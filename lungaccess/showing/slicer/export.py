"""Write a plan and its patient as a folder for 3D Slicer, and say what is in it."""

import json
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import SettingsError
from anatomy.base.files import require_writable_folder, write_text
from anatomy.base.records import frozen_value
from anatomy.io.centerlines import write_centerlines
from anatomy.lung import Lung
from lungaccess.judging.checking import CheckReport, check
from lungaccess.plans.curves import DeviceCurve, DeviceCurves
from lungaccess.plans.plan import Plan
from lungaccess.showing.slicer import models
from lungaccess.showing.slicer.breathing import write_breathing
from lungaccess.showing.slicer.scene import Item, scene
from lungaccess.uncertainty.risk import proved_body, safe_start_region, tried_body

SCENE_FILE, README_FILE, ROUTE_FILE, PLAN_FILE = "scene.mrml", "README.txt", "route_custusx.txt", "plan.json"
SEGMENTATION_FILE, TREE_FILE, POINTS_FILE = "anatomy.seg.nrrd", "airway_tree.vtp", "points.mrk.json"

STRUCTURES: dict[str, tuple[tuple[float, float, float], float]] = {
    "lung": ((0.77, 0.64, 0.58), 0.12),
    "airway": ((0.62, 0.85, 0.90), 0.35),
    "vessel": ((0.84, 0.15, 0.16), 0.6),
    "fissure": ((0.58, 0.40, 0.74), 0.3),
    "nodule": (models.TARGET_COLOUR, 0.8),
}
"""Models of the anatomy: colour and opacity."""

PROVED_COLOUR, TRIED_COLOUR = (0.0, 0.45, 0.7), (0.94, 0.89, 0.26)
"""The bodies of the safe start region have these colours."""

STEP_MM = 1.0
"""Spacing of the control points of tubes and needle: fine enough to measure, few enough to read."""

Progress = Callable[[str, float], None]


@frozen_value
class Exported:
    """What was written.

    Args:
        report: What the independent check says of the plan; the scene and the README repeat it.
    """

    files: tuple[str, ...]
    report: CheckReport

    def to_mapping(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return {"files": list(self.files), "accepted": self.report.accepted}


def export_slicer(
    plan: Plan, lung: Lung, folder: str | Path, *, progress: Progress | None = None
) -> Exported:
    """Write a plan and its patient into a folder that 3D Slicer opens by its `scene.mrml`.

    If the patient breathes, `breathing.mrml` moves anatomy and devices with the phase.

    Everything is in LPS mm and says so; every file appears complete or not at all.  A plan that the
    independent check refuses is written too, and named so in the scene.

    Args:
        folder: Made if it is missing.
        progress: Told each step and the share that is done.

    Raises:
        PlanFileError: If the plan was made for another patient, or for other masks of this one.
        FileError: If the folder cannot be written.
    """
    plan.require_lung(lung)
    target = require_writable_folder(folder)
    tell = progress or (lambda _step, _share: None)
    tell("checking the plan", 0.0)
    report = check(plan, lung)
    devices = plan.curves(STEP_MM)
    items = _write_devices(plan, target, refused=not report.accepted)
    region, why_none = _write_start_region(plan, lung, target) if report.accepted else ([], "")
    items += region
    items += _write_anatomy(lung, target, tell)
    write_text(target / SCENE_FILE, scene(items))
    write_text(target / ROUTE_FILE, _route_text(plan, devices, lung.tree))
    plan.save(target / PLAN_FILE)
    # The work before it takes this share of the time.
    tell("breathing", 0.9)
    moving = write_breathing(plan, lung, items, target) if lung.motion is not None else ()
    files = (SCENE_FILE, *moving, *(item.file for item in items), ROUTE_FILE, PLAN_FILE, README_FILE)
    write_text(target / README_FILE, readme(plan, report, files, why_none))
    tell("done", 1.0)
    return Exported(files=files, report=report)


def _write_devices(plan: Plan, folder: Path, *, refused: bool) -> list[Item]:
    """Write curves, tubes and points; a refused plan is named so wherever its devices show."""
    prefix = "REFUSED by the check: " if refused else ""
    items = []
    for curve in plan.shown_curves(STEP_MM):
        curve_file, model_file = f"{curve.name}.mrk.json", f"{curve.name}.ply"
        _write_json(folder / curve_file, _named(models.curve_markup(curve), prefix))
        models.write_ply(folder / model_file, models.device_surface(curve))
        name = f"{prefix}{curve.name}"
        items.append(Item(kind="MarkupsCurve", name=name, file=curve_file, colour=curve.colour))
        items.append(Item(kind="Model", name=f"{name} surface", file=model_file, colour=curve.colour))
    fiducials = {"points": (POINTS_FILE, models.points_of_interest(plan))}
    if plan.aim is not None:
        fiducials["aim"] = ("aim.mrk.json", models.aim_point(plan.aim))
    for name, (file, content) in fiducials.items():
        _write_json(folder / file, _named(content, prefix))
        items.append(
            Item(kind="MarkupsFiducial", name=f"{prefix}{name}", file=file, colour=models.TARGET_COLOUR)
        )
    return items


def _write_start_region(plan: Plan, lung: Lung, folder: Path) -> tuple[list[Item], str]:
    """Write the bodies of the safe start region; say why where there is none."""
    try:
        region = safe_start_region(plan, lung)
    except SettingsError as reason:
        return [], reason.found
    items = []
    for name, body, colour in (
        ("start_region_proved", proved_body(region), PROVED_COLOUR),
        ("start_region_tried", tried_body(region), TRIED_COLOUR),
    ):
        if body is not None:
            models.write_ply(folder / f"{name}.ply", body)
            items.append(
                Item(
                    kind="Model", name=name.replace("_", " "), file=f"{name}.ply", colour=colour, opacity=0.4
                )
            )
    return items, "" if items else region.words


def _named(markups: dict[str, Any], prefix: str) -> dict[str, Any]:
    """Put a prefix before the name of every markup."""
    return markups | {"markups": [each | {"name": prefix + each["name"]} for each in markups["markups"]]}


def _write_anatomy(lung: Lung, folder: Path, tell: Progress) -> list[Item]:
    write_centerlines(folder / TREE_FILE, lung.tree)
    items = [Item(kind="Model", name="airway tree", file=TREE_FILE, colour=(0.0, 0.2, 0.6), visible=False)]
    for done, (name, (colour, opacity)) in enumerate(STRUCTURES.items(), start=1):
        tell(f"surface of {name}", done / (len(STRUCTURES) + 2))
        mesh = models.structure_surface(lung, name)
        if mesh is None:
            continue
        models.write_ply(folder / f"{name}.ply", mesh)
        items.append(Item(kind="Model", name=name, file=f"{name}.ply", colour=colour, opacity=opacity))
    tell("segmentation", (len(STRUCTURES) + 1) / (len(STRUCTURES) + 2))
    models.write_segmentation(folder / SEGMENTATION_FILE, lung)
    return [*items, Item(kind="Segmentation", name="anatomy", file=SEGMENTATION_FILE, opacity=0.5)]


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


ROUTE, BRANCHING, BEYOND = 0, 1, 2
_HEADING = (
    "# [xPos yPos zPos BranchingPoint (0=Normal, 1=Branching position, 2=Extended from airway to target)] "
    "Number of positions: {count}"
)


def _route_text(plan: Plan, curves: DeviceCurves, tree: AirwayTree) -> str:
    """Return the route of a plan through an airway tree as text, LPS mm, one point a line.

    Flags are 0 along the airway, 1 where one branch ends and the next begins, 2 for tubes and needle.
    """
    scope, tubes, needle = curves
    inside = _with_flags(scope, plan, tree)
    beyond = [(point, BEYOND) for curve in (tubes, needle) for point in curve.points_lps[1:].tolist()]
    rows = [*inside, *beyond][::-1]
    lines = [_HEADING.format(count=len(rows))]
    lines += [f"{x:.4f} {y:.4f} {z:.4f} {flag}" for (x, y, z), flag in rows]
    return "\n".join([*lines, ""])


def _with_flags(scope: DeviceCurve, plan: Plan, tree: AirwayTree) -> list[tuple[list[float], int]]:
    """Return the points of the scope, flagged where another branch of its way is nearer than before."""
    way = np.flatnonzero(np.isin(tree.branch_of_point, plan.scope.branches))
    away = np.linalg.norm(scope.points_lps[:, None] - tree.points_lps[way], axis=2)
    branch = tree.branch_of_point[way[away.argmin(axis=1)]]
    flags = np.where(np.append(np.diff(branch) != 0, False), BRANCHING, ROUTE)
    return list(zip(scope.points_lps.tolist(), flags.tolist(), strict=True))


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

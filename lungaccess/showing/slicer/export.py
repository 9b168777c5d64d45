"""Write a plan and its patient as a folder for 3D Slicer, and say what is in it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from anatomy.base.errors import SettingsError
from anatomy.base.files import require_writable_folder, write_text
from anatomy.base.records import frozen_value
from anatomy.io.centerlines import write_centerlines
from anatomy.lung import Lung
from lungaccess.judging.checking import CheckReport, check
from lungaccess.plans.curves import DeviceCurves
from lungaccess.plans.plan import Plan
from lungaccess.showing.slicer.breathing import write_breathing
from lungaccess.showing.slicer.custusx import route_text
from lungaccess.showing.slicer.markups import TARGET_COLOUR, aim_point, curve_markup, points_of_interest
from lungaccess.showing.slicer.models import device_surface, structure_surface, write_ply
from lungaccess.showing.slicer.readme import readme
from lungaccess.showing.slicer.scene import Item, scene
from lungaccess.showing.slicer.segments import write_segmentation
from lungaccess.uncertainty.risk import proved_body, safe_start_region, tried_body

SCENE_FILE, README_FILE, ROUTE_FILE, PLAN_FILE = "scene.mrml", "README.txt", "route_custusx.txt", "plan.json"
SEGMENTATION_FILE, TREE_FILE, POINTS_FILE = "anatomy.seg.nrrd", "airway_tree.vtp", "points.mrk.json"
AIM_FILE = "aim.mrk.json"

STRUCTURES: dict[str, tuple[tuple[float, float, float], float]] = {
    "lung": ((0.77, 0.64, 0.58), 0.12),
    "airway": ((0.62, 0.85, 0.90), 0.35),
    "vessel": ((0.84, 0.15, 0.16), 0.6),
    "fissure": ((0.58, 0.40, 0.74), 0.3),
    "nodule": (TARGET_COLOUR, 0.8),
}
"""Models of the anatomy: colour and opacity."""

PROVED_COLOUR, TRIED_COLOUR = (0.0, 0.45, 0.7), (0.94, 0.89, 0.26)
"""Of the bodies of the safe start region."""

STEP_MM = 1.0
"""Spacing of the control points of tubes and needle: fine enough to measure, few enough to read."""

BREATHING_SHARE = 0.9
"""Of the work before it."""

Progress = Callable[[str, float], None]


@frozen_value
class Exported:
    """What was written.

    Parameters
    ----------
    files : tuple of str
        Names in the folder.
    report : CheckReport
        What the independent check says of the plan; the scene and the README repeat it.
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

    Parameters
    ----------
    lung : Lung
        The patient it was made for.
    folder : path
        Made if it is missing.
    progress : callable, optional
        Told each step and the share that is done.

    Raises
    ------
    PlanFileError
        If the plan was made for another patient, or for other masks of this one.
    FileError
        If the folder cannot be written.
    """
    plan.require_lung(lung)
    target = require_writable_folder(folder)
    tell = progress or (lambda _step, _share: None)
    tell("checking the plan", 0.0)
    report = check(plan, lung)
    devices = plan.curves(STEP_MM)
    items = _write_devices(plan, devices, target, refused=not report.accepted)
    region, why_none = _write_start_region(plan, lung, target) if report.accepted else ([], "")
    items += region
    items += _write_anatomy(lung, target, tell)
    write_text(target / SCENE_FILE, scene(items))
    write_text(target / ROUTE_FILE, route_text(plan, devices, lung.tree))
    plan.save(target / PLAN_FILE)
    tell("breathing", BREATHING_SHARE)
    moving = write_breathing(plan, lung, items, target) if lung.motion is not None else ()
    files = (SCENE_FILE, *moving, *(item.file for item in items), ROUTE_FILE, PLAN_FILE, README_FILE)
    write_text(target / README_FILE, readme(plan, report, files, why_none))
    tell("done", 1.0)
    return Exported(files=files, report=report)


def _write_devices(plan: Plan, devices: DeviceCurves, folder: Path, *, refused: bool) -> list[Item]:
    """Write curves, tubes and points; a refused plan is named so wherever its devices show."""
    prefix = "REFUSED by the check: " if refused else ""
    items = []
    for curve in devices.present:
        curve_file, model_file = f"{curve.name}.mrk.json", f"{curve.name}.ply"
        _write_json(folder / curve_file, _named(curve_markup(curve), prefix))
        write_ply(folder / model_file, device_surface(curve))
        name = f"{prefix}{curve.name}"
        items.append(Item(kind="MarkupsCurve", name=name, file=curve_file, colour=curve.colour))
        items.append(Item(kind="Model", name=f"{name} surface", file=model_file, colour=curve.colour))
    fiducials = {"points": (POINTS_FILE, points_of_interest(plan))}
    if plan.aim is not None:
        fiducials["aim"] = (AIM_FILE, aim_point(plan.aim))
    for name, (file, content) in fiducials.items():
        _write_json(folder / file, _named(content, prefix))
        items.append(Item(kind="MarkupsFiducial", name=f"{prefix}{name}", file=file, colour=TARGET_COLOUR))
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
            write_ply(folder / f"{name}.ply", body)
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
        mesh = structure_surface(lung, name)
        if mesh is None:
            continue
        write_ply(folder / f"{name}.ply", mesh)
        items.append(Item(kind="Model", name=name, file=f"{name}.ply", colour=colour, opacity=opacity))
    tell("segmentation", (len(STRUCTURES) + 1) / (len(STRUCTURES) + 2))
    write_segmentation(folder / SEGMENTATION_FILE, lung)
    return [*items, Item(kind="Segmentation", name="anatomy", file=SEGMENTATION_FILE, opacity=0.5)]


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")

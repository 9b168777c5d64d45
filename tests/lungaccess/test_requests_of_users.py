"""What users of neighbouring software have asked for in public threads, each request with a test of its name.

The thread is named in the docstring.  Other tests examine the same more closely; here each is met at all.
"""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import lungaccess as la
from anatomy.corrections import AIRWAY, FISSURE, with_corrections
from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.phantom import Phantom
from anatomy.poses import pose
from anatomy.strokes import Stroke, meant_voxels
from lungaccess.judging.checking import check
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import with_tool
from lungaccess.problem.tools import load_tool
from lungaccess.showing.explorer.opening import outlined
from lungaccess.showing.live.replanning import NEEDLE_TIP, TrackedReplanner
from lungaccess.showing.model_files import CAMERA_FILE, export_models

PACKAGING = Path(__file__).parents[2] / "packaging"
SYSTEM = la.load_system("ultrathin")


def test_segmental_bronchi_have_names(small_lung: Lung, small_phantom: Phantom) -> None:
    """LiquidFun/Airway#19, obophenotype/uberon#3444."""
    bronchi = small_lung.tree.bronchi
    named = [name for name, starts in zip(bronchi.names, bronchi.starts, strict=True) if starts and name]
    assert {"trachea", "right main bronchus", "left main bronchus"} <= set(named)
    assert sum(name[1:2] == "B" for name in named) >= 5


def test_the_core_of_a_biopsy_is_scored_and_not_its_point(small_lung: Lung, small_atlas: la.Atlas) -> None:
    """SliceTracker#266: an error in depth matters little where the core is long."""
    system = with_tool(SYSTEM, load_tool("core"))
    target = la.resolve_target(small_lung)
    plan = next(la.plan(small_lung, system, target, atlas=small_atlas, goal="default"))
    away = float(np.linalg.norm(plan.end_lps - plan.target_lps))
    assert away == pytest.approx(load_tool("core").beyond_mm, abs=0.2), (
        "the tip goes on until the core is there"
    )
    assert away > 1.0
    assert check(plan, small_lung).accepted


def test_dicom_segmentations_go_in_and_out(
    small_lung: Lung, small_plan: Plan, small_phantom: Phantom, tmp_path: Path
) -> None:
    """TotalSegmentator-AIDE#3, MONAILabel#1561, highdicom#306."""
    pytest.importorskip("highdicom")
    from anatomy.io.images import read_mask
    from lungaccess.judging.appraisal import appraise
    from lungaccess.showing.dicom_files import export_dicom
    from lungaccess.showing.report.html.volumes import CtFile
    from tests.anatomy.io.series import write_series

    (tmp_path / "ct").mkdir()
    write_series(tmp_path / "ct", small_phantom.ct, StudyInstanceUID="1.2.3", FrameOfReferenceUID="1.2.4")
    (tmp_path / "out").mkdir()
    ct = CtFile(path=tmp_path / "ct")
    export_dicom(small_plan, small_lung, tmp_path / "out", ct, appraise(small_plan, small_lung))
    vessels = read_mask(tmp_path / "out" / "segments.dcm", role="vessels")
    assert np.count_nonzero(vessels.array) == np.count_nonzero(small_lung.mask("vessel").array)


def test_3d_slicer_needs_no_terminal() -> None:
    """Slicer#9010, lungmask#114: a module installs the package and runs it in a process of its own."""
    text = (PACKAGING / "slicer" / "LungAccess" / "LungAccess.py").read_text(encoding="utf-8")
    compile(text, "LungAccess.py", "exec")
    assert "pip_ensure" in text or "pip_install" in text


def test_conda_pixi_and_ros_have_recipes() -> None:
    """RoboStack/ros-jazzy#250, roboplan#309: the recipes name what the project needs."""
    recipe = (PACKAGING / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    with open(PACKAGING.parent / "pyproject.toml", "rb") as stream:
        needed = tomllib.load(stream)["project"]["dependencies"]
    names = {
        each.replace(">", " ").replace("=", " ").replace("<", " ").replace(";", " ").split()[0]
        for each in needed
    }
    lacking = [name for name in names if name.lower() not in recipe.lower()]
    assert len(lacking) <= 1, lacking
    assert (PACKAGING / "ros" / "lungaccess_msgs" / "action" / "PlanAccess.action").is_file()


def test_a_nodule_is_outlined_from_a_click(small_lung: Lung, small_phantom: Phantom) -> None:
    """TotalSegmentator#191."""
    nodule = small_phantom.nodules[0]
    _shown, size = outlined(small_lung, small_phantom.ct, np.asarray(nodule.centre_lps))
    assert size["diameter_mm"] == pytest.approx(2.0 * nodule.radius_mm, rel=0.2)


def test_an_airway_is_edited_by_hand_where_it_is_wrong(small_phantom: Phantom) -> None:
    """pulmonarytoolkit#49, OHIF-AI#40: a leak is cut off at its neck with one click."""
    images = small_phantom.images
    lumen, grid = images.lumen.array, images.grid
    tissue = images.lung.array & ~lumen & ~images.vessels.array
    leak = np.zeros_like(lumen)
    wall = np.argwhere(lumen & np.roll(tissue, 4, axis=0))
    i, j, k = wall[len(wall) // 2]
    leak[i - 14 : i + 1, j - 1 : j + 2, k - 1 : k + 2] = True
    leak[i - 22 : i - 13, j - 5 : j + 6, k - 5 : k + 6] = True
    leaking = np.asfortranarray(lumen | leak)
    neck = grid.lps((i - 10, j, k))
    stroke = Stroke(tool="cut", points_lps=neck[None], radius_mm=2.5)
    box, mask = meant_voxels(stroke, grid, leaking, lambda _box: np.zeros((1, 1, 1), np.float32))
    left = leaking.copy()
    left[box] &= ~mask
    assert not left[i - 22 : i - 14, j, k].any(), "what lies behind the neck is gone"
    assert np.count_nonzero(left & lumen) > 0.98 * np.count_nonzero(lumen), "the airway is not"


def test_a_thin_fissure_is_completed_by_hand(small_phantom: Phantom) -> None:
    """pulmonarytoolkit#45, lungmask#4."""
    images = small_phantom.images
    assert images.fissures is not None
    gap = np.argwhere(images.fissures.array)[1000]
    torn = images.fissures.array.copy()
    hole = tuple(slice(max(int(at) - 4, 0), int(at) + 5) for at in gap)
    torn[hole] = False
    missing = images.fissures.array & ~torn
    values = np.where(missing, np.uint8(FISSURE), np.uint8(0))
    torn_images = replace(images, fissures=Volume(grid=images.grid, array=torn))
    whole = with_corrections(torn_images, Volume(grid=images.grid, array=np.asfortranarray(values)))
    assert whole.fissures is not None
    assert np.array_equal(whole.fissures.array, images.fissures.array)


def test_an_airway_that_was_not_found_is_bridged(small_phantom: Phantom) -> None:
    """pulmonarytoolkit#49: two ends of a bronchus are joined along the air between them."""
    images = small_phantom.images
    ct, grid = small_phantom.ct, images.grid
    assert ct.grid.is_close(grid)
    lumen = images.lumen.array
    heights = np.flatnonzero(lumen.any(axis=(0, 1)))
    top = int(heights[-1]) - 4
    ends = [np.argwhere(lumen[:, :, k]).mean(axis=0) for k in (top - 12, top)]
    points = grid.lps(np.array([[*ends[0], top - 12], [*ends[1], top]]))
    stroke = Stroke(tool="join", points_lps=points, radius_mm=1.5)
    hu = np.asarray(ct.array, dtype=np.float32)
    box, mask = meant_voxels(stroke, grid, np.zeros_like(lumen), lambda each: hu[each])
    assert np.count_nonzero(mask & lumen[box]) > 0.9 * np.count_nonzero(mask), "it stays in air"
    values = np.zeros(grid.shape, dtype=np.uint8, order="F")
    values[box][mask] = AIRWAY
    assert with_corrections(images, Volume(grid=grid, array=values)).lumen.array[box][mask].all()


def test_the_airway_is_one_mesh_file(small_plan: Plan, small_lung: Lung, tmp_path: Path) -> None:
    """SlicerLungCTAnalyzer#34."""
    export_models(small_plan, small_lung, tmp_path)
    airway = trimesh.load_mesh(tmp_path / "airway.stl")
    low, high = airway.bounds
    tree = small_lung.tree.points_lps
    assert (tree >= low - 3.0).all() and (tree <= high + 3.0).all()


def test_camera_frames_of_a_film_are_a_file(small_plan: Plan, small_lung: Lung, tmp_path: Path) -> None:
    """Slicer#6502, #6477."""
    export_models(small_plan, small_lung, tmp_path)
    frames = json.loads((tmp_path / CAMERA_FILE).read_text())["frames"]
    assert len(frames) > 50
    assert {"eye", "target", "up", "time_s"} <= set(frames[0])


def test_the_distance_to_the_target_is_split_and_an_alarm_is_given(
    small_plan: Plan, small_lung: Lung
) -> None:
    """SliceTracker#80, #151, LumpNav#1."""
    replanner = TrackedReplanner(small_plan, small_lung)
    target, needle = np.asarray(small_plan.end_lps), small_plan.system.needle
    assert needle is not None
    ahead = pose(target - [0.0, 0.0, 20.0], np.array([0.0, 0.0, 1.0]))
    assert "target 20.0 mm ahead and 0.0 mm aside" in replanner.answer(NEEDLE_TIP, ahead).words
    radius = needle.min_radius_of_curvature_mm
    bent = radius - math.sqrt(radius**2 - 20.0**2)
    for aside, alarms in ((0.8 * bent, False), (1.2 * bent, True)):
        beside = pose(target - [aside, 0.0, 20.0], np.array([0.0, 0.0, 1.0]))
        words = replanner.answer(NEEDLE_TIP, beside).words
        assert f"{aside:.1f} mm aside" in words
        assert ("ALARM" in words) is alarms, words


def test_an_action_of_ros_2_plans(small_plan: Plan) -> None:
    """ProjectWeek#1091, #1475: the action asks for what a plan needs."""
    types: Any = pytest.importorskip("rosbags.typesys")
    text = (PACKAGING / "ros" / "lungaccess_msgs" / "action" / "PlanAccess.action").read_text(
        encoding="utf-8"
    )
    goal, result, feedback = text.split("---\n")
    for name, part in (("Goal", goal), ("Result", result), ("Feedback", feedback)):
        assert types.get_types_from_msg(part, f"lungaccess_msgs/msg/{name}")
    assert all(word in goal for word in ("patient", "target", "system"))


def test_a_plan_goes_through_a_given_pose(small_lung: Lung, small_atlas: la.Atlas) -> None:
    """isaac_ros_cumotion#41: the place of the scope's tip is stated, and kept."""
    target = la.resolve_target(small_lung)
    first = next(la.plan(small_lung, SYSTEM, target, atlas=small_atlas, goal="default"))
    place = la.StatedPlace(kind="scope tip", lps_mm=first.scope.lps_from_scope_tip[:3, 3], within_mm=1.5)
    found = next(la.plan(small_lung, SYSTEM, target, atlas=small_atlas, goal="default", place=place))
    away = np.linalg.norm(found.scope.lps_from_scope_tip[:3, 3] - place.lps_mm)
    assert away <= 1.5

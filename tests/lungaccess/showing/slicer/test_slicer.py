"""The folder for 3D Slicer: every format read back by a reader that shares no code with the writer."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import nrrd
import numpy as np
import pytest
import trimesh

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import FileError, PlanFileError
from anatomy.grid import Volume
from anatomy.io import load_patient, read_volume
from anatomy.io.centerlines import read_centerlines
from anatomy.io.images import read_labels, write_volume
from anatomy.lung import Lung
from anatomy.phantom import LOBES, Phantom
from lungaccess.cli import app as cli
from lungaccess.judging.appraisal import Appraisal
from lungaccess.judging.checking import CheckReport
from lungaccess.plans.plan import Plan
from lungaccess.showing.slicer import Exported, export, export_slicer
from lungaccess.showing.slicer.models import SEGMENTS, label_map

DEVICES = ("scope", "tubes", "needle")
# What the markups schema 1.0.3 of 3D Slicer says.
POINT_KEYS = {
    "id", "label", "description", "associatedNodeID", "position", "orientation", "selected", "locked",
    "visibility", "positionStatus",
}  # fmt: skip
DISPLAY_KEYS = {
    "visibility", "opacity", "color", "selectedColor", "propertiesLabelVisibility", "pointLabelsVisibility",
    "glyphType", "glyphScale",
}  # fmt: skip


@pytest.fixture(scope="module")
def plan(toy_plan: Plan, small_lung: Lung) -> Plan:
    """A plan of three devices in the left half of space, said to be for the synthetic patient."""
    return replace(toy_plan, lung_key=small_lung.key)


@pytest.fixture(scope="module")
def folder(plan: Plan, small_lung: Lung, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("slicer") / "out"
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(export, "check", lambda *_: CheckReport(accepted=True, findings=()))
        export_slicer(plan, small_lung, folder)
    yield folder


@pytest.fixture
def markups(folder: Path) -> dict[str, Any]:
    return {name: json.loads((folder / f"{name}.mrk.json").read_text()) for name in (*DEVICES, "points")}


def points_of(content: dict[str, Any]) -> np.ndarray:
    return np.array([point["position"] for point in content["markups"][0]["controlPoints"]])


# Markups -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*DEVICES, "points"])
def test_markups_follow_the_schema(name: str, markups: dict[str, Any]) -> None:
    content = markups[name]
    assert set(content) == {"@schema", "markups"}
    assert content["@schema"].endswith("markups-schema-v1.0.3.json#")
    (markup,) = content["markups"]
    assert markup["type"] == ("Fiducial" if name == "points" else "Curve")
    assert (markup["coordinateSystem"], markup["coordinateUnits"]) == ("LPS", "mm")
    assert set(markup["display"]) <= DISPLAY_KEYS
    assert len(markup["display"]["color"]) == 3
    for point in markup["controlPoints"]:
        assert set(point) <= POINT_KEYS
        assert len(point["position"]) == 3 and point["positionStatus"] == "defined"
    assert len({point["id"] for point in markup["controlPoints"]}) == len(markup["controlPoints"])


@pytest.mark.parametrize("name", DEVICES)
def test_every_point_of_a_curve_has_radius_and_pose(name: str, markups: dict[str, Any]) -> None:
    (markup,) = markups[name]["markups"]
    (radius,) = markup["measurements"]
    assert radius["name"] == "Radius" and radius["units"] == "mm"
    assert len(radius["controlPointValues"]) == len(markup["controlPoints"])
    poses = np.array([point["orientation"] for point in markup["controlPoints"]]).reshape(-1, 3, 3)
    assert np.abs(poses.transpose(0, 2, 1) @ poses - np.eye(3)).max() < 1e-9
    assert np.linalg.det(poses).min() > 0.999
    # +z of each pose, the third column, points along the curve.
    points = points_of(markups[name])
    chords = np.diff(points, axis=0)
    chords /= np.linalg.norm(chords, axis=1, keepdims=True)
    turned = 0.5 * np.linalg.norm(chords[1:] - chords[:-1], axis=1).max(initial=0.0)
    assert np.einsum("ij,ij->i", chords, poses[:-1, :, 2]).min() > np.cos(turned + 0.02)


def test_curves_join_and_end_where_the_plan_says(markups: dict[str, Any], plan: Plan) -> None:
    scope, tubes, needle = (markups[name]["markups"][0] for name in DEVICES)
    ends = {
        "scope": (scope["controlPoints"][-1], plan.scope.lps_from_scope_tip),
        "tubes": (tubes["controlPoints"][-1], plan.tube.lps_from_tip),
        "needle": (needle["controlPoints"][0], plan.needle.lps_from_start),
    }
    for name, (point, pose) in ends.items():
        assert np.allclose(point["position"], pose[:3, 3], atol=1e-6), name
        assert np.allclose(np.reshape(point["orientation"], (3, 3))[:, 2], pose[:3, 2], atol=1e-6), name
    assert np.allclose(tubes["controlPoints"][0]["position"], plan.scope.lps_from_scope_tip[:3, 3])
    assert np.allclose(needle["controlPoints"][-1]["position"], plan.needle.end_lps, atol=1e-6)


def test_radii_are_those_of_the_devices(markups: dict[str, Any], plan: Plan) -> None:
    radii = {name: markups[name]["markups"][0]["measurements"][0]["controlPointValues"] for name in DEVICES}
    assert set(radii["scope"]) == {0.5 * plan.system.scope.outer_diameter_mm}
    assert set(radii["needle"]) == {plan.system.needle.radius_mm}
    outer, inner = plan.system.tubes.outer.radius_mm, plan.system.tubes.inner.radius_mm
    along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points_of(markups["tubes"]), axis=0), axis=1)))
    expected = np.where(along < plan.tube.outer_insertion_mm + 1e-3, outer, inner)
    assert radii["tubes"] == expected.tolist()
    assert {outer, inner} == set(radii["tubes"])


def test_points_of_interest(markups: dict[str, Any], plan: Plan) -> None:
    found = {point["label"]: point["position"] for point in markups["points"]["markups"][0]["controlPoints"]}
    assert found["target"] == plan.target_lps.tolist()
    assert found["exit through the wall"] == plan.tube.exit.point_lps.tolist()
    assert found["scope tip"] == plan.scope.lps_from_scope_tip[:3, 3].tolist()


# Segmentation ------------------------------------------------------------------------------------


def test_segmentation_is_read_back_by_ourselves(folder: Path, small_lung: Lung) -> None:
    path = folder / "anatomy.seg.nrrd"
    written, volume = label_map(small_lung), read_volume(path)
    assert volume.grid.is_close(small_lung.grid, 1e-9)
    assert np.array_equal(volume.array, written.array)
    present = {each.value: each.name for each in SEGMENTS if (written.array == each.value).any()}
    assert read_labels(path) == present
    assert {"lung tissue", "vessel", "airway wall", "airway lumen", "nodule"} <= set(present.values())
    assert np.array_equal(volume.array == 6, small_lung.mask("lumen").array)
    assert np.array_equal(
        np.asarray(volume.array) >= 1, ~small_lung.mask("outside").array | (volume.array > 1)
    )


def test_segmentation_is_read_by_another_library(folder: Path) -> None:
    array, header = nrrd.read(str(folder / "anatomy.seg.nrrd"))
    assert header["space"] == "left-posterior-superior"
    number = 0
    while f"Segment{number}_ID" in header:
        value = int(header[f"Segment{number}_LabelValue"])
        where = np.argwhere(array == value)
        extent = [int(n) for n in header[f"Segment{number}_Extent"].split()]
        assert extent == np.stack([where.min(axis=0), where.max(axis=0)], axis=1).ravel().tolist()
        colour = [float(c) for c in header[f"Segment{number}_Color"].split()]
        assert len(colour) == 3 and max(colour) <= 1.0
        key, _, entry = header[f"Segment{number}_Tags"].rstrip("|").partition(":")
        context, category, kind, modifier, regions, region, region_modifier = entry.split("~")
        assert key == "TerminologyEntry" and context and regions
        assert all(len(code.split("^")) == 3 for code in (category, kind, modifier, region, region_modifier))
        scheme, code, _ = kind.split("^")
        assert scheme == "SCT" and code.isdigit()
        number += 1
    assert number == len(set(np.unique(array)) - {0})


def test_the_exported_masks_make_a_patient_again(folder: Path, small_lung: Lung, tmp_path: Path) -> None:
    name = folder / "anatomy.seg.nrrd"
    inside = ["lung tissue", "fissure", "nodule", "vessel"]
    present = [each for each in inside if each in read_labels(name).values()]
    lines = {
        "lung": [f"{name}#{each}" for each in present],
        "lumen": f"{name}#airway lumen",
        "wall": f"{name}#airway wall",
        "vessels": f"{name}#vessel",
    }
    (tmp_path / "patient.toml").write_text("".join(f"{key} = {json.dumps(v)}\n" for key, v in lines.items()))
    images = load_patient(tmp_path)
    assert np.array_equal(images.lumen.array, small_lung.mask("lumen").array)
    # A vessel voxel that lies in lumen or wall belongs to the airway in the export.
    airway = small_lung.mask("lumen").array | small_lung.mask("airway").array
    assert np.array_equal(images.vessels.array, small_lung.mask("vessel").array & ~airway)


def test_only_nrrd_holds_a_header(tmp_path: Path, small_lung: Lung) -> None:
    with pytest.raises(FileError, match="header of keys"):
        write_volume(tmp_path / "a.nii.gz", small_lung.mask("lumen"), header={"Segment0_ID": "x"})


# Left and right ----------------------------------------------------------------------------------


def test_left_stays_left_in_every_file(folder: Path, small_phantom: Phantom, plan: Plan) -> None:
    """The plan lies at x > 0 in LPS, the patient's left; the phantom's own lobes say where left is."""
    assert plan.target_lps[0] > 50.0
    for name in (*DEVICES, "points"):
        content = json.loads((folder / f"{name}.mrk.json").read_text())["markups"][0]
        assert content["coordinateSystem"] == "LPS"
        assert content["controlPoints"][-1]["position"][0] > 40.0, name
    for name in DEVICES:
        assert b"\ncomment SPACE=LPS\n" in (folder / f"{name}.ply").read_bytes()[:200]
        mesh = trimesh.load(folder / f"{name}.ply", process=False)
        assert mesh.vertices[:, 0].max() > 40.0 > -10.0 < mesh.vertices[:, 0].min()
    route = np.loadtxt(folder / "route_custusx.txt")
    assert route[0, 0] > 50.0
    array, header = nrrd.read(str(folder / "anatomy.seg.nrrd"))
    lobes = {"left" in name: set() for name in LOBES} | {True: set(), False: set()}
    for name, value in LOBES.items():
        lobes["left" in name].add(value)
    for is_left, sign in ((True, 1.0), (False, -1.0)):
        truth = np.isin(small_phantom.lobes.array, sorted(lobes[is_left]))
        centre = small_phantom.grid.lps(np.argwhere(truth)).mean(axis=0)
        assert sign * centre[0] > 20.0
        matrix, origin = header["space directions"].T, header["space origin"]
        ijk = np.floor(np.linalg.solve(matrix, centre - origin) + 0.5).astype(int)
        assert array[tuple(ijk)] != 0, "the middle of a lung lies in the lung"
    left_nodule = next(each for each in small_phantom.nodules if each.centre_lps[0] > 0.0)
    vertices = trimesh.load(folder / "nodule.ply", process=False).vertices
    near = np.linalg.norm(vertices - left_nodule.centre_lps, axis=1)
    assert near.min() < left_nodule.radius_mm + 2.0
    mirrored = np.linalg.norm(vertices - left_nodule.centre_lps * (-1.0, 1.0, 1.0), axis=1)
    assert mirrored.min() > left_nodule.radius_mm + 2.0


def test_the_readme_states_both_frames(folder: Path, plan: Plan) -> None:
    text = (folder / "README.txt").read_text()
    x, y, z = plan.target_lps
    assert f"(LPS): {x:.1f}, {y:.1f}, {z:.1f}" in text
    assert f"(RAS): {-x:.1f}, {-y:.1f}, {z:.1f}" in text
    assert "ACCEPTS" in text and "not a medical device" in text
    assert all(name.name in text for name in folder.iterdir())


# Tree, route and scene ---------------------------------------------------------------------------


def test_the_tree_keeps_radius_and_branches(folder: Path, small_lung: Lung) -> None:
    tree: AirwayTree = read_centerlines(folder / "airway_tree.vtp")
    assert np.allclose(tree.points_lps.sum(axis=0), small_lung.tree.points_lps.sum(axis=0), atol=1e-6)
    assert np.allclose(np.sort(tree.radius_mm), np.sort(small_lung.tree.radius_mm))


def test_the_route_of_custusx_runs_from_target_to_trachea(folder: Path, plan: Plan) -> None:
    lines = (folder / "route_custusx.txt").read_text().splitlines()
    assert lines[0].startswith("# [xPos yPos zPos BranchingPoint (0=Normal")
    rows = np.loadtxt(lines)
    assert lines[0].endswith(f"Number of positions: {len(rows)}")
    assert np.allclose(rows[0, :3], plan.needle.end_lps, atol=1e-4)
    assert np.allclose(rows[-1, :3], plan.scope.lps_from_entry[:3, 3], atol=1e-4)
    flags = rows[:, 3].astype(int).tolist()
    assert flags == sorted([f for f in flags if f == 2], reverse=True) + [f for f in flags if f != 2]
    branches = 1 + flags.count(1)
    assert branches == len(set(plan.scope.branches.tolist())) == 2
    assert np.linalg.norm(np.diff(rows[:, :3], axis=0), axis=1).max() < 2.0


def test_the_scene_loads_every_file(folder: Path) -> None:
    root = ElementTree.parse(folder / "scene.mrml").getroot()
    assert root.tag == "MRML"
    nodes = {node.get("id"): node for node in root}
    assert len(nodes) == len(root)
    stored = {node.get("fileName") for node in root if node.get("fileName")}
    others = {"scene.mrml", "README.txt", "plan.json", "route_custusx.txt"}
    assert stored == {path.name for path in folder.iterdir()} - others
    for node in root:
        if node.tag.endswith("Storage") and node.tag != "SegmentationStorage":
            assert node.get("coordinateSystem") == "LPS"
        references = dict(each.split(":") for each in (node.get("references") or "").split(";") if each)
        assert set(references) in (set(), {"display", "storage"})
        for role, target in references.items():
            assert role in nodes[target].tag.lower()
            assert target.startswith(f"vtkMRML{nodes[target].tag}Node")
            assert nodes[target].tag.startswith({"MarkupsCurve": "Markups"}.get(node.tag, node.tag)[:7])


def test_the_same_plan_gives_the_same_files(
    plan: Plan, small_lung: Lung, folder: Path, tmp_path: Path
) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(export, "check", lambda *_: CheckReport(accepted=True, findings=()))
        written = export_slicer(plan, small_lung, tmp_path)
    assert set(written.files) == {path.name for path in folder.iterdir()}
    for name in written.files:
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes(), name


# Refusals and the command ------------------------------------------------------------------------


def test_a_plan_of_another_patient_is_refused(toy_plan: Plan, small_lung: Lung, tmp_path: Path) -> None:
    with pytest.raises(PlanFileError, match="made for Toy"):
        export_slicer(toy_plan, small_lung, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_refused_plan_says_so_wherever_it_is_seen(plan: Plan, small_lung: Lung, tmp_path: Path) -> None:
    """The toy plan fits nothing in the synthetic patient, and the true check says so."""
    written = export_slicer(plan, small_lung, tmp_path)
    assert not written.report.accepted
    assert "REFUSES" in (tmp_path / "README.txt").read_text()
    names = {node.get("name") for node in ElementTree.parse(tmp_path / "scene.mrml").getroot()}
    assert "REFUSED by the check: needle" in names and "needle" not in names
    for name in (*DEVICES, "points"):
        (markup,) = json.loads((tmp_path / f"{name}.mrk.json").read_text())["markups"]
        assert markup["name"].startswith("REFUSED by the check")


@pytest.mark.parametrize(("accepted", "code"), [(True, 0), (False, 1)])
def test_the_command_says_what_it_wrote(
    accepted: bool,
    code: int,
    plan: Plan,
    small_lung: Lung,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    report = CheckReport(accepted=accepted, findings=())
    monkeypatch.setattr("lungaccess.cli.options.load_lung", lambda *_: small_lung)
    monkeypatch.setattr(
        "lungaccess.showing.slicer.export_slicer",
        lambda *_, **__: Exported(files=("scene.mrml",), report=report),
    )
    appraisal = Appraisal(check=report, risk=None, limits=())
    monkeypatch.setattr("lungaccess.judging.appraisal.appraiser.appraise", lambda *_, **__: appraisal)
    plan.save(tmp_path / "plan.json")
    words = ["export", str(tmp_path / "plan.json"), "toy", "--slicer", str(tmp_path / "out")]
    assert cli.main(words) == code
    assert "scene.mrml" in capsys.readouterr().out
    assert cli.main([*words, "--json"]) == code
    answer = json.loads(capsys.readouterr().out)
    assert answer == {"folder": str(tmp_path / "out"), "files": ["scene.mrml"], "accepted": accepted}


@pytest.mark.data
@pytest.mark.slow
def test_a_real_patient_is_of_a_size_to_send(data_dir: Path, tmp_path: Path) -> None:
    import lungaccess as la

    lung = la.load_patient(data_dir / "med-rad" / "Patient1")
    found = next(
        la.plan(lung, la.load_system("thin-scope"), la.resolve_target(lung), iterations=0, goal="default")
    )
    written = export_slicer(found, lung, tmp_path)
    assert written.report.accepted
    assert sum(path.stat().st_size for path in tmp_path.iterdir()) < 20e6
    array, header = nrrd.read(str(tmp_path / "anatomy.seg.nrrd"))
    voxel = np.linalg.solve(header["space directions"].T, found.target_lps - header["space origin"])
    assert array[tuple(np.floor(voxel + 0.5).astype(int))] == 3, "the target lies in the nodule"
    for name in DEVICES:
        points = points_of(json.loads((tmp_path / f"{name}.mrk.json").read_text()))
        surface = trimesh.load(tmp_path / f"{name}.ply", process=False)
        assert np.abs(surface.bounds - [points.min(axis=0), points.max(axis=0)]).max() < 3.0


ROLES = {
    "lumen": "airway lumen",
    "wall": "airway wall",
    "vessels": "vessel",
    "lung": "lung tissue",
    "fissures": "fissure",
    "nodule": "nodule",
}


def test_an_exported_label_map_is_a_patient_again(small_lung: Lung, tmp_path: Path) -> None:
    """Its lungs leave out vessels and airways; with the vessels elsewhere they stay as they are."""
    volume = label_map(small_lung)
    segments = {each.name: each.value for each in SEGMENTS}
    lines = [f'{role} = "map.nrrd#{segments[name]}"' for role, name in ROLES.items()]
    (tmp_path / "patient.toml").write_text("\n".join(lines))
    write_volume(tmp_path / "map.nrrd", volume)
    images = load_patient(tmp_path)
    assert any("leaves out the vessels, as a label map does" in said for said in images.warnings)
    whole = ~small_lung.mask("outside").array
    assert (images.lung.array & whole).sum() == whole.sum()
    added = images.lung.array & ~whole
    obstacles = images.lumen.array | images.wall.array | images.vessels.array
    assert (added & ~obstacles).sum() <= 0.01 * whole.sum()
    away = volume.array.copy()
    away[volume.array == segments["vessel"]] = segments["lung tissue"]
    outside = np.argwhere(away == 0)[:2000]
    away[tuple(outside.T)] = segments["vessel"]
    write_volume(tmp_path / "map.nrrd", Volume(grid=volume.grid, array=away))
    assert not any("leaves out" in said for said in load_patient(tmp_path).warnings)

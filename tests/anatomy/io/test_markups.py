"""Markups of 3D Slicer: frames, names, transforms, bundles, and files that are none."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import FileError, FrameError
from anatomy.io.markups import (
    Reference,
    parse_reference,
    read_markups,
    read_named_curve,
    read_named_point,
    read_named_pose,
)

LEFT = [60.0, -20.0, 30.0]
"""A point on the patient's left, LPS mm."""
TURN = [0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0]


def markup(name: str, *points: dict[str, Any], **more: Any) -> dict[str, Any]:
    content = {"name": name, "type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm"}
    return {"@schema": "x", "markups": [{**content, "controlPoints": list(points), **more}]}


def point(label: str, place: list[float], **more: Any) -> dict[str, Any]:
    return {"label": label, "position": place, "positionStatus": "defined", **more}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A scene of two lists, one of them in a file with a blank in its name."""
    (tmp_path / "points.mrk.json").write_text(
        json.dumps(markup("points", point("target", LEFT), point("tip", LEFT, orientation=TURN)))
    )
    (tmp_path / "my F.mrk.json").write_text(json.dumps(markup("of the file", point("F-1", [1.0, 2.0, 3.0]))))
    scene(tmp_path)
    return tmp_path


def scene(folder: Path, references: str = "", transform: str = "") -> Path:
    path = folder / "scene.mrml"
    path.write_text(
        '<MRML version="Slicer5">'
        '<MarkupsJsonStorage id="s1" fileName="points.mrk.json" coordinateSystem="LPS"/>'
        f'<MarkupsFiducial id="n1" name="points" references="display:d1;storage:s1;{references}"/>'
        '<MarkupsJsonStorage id="s2" fileName="my%20F.mrk.json" coordinateSystem="LPS"/>'
        '<MarkupsFiducial id="n2" name="F" references="storage:s2;"/>'
        '<ModelStorage id="s3" fileName="lung.ply"/><Model id="m" references="storage:s3;"/>'
        f"{transform}</MRML>"
    )
    return path


@pytest.mark.parametrize(
    ("text", "file", "name"),
    [
        ("scene.mrml#target", "scene.mrml", "target"),
        ("a b/Scene.MRML#my target #1", "a b/Scene.MRML", "my target #1"),
        (r"C:\case\scene.mrb#F-1", r"C:\case\scene.mrb", "F-1"),
        ("x.mrk.json#exit through the wall", "x.mrk.json", "exit through the wall"),
    ],
)
def test_references(text: str, file: str, name: str) -> None:
    assert parse_reference(text) == Reference(Path(file), name)


@pytest.mark.parametrize("text", ["ras:1,2,3", "target1", "scene.mrml", "scene.mrml#", "mask.nii.gz#3"])
def test_other_texts_are_no_references(text: str) -> None:
    assert parse_reference(text) is None


def test_points_are_found_by_label_and_by_name(folder: Path) -> None:
    path = folder / "scene.mrml"
    assert read_named_point(Reference(path, "target")).lps_mm.tolist() == LEFT
    assert read_named_point(Reference(path, "F")).lps_mm.tolist() == [1.0, 2.0, 3.0]
    assert read_named_point(Reference(folder / "points.mrk.json", "target")).lps_mm.tolist() == LEFT
    assert read_named_curve(Reference(path, "points")).points_lps.shape == (2, 3)
    with pytest.raises(FileError, match="no point 'goal'.*F-1, target, tip"):
        read_named_point(Reference(path, "goal"))
    with pytest.raises(FileError, match="no curve 'F'"):
        read_named_curve(Reference(path, "F"))


def test_two_points_of_one_label_are_ambiguous(folder: Path) -> None:
    (folder / "my F.mrk.json").write_text(json.dumps(markup("F", point("target", [0.0, 0.0, 0.0]))))
    with pytest.raises(FileError, match="2 points 'target'"):
        read_named_point(Reference(folder / "scene.mrml", "target"))


def test_the_same_point_in_ras_and_lps(tmp_path: Path) -> None:
    """The patient's left is -R: the same point and pose, written in the other frame."""
    ras = [-LEFT[0], -LEFT[1], LEFT[2]]
    turn = (np.diag([-1.0, -1.0, 1.0]) @ np.reshape(TURN, (3, 3))).ravel().tolist()
    for frame, place, rotation in (("LPS", LEFT, TURN), ("RAS", ras, turn)):
        content = markup("p", point("tip", place, orientation=rotation), coordinateSystem=frame)
        path = tmp_path / f"{frame}.mrk.json"
        path.write_text(json.dumps(content))
        pose = read_named_pose(Reference(path, "tip"))
        assert pose[:3, 3].tolist() == LEFT
        assert pose[:3, :3].ravel().tolist() == TURN


def test_a_point_without_direction_is_no_pose(folder: Path) -> None:
    with pytest.raises(FrameError, match="no direction"):
        read_named_pose(Reference(folder / "scene.mrml", "target"))
    screen = [-1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0]
    path = folder / "new.mrk.json"
    path.write_text(json.dumps(markup("new", point("new", LEFT, orientation=screen))))
    with pytest.raises(FrameError, match="no direction"):
        read_named_pose(Reference(path, "new"))


def test_points_below_a_transform_are_refused_unless_stored_in_the_masks_phase(folder: Path) -> None:
    moved = '<LinearTransform id="t1" name="{}"/>'
    path = scene(folder, "transform:t1;", moved.format("registration"))
    with pytest.raises(FrameError, match="below the transform 'registration'"):
        read_markups(path)
    path = scene(folder, "transform:t1;", moved.format("breathing tissue"))
    assert read_named_point(Reference(path, "target")).lps_mm.tolist() == LEFT
    with pytest.raises(FrameError, match="below the transform 't9'"):
        read_markups(scene(folder, "transform:t9;"))


def test_a_bundle_is_read_like_its_scene(folder: Path) -> None:
    path = folder / "case.mrb"
    with zipfile.ZipFile(path, "w") as bundle:
        for name in ("scene.mrml", "points.mrk.json", "my F.mrk.json"):
            bundle.write(folder / name, f"case/{name}")
    assert read_named_point(Reference(path, "target")).lps_mm.tolist() == LEFT
    with zipfile.ZipFile(path, "w") as bundle:
        bundle.write(folder / "scene.mrml", "case/scene.mrml")
    with pytest.raises(FileError, match=r"no points\.mrk\.json"):
        read_markups(path)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(FileError):
        read_markups(path)


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"coordinateSystem": ""}, FrameError),
        ({"coordinateSystem": "IJK"}, FrameError),
        ({"coordinateUnits": "m"}, FileError),
        ({"controlPoints": [point("a", [1.0, 2.0])]}, FileError),
        ({"controlPoints": [point("a", [1.0, 2.0, float("nan")])]}, FileError),
        ({"controlPoints": [{"label": "a"}]}, FileError),
        ({"controlPoints": [point("a", LEFT, orientation=[1.0, 2.0])]}, FileError),
        ({"controlPoints": [point("a", LEFT, orientation=[-1, 0, 0, 0, 1, 0, 0, 0, 1])]}, FrameError),
        ({"controlPoints": 3}, FileError),
    ],
)
def test_damaged_markups_get_a_typed_error(
    change: dict[str, Any], error: type[Exception], tmp_path: Path
) -> None:
    path = tmp_path / "x.mrk.json"
    path.write_text(json.dumps(markup("x", point("x", LEFT), **change)))
    with pytest.raises(error):
        read_markups(path)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("x.mrk.json", "[]"),
        ("x.mrk.json", "{"),
        ("x.json", '{"a": 1}'),
        ("x.mrml", "<MRML>"),
        ("x.mrml", '<!DOCTYPE a [<!ENTITY b "c">]><MRML/>'),
        ("x.fcsv", "1,2,3"),
        ("x.mrb", "no archive"),
    ],
)
def test_other_files_get_a_typed_error(name: str, content: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(FileError):
        read_markups(tmp_path / name)


def test_points_that_are_not_placed_are_left_out(tmp_path: Path) -> None:
    path = tmp_path / "x.mrk.json"
    preview = point("b", LEFT, positionStatus="preview")
    path.write_text(json.dumps(markup("x", point("a", LEFT), preview)))
    assert [each.label for each in read_markups(path)[0].points] == ["a"]

"""Masks of one's own, described by a patient.toml."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError, FileError, FrameError, SettingsError
from anatomy.grid import Grid, Volume
from anatomy.io import load_patient, write_volume
from tests.anatomy.io.label_maps import LABELS, add_label_table, label_map, require_same


@pytest.fixture
def own_folder(tmp_path: Path, masks: dict[str, Volume], grid: Grid) -> Path:
    for name, volume in masks.items():
        write_volume(tmp_path / f"{name}.nrrd", volume)
    cost = np.full(grid.shape, 0.25)
    cost[0, 0, 0] = np.inf
    write_volume(tmp_path / "cost.nii.gz", Volume(grid=grid, array=cost))
    describe(tmp_path)
    return tmp_path


BASIS = {
    "lumen": "lumen.nrrd",
    "vessels": ["arteries.nrrd", "veins.nrrd"],
    "lung": ["lung_left.nrrd", "lung_right.nrrd"],
}


def describe(folder: Path, **changes: object) -> None:
    keys = {**BASIS, **changes}
    (folder / "patient.toml").write_text(
        "\n".join(f"{key} = {json.dumps(value)}" for key, value in keys.items() if value is not None)
    )


def test_own_masks_are_read_as_described(own_folder, masks):
    describe(
        own_folder,
        name="Ms Example",
        wall="wall.nrrd",
        fissures="fissures.nrrd",
        nodule="nodule.nrrd",
        cost="cost.nii.gz",
        breath_hold="inspiration",
        targets=["ras:-17.5,-10,31", "lps:1,2,3"],
    )
    patient = load_patient(own_folder)
    assert (patient.name, patient.kind, patient.breath_hold) == ("Ms Example", "masks", "inspiration")
    require_same(patient.lumen, masks["lumen"])
    require_same(patient.wall, masks["wall"])
    require_same(patient.vessels, masks["arteries"], masks["veins"])
    require_same(patient.lung, masks["lung_left"], masks["lung_right"])
    require_same(patient.fissures, masks["fissures"])
    require_same(patient.nodules, masks["nodule"])
    assert patient.cost.array.dtype == np.float32
    assert np.isinf(patient.cost.array[0, 0, 0]) and patient.cost.array[1, 1, 1] == 0.25
    assert [p.tolist() for p in patient.targets_lps] == [[17.5, 10, 31], [1, 2, 3]]
    assert {"patient.toml", "cost.nii.gz", "veins.nrrd"} <= set(patient.sources)


def test_only_three_keys_are_needed(own_folder):
    patient = load_patient(own_folder / "patient.toml")
    assert patient.name == own_folder.name
    assert (patient.wall, patient.cost, patient.breath_hold, patient.targets_lps) == (None, None, None, ())


def test_files_of_one_name_in_two_folders_are_told_apart(own_folder, masks):
    for side in ("left", "right"):
        (own_folder / side).mkdir()
        write_volume(own_folder / side / "lung.nrrd", masks[f"lung_{side}"])
    describe(own_folder, lung=["left/lung.nrrd", "right/lung.nrrd"])
    patient = load_patient(own_folder)
    require_same(patient.lung, masks["lung_left"], masks["lung_right"])
    assert {"lumen.nrrd", "left/lung.nrrd", "right/lung.nrrd"} <= set(patient.sources)


def test_labels_of_one_file_are_taken_by_value_and_by_name(own_folder, masks):
    write_volume(own_folder / "all.nii.gz", label_map(masks))
    add_label_table(own_folder / "all.nii.gz", LABELS)
    vessels = ["all.nii.gz#lung_arteries", "all.nii.gz#4"]
    describe(own_folder, lumen="all.nii.gz#1", wall="all.nii.gz#lung_airways_wall", vessels=vessels)
    patient = load_patient(own_folder)
    require_same(patient.lumen, masks["lumen"])
    require_same(patient.wall, masks["wall"])
    require_same(patient.vessels, masks["arteries"], masks["veins"])
    describe(own_folder, lumen="all.nii.gz#airway")
    with pytest.raises(AnatomyError, match="no label named 'airway'"):
        load_patient(own_folder)


def test_segments_of_a_slicer_segmentation_are_taken_by_name(own_folder, masks):
    path = own_folder / "lungs.seg.nrrd"
    write_volume(own_folder / "lungs.nrrd", label_map(masks))
    segments = b"Segment0_LabelValue:=1\nSegment0_Name:=Airway tree\n\n"
    path.write_bytes((own_folder / "lungs.nrrd").read_bytes().replace(b"\n\n", b"\n" + segments, 1))
    describe(own_folder, lumen="lungs.seg.nrrd#Airway tree")
    require_same(load_patient(own_folder).lumen, masks["lumen"])


def test_the_frame_of_nrrd_files_without_one_can_be_told(own_folder):
    for path in own_folder.glob("*.nrrd"):
        content = path.read_bytes().replace(b"space: left-posterior-superior", b"space dimension: 3")
        path.write_bytes(content)
    with pytest.raises(FrameError, match="does not state its frame"):
        load_patient(own_folder)
    describe(own_folder, frame="lps")
    in_lps = load_patient(own_folder).grid.lps([0, 0, 0])
    describe(own_folder, frame="ras")
    assert load_patient(own_folder).grid.lps([0, 0, 0]) == pytest.approx([-1, -1, 1] * in_lps)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"lumen": None}, "lumen"),
        ({"airway": "lumen.nrrd"}, "airway"),
        ({"breath_hold": "deep"}, "breath_hold"),
        ({"frame": "slicer"}, "frame"),
        ({"name": 7}, "name"),
        ({"vessels": [1]}, "vessels"),
    ],
)
def test_a_wrong_description_is_refused(own_folder, change, problem):
    describe(own_folder, **change)
    with pytest.raises(SettingsError, match=problem) as caught:
        load_patient(own_folder)
    assert "patient.toml" in str(caught.value) and "Keys of a patient.toml are lumen" in str(caught.value)


def test_broken_toml_bare_targets_and_missing_files_are_refused(own_folder):
    describe(own_folder, targets=["1,2,3"])
    with pytest.raises(FrameError, match="does not state its frame"):
        load_patient(own_folder)
    describe(own_folder, wall="missing.nrrd")
    with pytest.raises(FileError, match=r"missing\.nrrd"):
        load_patient(own_folder)
    (own_folder / "bronchi\u00e9.nrrd").symlink_to(own_folder / "lumen.nrrd")
    (own_folder / "gone.nrrd").symlink_to("nowhere")
    for name, remedy in (
        ("bronchie\u0301.nrrd", "NFC or NFD"), (".\\lumen.nrrd", r"Write \./lumen\.nrrd"),
        ("gone.nrrd", "leads nowhere"),
    ):  # fmt: skip
        describe(own_folder, wall=name)
        with pytest.raises(FileError, match=remedy):
            load_patient(own_folder)
    (own_folder / "patient.toml").write_text("lumen = ")
    with pytest.raises(SettingsError, match="not valid TOML"):
        load_patient(own_folder)


@pytest.mark.parametrize("value", [-0.1, 1.1, np.nan, -np.inf])
def test_a_cost_outside_its_range_is_refused(own_folder, grid, value):
    cost = np.full(grid.shape, value)
    write_volume(own_folder / "cost.nii.gz", Volume(grid=grid, array=cost))
    describe(own_folder, cost="cost.nii.gz")
    with pytest.raises(AnatomyError, match="cost"):
        load_patient(own_folder)

"""Hashes of a patient's files: whatever can change the lung changes them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import FileError
from anatomy.build import lung_key
from anatomy.grid import Volume
from anatomy.io import load_patient, write_volume
from anatomy.io.inputs import input_hashes

TOML = """
lumen = "masks/airway/mask.nii.gz"
vessels = ["arteries.nii.gz", "labels.nii.gz#2"]
lung = "masks/lung/mask.nii.gz"
fissures = "labels.nii.gz#fissure"
nodule = "detached.mhd"
name = "Nobody"
targets = ["lps 1 2 3"]
"""

DESCRIBED = (
    "patient.toml",
    "masks/airway/mask.nii.gz",
    "masks/lung/mask.nii.gz",
    "arteries.nii.gz",
    "labels.nii.gz",
    "labels.json",
    "detached.mhd",
    "voxels.raw",
)
"""Files of a described patient whose content matters."""


def _write(folder: Path, **files: str) -> None:
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


@pytest.fixture
def described(tmp_path: Path) -> Path:
    """Return a folder with patient.toml, whose files need not be images to be hashed."""
    folder = tmp_path / "patient"
    files = {
        "patient.toml": TOML,
        "masks/airway/mask.nii.gz": "airway",
        "masks/lung/mask.nii.gz": "lung",
        "arteries.nii.gz": "arteries",
        "labels.nii.gz": "labels",
        "labels.json": '{"fissure": 3}',
        "detached.mhd": "NDims = 3\nElementDataFile = voxels.raw\n",
        "voxels.raw": "voxels",
        "ct.nii.gz": "not part of the patient",
        "notes.txt": "not part of the patient",
    }
    _write(folder, **files)
    return folder


def _changes(path: Path, change: Callable[[], object]) -> bool:
    before = lung_key(input_hashes(path))
    change()
    return lung_key(input_hashes(path)) != before


def test_files_of_a_description_are_hashed_by_their_place(described: Path) -> None:
    hashes = input_hashes(described)
    assert set(hashes) == set(DESCRIBED)
    assert hashes["arteries.nii.gz"] == hashlib.sha256(b"arteries").hexdigest()
    assert input_hashes(described / "patient.toml") == hashes
    assert input_hashes(str(described)) == hashes


@pytest.mark.parametrize("name", DESCRIBED)
def test_any_content_that_matters_changes_the_key(described: Path, name: str) -> None:
    file = described / name
    assert _changes(described, lambda: file.write_text(file.read_text() + "\n"))


@pytest.mark.parametrize("name", ["ct.nii.gz", "notes.txt"])
def test_other_files_beside_a_description_do_not(described: Path, name: str) -> None:
    assert not _changes(described, lambda: (described / name).write_text("changed"))


def test_two_files_that_swap_their_contents_change_the_key(described: Path) -> None:
    airway, lung = (described / "masks" / n / "mask.nii.gz" for n in ("airway", "lung"))

    def swap() -> None:
        a, b = airway.read_text(), lung.read_text()
        airway.write_text(b)
        lung.write_text(a)

    assert _changes(described, swap)


def test_a_description_by_any_name_and_files_elsewhere(tmp_path: Path) -> None:
    _write(tmp_path, **{"a/other.toml": 'lumen = "../b/airway.nii.gz"\n', "b/airway.nii.gz": "airway"})
    assert set(input_hashes(tmp_path / "a" / "other.toml")) == {"other.toml", "../b/airway.nii.gz"}
    absolute = tmp_path / "b" / "airway.nii.gz"
    _write(tmp_path, **{"a/other.toml": f'lumen = "{absolute}"\n'})
    assert set(input_hashes(tmp_path / "a" / "other.toml")) == {"other.toml", "../b/airway.nii.gz"}


def test_a_file_name_may_hold_a_hash_sign(tmp_path: Path) -> None:
    _write(
        tmp_path, **{"patient.toml": 'lumen = "a#1.nii"\nlung = "b#2.nii#3"\n', "a#1.nii": "", "b#2.nii": ""}
    )
    assert set(input_hashes(tmp_path)) == {"patient.toml", "a#1.nii", "b#2.nii"}


@pytest.mark.parametrize("content", ["not toml [", "", "lumen = 3", 'lumen = ["missing.nii.gz", ["x"]]'])
def test_a_wrong_description_is_hashed_and_judged_elsewhere(tmp_path: Path, content: str) -> None:
    _write(tmp_path, **{"patient.toml": content})
    assert set(input_hashes(tmp_path)) == {"patient.toml"}


def test_long_texts_and_nul_are_no_files(tmp_path: Path) -> None:
    _write(tmp_path, **{"patient.toml": f'name = "{"x" * 5000}"\nbreath_hold = "\\u0000"\n'})
    assert set(input_hashes(tmp_path)) == {"patient.toml"}


@pytest.mark.parametrize(
    ("header", "hashed"),
    [
        ("ElementDataFile = LOCAL\n", False),
        ("ElementDataFile=voxels.zraw", True),
        ("ElementDataFile = LIST\nvoxels.zraw\n", True),
        ("ElementDataFile = voxels%02d.zraw 1 9 1\r\n", True),
        ("no header", False),
    ],
)
def test_voxels_beside_a_metaimage_header_count(tmp_path: Path, header: str, hashed: bool) -> None:
    _write(tmp_path, **{"lung_airways.mhd": header, "voxels.zraw": "1"})
    assert ("voxels.zraw" in input_hashes(tmp_path)) is hashed


def test_a_folder_is_its_images_and_texts(tmp_path: Path) -> None:
    names = ["bronchialTree.nii.gz", "vessels.NII", "start1.txt", "labels.json", "x.seg.nrrd", "x.mha"]
    _write(tmp_path, **{name: name for name in [*names, "picture.png", "notes.md", "sub/deep.nii.gz"]})
    assert set(input_hashes(tmp_path)) == set(names)
    assert _changes(tmp_path, lambda: (tmp_path / "start2.txt").write_text("new"))
    assert _changes(tmp_path, (tmp_path / "start1.txt").unlink)
    assert _changes(tmp_path, lambda: (tmp_path / "x.mha").rename(tmp_path / "y.mha"))
    assert not _changes(tmp_path, lambda: (tmp_path / "picture.png").write_text("other"))


def test_which_file_is_the_label_map_matters(tmp_path: Path) -> None:
    _write(tmp_path, **{"one.nii.gz": "1", "two.nii.gz": "2", "two.json": "{}"})
    one, two = (input_hashes(tmp_path / name) for name in ("one.nii.gz", "two.nii.gz"))
    assert {"one.nii.gz", "two.nii.gz", "two.json"} <= set(one) & set(two)
    assert len({lung_key(one), lung_key(two), lung_key(input_hashes(tmp_path))}) == 3


def test_the_same_contents_elsewhere_have_the_same_key(described: Path, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    before = input_hashes(described)
    described.rename(moved)
    assert input_hashes(moved) == before


@pytest.mark.parametrize("name", ["nowhere", "nowhere.toml", "nowhere.nii.gz"])
def test_nothing_there_is_an_error(tmp_path: Path, name: str) -> None:
    with pytest.raises(FileError, match="nowhere"):
        input_hashes(tmp_path / name)


def test_every_file_that_is_read_is_hashed(med_rad_folder: Path) -> None:
    hashes = input_hashes(med_rad_folder)
    sources = load_patient(med_rad_folder).sources
    assert sources.items() <= hashes.items()


def test_every_file_a_description_reads_is_hashed(tmp_path: Path, masks: dict[str, Volume]) -> None:
    for name in ("lumen", "arteries", "lung_left", "lung_right"):
        write_volume(tmp_path / f"{name}.nii.gz", masks[name])
    labels = Volume(grid=masks["fissures"].grid, array=3 * masks["fissures"].array.astype(np.uint8))
    write_volume(tmp_path / "labels.nii.gz", labels)
    (tmp_path / "labels.json").write_text('{"fissure": 3}')
    (tmp_path / "patient.toml").write_text(
        'lumen = "lumen.nii.gz"\nvessels = "arteries.nii.gz"\n'
        'lung = ["lung_left.nii.gz", "lung_right.nii.gz"]\n'
        'fissures = "labels.nii.gz#fissure"\n'
    )
    images = load_patient(tmp_path)
    assert images.fissures is not None and images.fissures.array.sum() == masks["fissures"].array.sum()
    assert images.sources.items() <= input_hashes(tmp_path).items()
    assert _changes(tmp_path, lambda: (tmp_path / "labels.json").write_text('{"other": 3, "fissure": 4}'))

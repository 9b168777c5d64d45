"""Transforms that end ITK, and bundles that unpack to more than they say, are refused and end nothing."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
import SimpleITK

from anatomy.base.errors import AnatomyError, FileError
from anatomy.grid import Grid
from anatomy.io.markups import read_markups
from anatomy.io.motion_files import read_transform, read_vectors, write_vectors

GRID = Grid.from_spacing((5, 5, 5), (10.0, 10.0, 10.0), (0.0, 0.0, 0.0))
BSPLINE = """#Insight Transform File V1.0
#Transform 0
Transform: BSplineTransform_double_3_3
Parameters: 0
FixedParameters: {0} {0} {0} 0 0 0 1 1 1 1 0 0 0 1 0 0 0 1
"""
TEXTS = {
    "no parameters": "#Insight Transform File V1.0\n#Transform 0\nTransform: Euler3DTransform_double_3_3\n",
    "huge grid": BSPLINE.format(100_000),
    "negative grid": BSPLINE.format(-5),
    "two dimensions": "#Insight Transform File V1.0\n#Transform 0\nTransform: Euler2DTransform_double_2_2\n"
    "Parameters: 0 1 1\nFixedParameters: 0 0\n",
    "cut": "#Insight Transform File V1.0\n#Transform 0\nTransform: Affine",
}  # fmt: skip


@pytest.mark.parametrize("name", TEXTS)
def test_a_damaged_transform_ends_no_process_but_its_own(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.tfm"
    path.write_text(TEXTS[name])
    with pytest.raises((AnatomyError, FileError), match=r"a\.tfm"):
        read_transform(path, GRID)


@pytest.mark.parametrize("moved_mm", [1e160, float("inf"), 0.0])
def test_transforms_that_move_no_lung_are_refused(tmp_path: Path, moved_mm: float) -> None:
    transform = SimpleITK.TranslationTransform(3, (moved_mm, 0.0, 0.0))
    SimpleITK.WriteTransform(transform, str(tmp_path / "a.tfm"))
    with pytest.raises((AnatomyError, FileError)):
        read_transform(tmp_path / "a.tfm", GRID)


def test_an_empty_transform_is_no_lung_that_stands_still(tmp_path: Path) -> None:
    SimpleITK.WriteTransform(SimpleITK.CompositeTransform(3), str(tmp_path / "a.tfm"))
    with pytest.raises((AnatomyError, FileError)):
        read_transform(tmp_path / "a.tfm", GRID)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_fields_with_one_absurd_number_are_refused(tmp_path: Path, value: float) -> None:
    vectors = np.ones((5, 5, 5, 3))
    vectors[2, 2, 2, 1] = value
    write_vectors(tmp_path / "a.nrrd", GRID, vectors)
    with pytest.raises(AnatomyError, match="displacements"):
        read_vectors(tmp_path / "a.nrrd")


SCENE = (
    '<MRML><MarkupsFiducial id="p" name="a" references="storage:s;"/>'
    '<MarkupsFiducialStorage id="s" fileName="{}"/></MRML>'
)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA, zipfile.ZIP_DEFLATED])
def test_a_member_that_unpacks_to_more_than_it_says_is_refused(tmp_path: Path, method: int) -> None:
    path = tmp_path / "a.mrb"
    with zipfile.ZipFile(path, "w", method) as bundle:
        bundle.writestr("s/a.mrml", SCENE.format("p.mrk.json"), compress_type=zipfile.ZIP_DEFLATED)
        bundle.writestr("s/p.mrk.json", " " * (1 << 29 if method == zipfile.ZIP_DEFLATED else 1 << 20))
    with pytest.raises(FileError, match=r"no p\.mrk\.json of a readable size"):
        read_markups(path)


def test_a_scene_reads_no_file_elsewhere(tmp_path: Path) -> None:
    (tmp_path / "secret.mrk.json").write_text("no markups, so that who reads it fails")
    (tmp_path / "s").mkdir()
    for name in ("../secret.mrk.json", str(tmp_path / "secret.mrk.json")):
        (tmp_path / "s" / "a.mrml").write_text(SCENE.format(name))
        assert not read_markups(tmp_path / "s" / "a.mrml")

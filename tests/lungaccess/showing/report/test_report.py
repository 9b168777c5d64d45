"""Tests of the pictures: left is left, curves agree with the plan, files are whole."""

from __future__ import annotations

import csv
import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anatomy.base.errors import FileError
from anatomy.grid import Grid, Volume
from anatomy.store import open_lung
from lungaccess.judging.appraisal import Appraisal, limits_of
from lungaccess.problem.request import goal_of
from lungaccess.showing import report
from lungaccess.showing.report import views
from lungaccess.showing.report.key_numbers import key_numbers
from lungaccess.showing.report.layers import Footprint, Layers
from tests.anatomy.toys import toy as anatomy_toy
from tests.lungaccess.appraisals import make_check, make_risk

PNG = b"\x89PNG\r\n\x1a\n"


def _size(path: Path) -> tuple[int, int]:
    header = path.read_bytes()[:24]
    assert header[:8] == PNG
    return int.from_bytes(header[16:20], "big"), int.from_bytes(header[20:24], "big")


# Orientation -------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", [views.AXIAL, views.CORONAL])
def test_the_patients_left_is_on_the_right_of_the_picture(view: views.View) -> None:
    left, right = np.array([50.0, 3.0, -7.0]), np.array([-50.0, 3.0, -7.0])
    assert view.project(left)[0] > view.project(right)[0]
    assert view.edge_letters()[:2] == ("R", "L")


def test_anterior_is_at_the_top_of_the_axial_view() -> None:
    sternum, spine = np.array([0.0, -90.0, 0.0]), np.array([0.0, 90.0, 0.0])
    assert views.AXIAL.project(sternum)[1] > views.AXIAL.project(spine)[1]
    assert views.AXIAL.edge_letters()[2:] == ("P", "A")


@pytest.mark.parametrize("view", [views.CORONAL, views.SAGITTAL])
def test_the_head_is_at_the_top_of_the_upright_views(view: views.View) -> None:
    assert view.project([0.0, 0.0, 100.0])[1] > view.project([0.0, 0.0, -100.0])[1]
    assert view.edge_letters()[2:] == ("I", "S")


def test_the_axial_view_is_seen_from_the_feet_and_the_sagittal_from_the_left() -> None:
    np.testing.assert_allclose(views.AXIAL.towards_viewer, [0, 0, -1])
    np.testing.assert_allclose(views.CORONAL.towards_viewer, [0, -1, 0])
    np.testing.assert_allclose(views.SAGITTAL.towards_viewer, [1, 0, 0])


def test_the_left_lung_of_the_masks_lies_on_the_right_of_the_footprint(toy_lung: Any) -> None:
    """The nodule of the toy patient is in the left lung: its pixels must be there too."""
    for view in (views.AXIAL, views.CORONAL):
        footprint = Layers(toy_lung).footprint("nodule", view)
        assert footprint is not None
        left, right, bottom, top = footprint.extent_mm
        rows, columns = np.nonzero(footprint.thickness_mm)
        shape = footprint.thickness_mm.shape
        u = left + (columns + 0.5) * (right - left) / shape[1]
        v = bottom + (rows + 0.5) * (top - bottom) / shape[0]
        expected = view.project([92.0, -16.0, -8.0])
        np.testing.assert_allclose([u.mean(), v.mean()], expected, atol=0.5)


def test_a_footprint_does_not_depend_on_the_order_of_the_voxel_axes() -> None:
    """The same box stored in another axis order and direction casts the same shadow."""
    array = np.zeros((6, 8, 10), dtype=bool)
    array[1:4, 2:7, 5:9] = True
    straight = Grid.from_spacing(array.shape, [1.0, 1.5, 2.0], [10.0, -20.0, 30.0])
    matrix = straight.lps_from_ijk[:, [2, 0, 1, 3]] @ np.diag([1.0, -1.0, -1.0, 1.0])
    matrix[:3, 3] = straight.lps([5, 7, 0])
    turned = Grid(shape=(10, 6, 8), lps_from_ijk=matrix)
    other = array.transpose(2, 0, 1)[:, ::-1, ::-1]
    for view in views.STANDARD:
        a, b = (
            Layers(_only_nodule(grid, values)).footprint("nodule", view)
            for grid, values in ((straight, array), (turned, other))
        )
        assert a is not None and b is not None
        np.testing.assert_allclose(a.extent_mm, b.extent_mm)
        np.testing.assert_allclose(a.thickness_mm, b.thickness_mm)


def _only_nodule(grid: Grid, array: np.ndarray) -> Any:
    nothing = Volume(grid=grid, array=np.zeros(array.shape, dtype=np.bool_))
    nodules = Volume(grid=grid, array=array)
    return SimpleNamespace(
        grid=grid,
        folder=None,
        has_fissures=False,
        nodules=nodules,
        mask=lambda name: nodules if name == "nodule" else nothing,
    )


def test_the_thickness_of_a_box_is_its_depth() -> None:
    array = np.zeros((6, 8, 10), dtype=bool)
    array[1:4, 2:7, 5:9] = True
    grid = Grid.from_spacing(array.shape, [1.0, 1.5, 2.0], [0.0, 0.0, 0.0])
    footprint = Layers(_only_nodule(grid, array)).footprint("nodule", views.AXIAL)
    assert footprint is not None
    assert footprint.thickness_mm.max() == pytest.approx(4 * 2.0)
    area = (footprint.thickness_mm > 0).sum() * 1.0 * 1.5
    assert area == pytest.approx(3 * 1.0 * 5 * 1.5)


directions = st.lists(st.floats(-1, 1), min_size=9, max_size=9).map(lambda v: np.array(v).reshape(3, 3))


@given(directions)
def test_a_plane_view_is_orthonormal_and_upright(points: np.ndarray) -> None:
    if np.linalg.norm(points - points.mean(axis=0)) < 1e-3:
        return
    view = views.plane_view(points, "cut")
    frame = np.stack([view.right, view.up, view.towards_viewer])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    # It never turns its back on the standard view it is nearest to.
    assert max(view.towards_viewer @ standard.towards_viewer for standard in views.STANDARD) > 0.5


def test_a_cut_beyond_the_image_is_outside(toy_lung: Any) -> None:
    far = np.array([[500.0, 0.0, 0.0], [60.0, 0.0, 20.0]])
    layers = Layers(toy_lung)
    assert layers.cut("outside", far).tolist() == [True, False]
    assert layers.cut("lung", far).tolist() == [False, True]


def test_kept_projections_are_those_of_the_masks(tmp_path: Path) -> None:
    lung = open_lung({"lung.nii.gz": "a" * 64}, anatomy_toy, cache=tmp_path)
    for _ in range(2):  # The second time they come from the cache.
        for name, view in itertools.product(("lung", "vessel", "airway"), views.STANDARD):
            stored, made = (Layers(each).footprint(name, view) for each in (lung, replace(lung)))
            assert stored is not None and made is not None and stored.extent_mm == made.extent_mm
            np.testing.assert_array_equal(stored.thickness_mm, made.thickness_mm)
            volume = made.thickness_mm.sum() * _pixel_area(made)
            mask = lung.mask(name).array
            assert volume == pytest.approx(np.count_nonzero(mask) * lung.grid.voxel_volume_mm3)
    assert lung.folder is not None and (lung.folder / "projections.json").is_file()


def _pixel_area(footprint: Footprint) -> float:
    left, right, bottom, top = footprint.extent_mm
    return (right - left) * (top - bottom) / footprint.thickness_mm.size


# Files -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_overview_is_a_whole_picture(toy_plan: Any, toy_lung: Any, tmp_path: Path) -> None:
    path = report.overview_png(toy_plan, toy_lung, tmp_path / "overview.png")
    width, height = _size(path)
    assert width > 2000 and height > 1200
    assert [file.name for file in path.parent.iterdir()] == ["overview.png"]


def test_missing_fissures_and_nodule_are_no_obstacle(toy_plan: Any, bare_lung: Any, tmp_path: Path) -> None:
    assert _size(report.overview_png(toy_plan, bare_lung, tmp_path / "overview.png")) > (2000, 1200)


def test_the_tree_is_drawn(toy_lung: Any, tmp_path: Path) -> None:
    assert _size(report.tree_png(toy_lung, tmp_path / "tree.png")) > (1500, 500)


def test_the_key_numbers_state_target_in_both_frames_and_every_distance(toy_plan: Any, toy_lung: Any) -> None:
    rows = {label: value for _, block in key_numbers(toy_plan, toy_lung) for label, value in block}
    x, y, z = toy_plan.target_lps
    assert rows["target, LPS mm"] == f"{x:.1f}, {y:.1f}, {z:.1f}"
    assert rows["target, RAS mm"] == f"{-x:.1f}, {-y:.1f}, {z:.1f}"
    assert rows["place of the target"] == "left lower lobe"
    assert rows["pierced branch"].endswith(" (left lower lobe)")
    assert rows["needle to vessel"] == "1.60 / 1.00 mm"
    assert rows["needle to outside of the lung"] == "7.00 / 1.00 mm"
    assert not any("cost map" in label for label in rows)


def test_the_key_numbers_of_an_appraised_plan_are_those_of_its_check(toy_plan: Any, toy_lung: Any) -> None:
    report = make_check(accepted=True)
    made = Appraisal(check=report, risk=make_risk(10), limits=limits_of(report.findings, toy_plan))
    rows = {label: value for _, block in key_numbers(toy_plan, toy_lung, made) for label, value in block}
    assert rows["needle to vessel"] == "2.60 mm ≥ 1.00"
    assert "1.60" not in str(rows)


def _history() -> list[report.CostPoint]:
    costs = [None, 0.1 + 0.2, 0.25]
    return [report.CostPoint(elapsed_s=0.5 * n, iteration=10 * n, best=cost) for n, cost in enumerate(costs)]


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_cost_over_time_is_drawn_for_any_history(count: int, tmp_path: Path) -> None:
    path = report.cost_over_time_png(_history()[:count], tmp_path / "cost.png", goal_of("length"))
    assert _size(path) > (800, 400)


def test_cost_over_time_is_written_without_loss(tmp_path: Path) -> None:
    path = report.cost_over_time_csv(_history(), tmp_path / "cost.csv")
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["best"] for row in rows] == ["", repr(0.1 + 0.2), "0.25"]
    assert [int(row["iteration"]) for row in rows] == [0, 10, 20]


def test_a_failed_picture_leaves_the_old_one_alone(
    toy_lung: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(self: Any, path: Path, **_: Any) -> None:
        Path(path).write_bytes(PNG)
        raise OSError(28, "No space left on device")

    path = tmp_path / "tree.png"
    path.write_bytes(b"old")
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", full)
    with pytest.raises(FileError, match="No space left"):
        report.tree_png(toy_lung, path)
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["tree.png"]


def test_an_unwritable_folder_is_a_file_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(FileError, match="cannot be written"):
        report.cost_over_time_csv(_history(), tmp_path / "file" / "cost.csv")

"""Meshes for display: closed, outward, of a stated bound and of a sensible size."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from anatomy.base.errors import FileError
from anatomy.grid import Grid, Volume
from anatomy.lung import Lung
from anatomy.meshes import smooth_surface
from lungaccess.plans.plan import Plan
from lungaccess.showing.slicer.models import device_surface, merged, structure_surface, write_ply


def ball(radius_mm: float = 8.0) -> Volume:
    grid = Grid.from_spacing((24, 24, 24), (1.0, 1.0, 1.0), (-12.0, -12.0, -12.0))
    centres = grid.lps(np.stack(np.meshgrid(*[np.arange(24)] * 3, indexing="ij"), axis=-1))
    return Volume(grid=grid, array=np.linalg.norm(centres, axis=-1) < radius_mm)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_a_device_is_a_closed_tube_of_its_radius(number: int, toy_plan: Plan) -> None:
    curve = toy_plan.curves()[number]
    mesh = device_surface(curve).to_trimesh()
    assert mesh.is_watertight
    lengths, radii = np.diff(curve.arc_length_mm), np.asarray(curve.radius_mm)
    solid = np.pi * float((lengths * radii[1:] ** 2).sum())
    # A prism of 16 sides holds 97.4 % of its cylinder; positive: the faces look outwards.
    assert 0.94 * solid < mesh.volume < 1.01 * solid
    gap = np.linalg.norm(mesh.vertices[:, None, :] - curve.points_lps[None], axis=2).min(axis=1)
    assert gap.max() < radii.max() + 1e-6


@pytest.mark.parametrize("cell_mm", [1.5, 3.0])
def test_merging_keeps_the_stated_bound(cell_mm: float) -> None:
    fine = smooth_surface(ball())
    coarse = merged(fine, cell_mm)
    assert 4 < len(coarse.faces) < len(fine.faces)
    assert coarse.bound_mm == pytest.approx(fine.bound_mm + cell_mm * np.sqrt(3.0))
    from_true = np.abs(np.linalg.norm(coarse.vertices_lps, axis=1) - 8.0)
    assert from_true.max() <= coarse.bound_mm + 1.0
    sizes = {tuple(sorted(face)) for face in coarse.faces.tolist()}
    assert len(sizes) == len(coarse.faces) and all(len(set(face)) == 3 for face in sizes)
    assert coarse.to_trimesh().volume == pytest.approx(fine.to_trimesh().volume, rel=0.25)


@pytest.mark.parametrize("most", [400, 3000])
def test_structures_keep_to_the_size_asked(most: int, small_lung: Lung) -> None:
    mesh = structure_surface(small_lung, "lung", most=most)
    assert mesh is not None
    assert 0.1 * most < len(mesh.faces) <= most


def test_what_is_not_there_has_no_surface(small_lung: Lung) -> None:
    assert structure_surface(replace(small_lung, nodules=None), "nodule") is None


def test_ply_is_read_by_another_library(tmp_path: Path) -> None:
    mesh = smooth_surface(ball())
    write_ply(tmp_path / "ball.ply", mesh)
    read = trimesh.load(tmp_path / "ball.ply", process=False)
    assert np.allclose(read.vertices, mesh.vertices_lps, atol=1e-5)
    assert np.array_equal(read.faces, mesh.faces)
    with pytest.raises(FileError, match="ply"):
        write_ply(tmp_path / "ball.stl", mesh)


def test_vtk_finds_the_frame_where_3d_slicer_looks_for_it(tmp_path: Path, small_lung: Lung) -> None:
    io_ply = pytest.importorskip("vtkmodules.vtkIOPLY", reason="VTK is not installed")
    io_xml = pytest.importorskip("vtkmodules.vtkIOXML")
    from anatomy.io.centerlines import write_centerlines

    write_ply(tmp_path / "ball.ply", smooth_surface(ball()))
    reader = io_ply.vtkPLYReader()
    reader.SetFileName(str(tmp_path / "ball.ply"))
    reader.Update()
    comments = [reader.GetComments().GetValue(n) for n in range(reader.GetComments().GetNumberOfValues())]
    assert "SPACE=LPS" in comments
    write_centerlines(tmp_path / "tree.vtp", small_lung.tree)
    tree = io_xml.vtkXMLPolyDataReader()
    tree.SetFileName(str(tmp_path / "tree.vtp"))
    tree.Update()
    assert tree.GetOutput().GetFieldData().GetAbstractArray("SPACE").GetValue(0) == "LPS"
    radius = tree.GetOutput().GetPointData().GetArray("Radius")
    assert radius.GetNumberOfTuples() == small_lung.tree.n_points
    assert tree.GetOutput().GetPoint(0) == pytest.approx(small_lung.tree.points_lps[0].tolist(), abs=1e-4)

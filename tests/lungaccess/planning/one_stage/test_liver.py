"""A liver: what the needle and the routes do without airways, and what they say."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from anatomy.grid import Grid, Volume
from anatomy.io import write_volume
from anatomy.liver import ENTRY_BRANCH, with_entry
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, BRANCH_SHIFT, OUTSIDE, VESSEL
from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.planning.one_stage import open_source, plan_needle
from lungaccess.problem import load_organ, load_system, resolve_target

GRID = Grid.from_spacing((60, 50, 40), [1.0, 1.0, 1.0], [-30.0, -25.0, -20.0])
POINTS = GRID.lps(np.stack(np.meshgrid(*map(np.arange, GRID.shape), indexing="ij"), axis=-1))


def tube(a: tuple[float, ...], b: tuple[float, ...], radius_mm: float) -> np.ndarray:
    start, axis = np.array(a, float), np.array(b, float) - a
    t = np.clip(((POINTS - start) @ axis) / (axis @ axis), 0, 1)
    return np.linalg.norm(POINTS - start - t[..., None] * axis, axis=-1) <= radius_mm


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An ellipsoid of 48 x 40 x 32 mm with a vein across the straight way from start to target."""
    folder = tmp_path_factory.mktemp("livers") / "Patient1"
    folder.mkdir()
    liver = ((POINTS / [24.0, 20.0, 16.0]) ** 2).sum(axis=-1) < 1
    nodule = np.linalg.norm(POINTS - [16, 0, 0], axis=-1) < 3
    masks = {
        "hepaticVein": tube((0, -18, 1.5), (0, 18, 1.5), 2.0),
        "portalVein": tube((8, 6, -10), (8, 6, 10), 2.0) | tube((8, 6, 0), (14, 12, 4), 1.8),
        "hepaticArtery": tube((-8, -10, -6), (-8, -4, -6), 1.2),
        "nodule": nodule,
    }
    write_volume(folder / "liver.nii.gz", Volume(grid=GRID, array=liver & ~nodule))
    for name, mask in masks.items():
        write_volume(folder / f"{name}.nii.gz", Volume(grid=GRID, array=mask))
    # RAS: the start lies on the patient's right surface, at LPS x = -24.3, and looks to the left.
    (folder / "start1.txt").write_text("0 0 -1 24.3\n1 0 0 0\n0 -1 0 0\n0 0 0 1\n")
    (folder / "target.txt").write_text("-16 0 0\n")
    return folder


def test_a_liver_is_free_tissue_with_vessels_as_obstacles(folder):
    organ = load_organ(folder)
    assert not isinstance(organ, Lung) and organ.start_names == ("start1",)
    assert organ.label_at(np.array([0.0, 5, 1.5])) == VESSEL
    assert organ.label_at(organ.targets_lps[0]) == 0, "the nodule belongs to the liver"
    assert organ.label_at(organ.starts[0][:3, 3]) & OUTSIDE


def test_the_surface_is_a_wall_around_the_start_and_stays_outside_elsewhere(folder):
    organ = load_organ(folder)
    start = organ.starts[0][:3, 3]
    opened = with_entry(organ, start, 4.0)
    entry = AIRWAY | ((ENTRY_BRANCH + 1) << BRANCH_SHIFT)
    assert opened.label_at(start) == entry and opened.label_at(start - [1, 0, 0]) == entry
    assert opened.label_at(np.array([24.6, 0, 0])) & OUTSIDE
    changed = np.argwhere(opened.labels != organ.labels)
    assert (np.linalg.norm(organ.grid.lps(changed) - start, axis=1) <= 4.0 + 0.87).all()
    # The same voxels are obstacles as before: only their names differ.
    for name in ("vessel", "obstacle"):
        assert (opened.fields[name].corners == organ.fields[name].corners).all()


@pytest.mark.parametrize("planner", ["decide", "optimal"])
def test_the_needle_goes_from_the_published_start_around_the_vein(folder, planner):
    organ = load_organ(folder)
    system = load_system("flexure-needle")
    target = resolve_target(organ, "target")
    answer = plan_needle(organ, system, organ.starts[0], target, planner=planner, iterations=20_000)
    assert answer.path is not None and answer.branches == (ENTRY_BRANCH,)
    needed = system.needle.radius_mm + system.margins.total_mm
    points, _tangents = answer.path.sample(0.25)
    assert (organ.exact_clearance_mm(points, VESSEL, cap_mm=5.0) >= needed - 1e-9).all()
    assert np.linalg.norm(points[-1] - target.lps_mm) < 1e-6


def test_a_start_far_outside_has_no_entry(folder):
    organ = load_organ(folder)
    far = organ.starts[0].copy()
    far[:3, 3] = organ.grid.lps((1, 1, 1))
    answer = plan_needle(
        organ, load_system("thin-scope"), far, resolve_target(organ, "target"), iterations=500
    )
    assert answer.path is None


def test_routes_run_in_the_vessel_that_is_named(folder, tmp_path, capsys):
    words = ["route", str(folder), "--goal", "target", "--curvature", "0.3", "--tolerance", "1"]
    assert cli.main([*words, "--out", str(tmp_path)]) == ExitCode.BAD_INPUT
    assert "--lumen hepatic-vein" in " ".join(capsys.readouterr().err.split())
    out = ["--out", str(tmp_path), "--lumen", "portal-vein"]
    assert cli.main([*words, *out]) == ExitCode.OK
    written = json.loads((tmp_path / "route.json").read_text())
    assert written["proved"] and written["kind"] == "liver"
    end = np.array(written["points_lps_mm"][-1])
    assert np.linalg.norm(end - [8, 6, 0]) < 3.0, "where the vein is nearest to the target"


def test_a_named_place_is_the_nearest_in_the_lumen(folder):
    opened = open_source(folder, lumen="hepatic-vein")
    assert abs(opened.place("start1")[0]) < 1.5
    assert opened.place("lps:1,2,3").tolist() == [1.0, 2.0, 3.0]


def test_the_commands_of_lungs_refuse_a_liver_in_words(folder, tmp_path, capsys):
    for words in (["plan", str(folder), "--nodule", "--out", str(tmp_path)], ["reach", str(folder)]):
        assert cli.main(words) == ExitCode.BAD_INPUT
        said = " ".join(capsys.readouterr().err.replace("│", " ").split())
        assert "is a liver of Med-RAD" in said


def test_info_shows_and_draws_a_liver(folder, tmp_path, capsys):
    assert cli.main(["info", str(folder), "--out", str(tmp_path)]) == ExitCode.OK
    shown = capsys.readouterr().out
    assert "inside the liver" in shown and "start1" in shown
    assert (tmp_path / "organ.png").read_bytes().startswith(b"\x89PNG")
    assert cli.main(["info", str(folder), "--json"]) == ExitCode.OK
    record = json.loads(capsys.readouterr().out)
    assert record["target_names"] == ["target"] and "tree" not in record


def test_the_needle_command_takes_names(folder, capsys):
    words = ["needle", str(folder), "--start", "start1", "--target", "target", "--system", "flexure-needle"]
    assert cli.main([*words, "--iterations", "20000"]) == ExitCode.OK
    assert "the surface of the organ" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
@pytest.mark.data
def test_the_published_start_of_a_liver_has_a_needle(data_dir):
    organ = load_organ(data_dir / "med-rad-liver" / "Patient1")
    system = load_system("med-rad-needle")
    target = resolve_target(organ, "target")
    answer = plan_needle(organ, system, organ.starts[0], target, iterations=200_000)
    assert answer.path is not None

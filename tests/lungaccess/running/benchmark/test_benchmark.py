"""Published queries: posed, run, tabulated and compared with recorded results."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from anatomy.base.errors import FileError
from anatomy.phantom import Phantom, write_phantom
from anatomy.poses import pose
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.planning.one_stage import search_path
from lungaccess.running.benchmark.published import (
    NO_STARTS,
    UNC_GOAL_TOLERANCE_MM,
    patients_of,
    published_queries,
    read_peer,
    why_no_query,
)
from lungaccess.running.benchmark.runs import BenchmarkRow, posed_by_unc, run_query, summary_rows, write_rows
from stages.needle import ArcPath

RUN = {
    "patient": 1, "start": 1, "planner": "rrt", "radius_mm": 50, "threads": 1, "start_exemption_mm": 3,
    "valid_problem": True, "solved": True, "first_cpu_s": 0.001, "length_end_mm": 20.0, "goal_error_mm": 0.5,
}  # fmt: skip


def peer_file(folder: Path, *runs: dict[str, object]) -> Path:
    path = folder / "peer.json"
    path.write_text(json.dumps({"runs": [RUN | run for run in runs]}))
    return path


def test_the_peer_s_best_kind_is_that_which_solves_most_and_then_soonest(tmp_path: Path) -> None:
    path = peer_file(
        tmp_path, {}, {"solved": False}, {"planner": "rcs", "first_cpu_s": 0.002},
        {"planner": "star", "first_cpu_s": 0.003}, {"threads": 2, "planner": "threads"},
        {"start_exemption_mm": 5, "planner": "wide"}, {"start": 2, "valid_problem": False, "solved": False},
    )  # fmt: skip
    found = read_peer(path)
    best = found[1, 1, 50.0]
    assert (best.planner, best.runs, best.solved, best.first_cpu_ms, best.length_mm) == (
        "rcs",
        1,
        1,
        2.0,
        20.5,
    )
    assert found[1, 2, 50.0].refused and found.keys() == {(1, 1, 50.0), (1, 2, 50.0)}


@pytest.mark.parametrize("text", ["", "{", "[]", '{"runs": [{}]}', '{"runs": 3}'])
def test_what_holds_no_recorded_results_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "peer.json"
    path.write_text(text)
    with pytest.raises(FileError, match="holds no recorded results"):
        read_peer(path)
    with pytest.raises(FileError, match="holds no recorded results"):
        read_peer(tmp_path / "none.json")


def test_patients_come_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for name in ("Patient10", "Patient2"):
        (tmp_path / name).mkdir()
    assert [path.name for path in patients_of(tmp_path)] == ["Patient2", "Patient10"]
    (tmp_path / "Patient2" / "lung.nii.gz").touch()
    assert patients_of(tmp_path / "Patient2") == [tmp_path / "Patient2"]
    for folder in (tmp_path / "Patient10", tmp_path / "none"):
        with pytest.raises(FileError):
            patients_of(folder)


@pytest.mark.slow
def test_by_the_rules_of_unc_paths_keep_from_voxel_centres(small_phantom: Phantom) -> None:
    """Every path from the phantom's airway is resampled and measured to every obstacle voxel's centre."""
    images = small_phantom.images
    centre = small_phantom.nodules[0].centre_lps
    lumen = images.grid.lps(np.argwhere(images.lumen.array))
    starts = [lumen[i] for i in np.argsort(np.linalg.norm(lumen - centre, axis=1))[:4000:200]]
    images = replace(
        images, starts=tuple(pose(p, centre - p) for p in starts), targets_lps=(np.asarray(centre),)
    )
    solid = images.lumen.array | images.vessels.array | ~images.lung.array
    centres = images.grid.lps(np.argwhere(solid))
    needed = 1.0 + 0.5 * float(np.linalg.norm(images.grid.spacing_mm))
    solved = 0
    ask = posed_by_unc(images)
    for published in published_queries(images, "phantom"):
        environment, query = ask(published, 30.0)
        for planner in ("rrt", "decide"):
            found = search_path(environment, query, planner, iterations=2000)
            if found.path is None:
                assert found.obstruction is not None or not found.proved
                continue
            solved += 1
            points, _lengths = found.path.sample(0.05)
            far = np.linalg.norm(centres - published.lps_from_start[:3, 3], axis=1) > 3.0
            assert cKDTree(centres[far]).query(points)[0].min() >= needed - 1e-9
            assert np.linalg.norm(points[-1] - query.target) <= UNC_GOAL_TOLERANCE_MM
            assert found.path.accumulated_turn_rad <= np.radians(90.0) + 1e-9
    assert solved > 2


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(("number", "every"), [(1, 1), (2, 1), (2, 4)])
def test_published_queries_agree_with_the_recorded_peer(data_dir: Path, number: int, every: int) -> None:
    """What the peer solves is solved, what it refuses is proved to have no path; paths are resampled."""
    from anatomy.io.med_rad import load_med_rad

    images = load_med_rad(data_dir / "med-rad" / f"Patient{number}")
    recorded = read_peer(data_dir / "needle" / "easy_peer.json")
    solid = images.lumen.array | images.vessels.array | ~images.lung.array
    edge = solid.copy()
    for axis in range(3):
        for step in (-1, 1):
            edge &= np.roll(solid, step, axis)
    centres = images.grid.lps(np.argwhere(solid & ~edge))
    needed = 1.0 + 0.5 * float(np.linalg.norm(images.grid.spacing_mm))
    ask = posed_by_unc(images)
    for published in published_queries(images, f"Patient{number}")[::every]:
        far = np.linalg.norm(centres - published.lps_from_start[:3, 3], axis=1) > 3.0
        for radius in (50.0, 100.0, 121.0):
            peer = recorded[number, published.start, radius]
            environment, query = ask(published, radius)
            found = search_path(environment, query, "decide", iterations=20_000)
            assert found.path is not None or not peer.solved
            if found.path is None:
                assert found.obstruction is not None
                assert found.proved or not peer.refused
                continue
            points, _lengths = found.path.sample(0.05)
            assert cKDTree(centres[far]).query(points)[0].min() >= needed - 1e-9
            assert np.linalg.norm(points[-1] - query.target) <= UNC_GOAL_TOLERANCE_MM + 1e-9


def test_rows_of_seeds_become_one_line_with_the_peer_beside(tmp_path: Path) -> None:
    def row(seed: int, **values: object) -> BenchmarkRow:
        return replace(
            BenchmarkRow(patient="Patient1", start=1, target=1, radius_mm=50.0, planner="rrt", seed=seed),
            **values,  # type: ignore[arg-type]
        )

    rows = [
        row(0, solved=True, first_cpu_ms=1.0, first_length_mm=21.0, length_mm=20.0, clearance_mm=1.2),
        row(1, solved=True, first_cpu_ms=3.0, first_length_mm=23.0, length_mm=20.4, clearance_mm=1.1),
        row(2, reason="path blocked by a vessel: 0.10 mm away, needs 1.00 mm (not proved)"),
        BenchmarkRow(patient="Patient2", reason=NO_STARTS),
    ]
    headings, lines = summary_rows(rows, read_peer(peer_file(tmp_path, {})))
    first = dict(zip(headings, lines[0], strict=True))
    assert first["solved"] == "2/3" and first["first, ms"] == "2.00" and first["final, mm"] == "20.20"
    assert first["clearance, mm"] == "1.10" and first["peer solved"] == "1/1 rrt"
    assert "not proved" in first["reason"]
    assert lines[1][0] == "Patient2" and lines[1][-1] == NO_STARTS
    assert len(summary_rows(rows, None)[0]) == len(headings) - 3


def test_a_query_that_is_ruled_out_is_answered_once(small_phantom: Phantom) -> None:
    images = small_phantom.images
    centre = np.asarray(small_phantom.nodules[0].centre_lps)
    lumen = images.grid.lps(np.argwhere(images.lumen.array))
    start = lumen[np.argmin(np.linalg.norm(lumen - centre, axis=1))]
    images = replace(images, starts=(pose(start, start - centre),), targets_lps=(centre,))
    assert not why_no_query(images) and why_no_query(replace(images, starts=())) == NO_STARTS
    published = published_queries(images, "phantom")[0]
    asked = posed_by_unc(images)(published, 50.0)
    rows = list(run_query(*asked, published, 50.0, ("rrt", "decide"), range(2), 0.1))
    assert len(rows) == 1 and not rows[0].planner and "target out of reach" in rows[0].reason


@pytest.mark.slow
def test_command(small_phantom: Phantom, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = tmp_path / "patients" / "Patient1", tmp_path / "runs.csv"
    write_phantom(small_phantom, folder)
    (tmp_path / "patients" / "Patient2").mkdir()
    command = ["benchmark", "med-rad", str(tmp_path / "patients"), "--out", str(out), "--budget", "0.05"]
    command += ["--cache", str(tmp_path / "cache"), "--planners", "rrt", "--seeds", "1"]
    main(command)
    shown = capsys.readouterr().out
    assert "not read" in shown and "Patient1" in shown
    with out.open() as stream:
        assert {row["patient"] for row in csv.DictReader(stream)} == {"Patient1", "Patient2"}
    assert main([*command, "--json"]) in (ExitCode.OK, ExitCode.NEGATIVE)
    assert json.loads(capsys.readouterr().out)["rules"] == "ours"
    for wrong in (["--planners", "best"], ["--radius", "x"], ["--out", "runs.txt"], ["--budget", "-1"]):
        assert main([*command, *wrong]) == ExitCode.BAD_INPUT


def test_a_start_that_names_its_target_is_asked_with_it_alone() -> None:
    start, points = np.eye(4), tuple(np.full(3, float(n)) for n in (1.0, 2.0))
    names = ("target1_start1", "nodule2_start1", "start3")
    patient = SimpleNamespace(
        starts=(start,) * 3, start_names=names, targets_lps=points, target_names=("target1", "target2")
    )
    asked = [(query.start, query.target) for query in published_queries(patient, "toy")]  # type: ignore[arg-type]
    assert asked == [(1, 1), (2, 2), (3, 1), (3, 2)]


def test_files_of_runs_hold_the_paths_where_they_can(tmp_path: Path) -> None:
    arcs = np.array([[10.0, 0.3, 0.01], [5.0, -1.0, 0.0]])
    path = ArcPath(lps_from_start=np.eye(4), arcs=arcs)
    rows = [
        BenchmarkRow(patient="P", start=1, target=1, solved=True, arcs=tuple(path.arc_records())),
        BenchmarkRow(patient="P", start=1, target=2, reason="blocked"),
    ]
    for name in ("runs.json", "runs.csv"):
        write_rows(rows, tmp_path / name)
    solved, blocked = json.loads((tmp_path / "runs.json").read_text())["runs"]
    kept = [[arc["length_mm"], arc["roll_rad"], arc["curvature_per_mm"]] for arc in solved["arcs"]]
    assert np.array_equal(ArcPath(lps_from_start=np.eye(4), arcs=np.array(kept)).frames(), path.frames())
    assert blocked["arcs"] == []
    with open(tmp_path / "runs.csv", newline="", encoding="utf-8") as stream:
        table = list(csv.DictReader(stream))
    assert [row["reason"] for row in table] == ["", "blocked"]
    assert "arcs" not in table[0]

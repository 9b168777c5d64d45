"""The commands `route` and `tour`, end to end on small patients and drawings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import FileError, FrameError, SettingsError, TargetError
from anatomy.base.settings import override
from anatomy.io.centerlines import write_centerlines
from anatomy.lung import Lung
from anatomy.phantom import Phantom, write_phantom
from experiments.support.tour_models import random_airway
from lungaccess.cli.app import main
from lungaccess.planning import tour as tour_module
from lungaccess.planning.one_stage.route import open_source, read_drawing, widest_end
from lungaccess.planning.tour import coupled_plan_test, plan_tour, read_lesions, tour_record


@pytest.fixture(scope="module")
def tree_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("route") / "airway.vtp"
    write_centerlines(path, random_airway(3, orders=5))
    return path


def goal_text(path: Path) -> str:
    line = open_source(path).centreline
    far = line.nodes_mm[int(np.argmax(np.linalg.norm(line.nodes_mm - widest_end(line), axis=1)))]
    return "lps:" + ",".join(f"{x:.3f}" for x in far)


def test_route_along_a_centreline_file(tree_file: Path, tmp_path: Path) -> None:
    words = ["route", str(tree_file), "--goal", goal_text(tree_file), "--curvature", "0.08", "--radius", "1"]
    assert main([*words, "--tolerance", "0.5", "--out", str(tmp_path)]) == 0
    written = json.loads((tmp_path / "route.json").read_text())
    assert written["proved"]
    assert written["largest_curvature_per_mm"] <= 0.08
    assert written["least_wall_mm"] >= 1.0
    line = open_source(tree_file).centreline
    assert line.depth_mm(written["points_lps_mm"]).min() >= 1.0
    assert (tmp_path / "route.png").read_bytes()[:4] == b"\x89PNG"


def test_route_that_cannot_be_kept_ends_with_1_and_still_draws(tree_file: Path, tmp_path: Path) -> None:
    words = ["route", str(tree_file), "--goal", goal_text(tree_file), "--curvature", "0.0005"]
    assert main([*words, "--out", str(tmp_path)]) == 1
    assert not json.loads((tmp_path / "route.json").read_text())["proved"]
    assert (tmp_path / "route.png").exists()


def test_route_in_a_picture(tmp_path: Path) -> None:
    from skimage.io import imsave

    y, x = np.mgrid[:90, :160]
    drawing = np.abs(y - 45 - 12 * np.sin(x / 25.0)) < 9
    picture = tmp_path / "vessel.png"
    imsave(picture, np.where(drawing, 0, 255).astype(np.uint8), check_contrast=False)
    np.testing.assert_array_equal(read_drawing(picture), drawing)
    line = open_source(picture, pixel_mm=0.5).centreline
    ends = line.nodes_mm[np.flatnonzero(np.bincount(line.edges.ravel()) == 1)]
    a, b = ends[np.argmin(ends[:, 0])], ends[np.argmax(ends[:, 0])]
    points = ["lps:" + ",".join(f"{v:.3f}" for v in p) for p in (a, b)]
    words = ["route", str(picture), "--start", points[0], "--goal", points[1], "--curvature", "0.1"]
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert main([*words, "--pixel", "0.5", "--out", str(tmp_path / "out")]) == 0
    with pytest.raises(SettingsError, match="pixel"):
        open_source(picture)


@pytest.mark.parametrize(
    "words",
    [
        ["--goal", "1,2,3", "--curvature", "0.1"],
        ["--goal", "lps:999,0,0", "--curvature", "0.1"],
        ["--goal", "lps:0,0,-20", "--curvature", "-1"],
        ["--goal", "lps:0,0,-20", "--curvature", "0.1", "--seed", "-1"],
    ],
)
def test_bad_words_for_route_are_explained(tree_file: Path, tmp_path: Path, words: list[str]) -> None:
    assert main(["route", str(tree_file), *words, "--out", str(tmp_path)]) == 2


def test_lesions_are_read_with_their_frames(tmp_path: Path) -> None:
    file = tmp_path / "lesions.txt"
    file.write_text("# two\nlps:1,2,3\n\nras:1,2,3  # the other\n")
    np.testing.assert_array_equal(read_lesions(file), [(1, 2, 3), (-1, -2, 3)])
    file.write_text("1,2,3\n")
    with pytest.raises(FrameError):
        read_lesions(file)
    file.write_text("# none\n")
    with pytest.raises(FileError, match="0 lesions"):
        read_lesions(file)


def places(lung: Lung, count: int) -> np.ndarray:
    """Points in the lung tissue near the airway."""
    rng = np.random.default_rng(0)
    found = []
    while len(found) < count:
        place = lung.grid.lps(rng.uniform(0, np.array(lung.grid.shape) - 1))
        near = np.linalg.norm(lung.tree.points_lps - place, axis=1).min()
        if near < 25 and lung.fields["obstacle"].lower_bound_mm(place)[0] > 3:
            found.append(place)
    return np.array(found)


@pytest.mark.slow
def test_tour_of_a_patient(small_lung: Lung) -> None:
    lesions = places(small_lung, 5)
    answer = plan_tour(small_lung, lesions)
    assert answer.numbers == (1, 2, 3, 4, 5)
    assert not answer.left_out
    assert answer.least_resistance is not None
    assert answer.shortest.length_mm <= answer.least_resistance.length_mm <= answer.one_by_one_mm * 2
    written = json.loads(json.dumps(tour_record(answer)))
    total = sum(s["length_mm"] * s["passes"] for s in written["shortest"]["stretches"])
    assert total == pytest.approx(written["shortest"]["length_mm"])
    assert sorted(written["shortest"]["order"]) == [1, 2, 3, 4, 5]
    assert written["shortest"]["tree_points_in_order"][0] == 0


@pytest.mark.slow
def test_a_price_on_tissue_brings_exits_nearer(small_lung: Lung) -> None:
    lesions = places(small_lung, 5)
    free, costly = (plan_tour(small_lung, lesions, tissue_weight=w) for w in (0.0, 50.0))
    near, far = (sum(e.distance_mm for e in a.shortest.visits) for a in (costly, free))
    assert near < far
    assert free.shortest.length_mm < costly.shortest.length_mm
    assert costly.shortest.cost_mm == pytest.approx(costly.shortest.length_mm + 50.0 * near)


def test_a_lesion_out_of_reach_is_left_out_and_named(small_lung: Lung) -> None:
    corner = small_lung.grid.lps((1, 1, 1))
    answer = plan_tour(small_lung, np.vstack((corner, places(small_lung, 2))))
    assert answer.numbers == (2, 3)
    assert "has no exit" in answer.left_out[1]
    seen = len(answer.lesions_lps)
    assert answer.title == f"tour to {seen} of {seen + 1} lesions"
    with pytest.raises(TargetError, match="No lesion"):
        plan_tour(small_lung, corner)
    with pytest.raises(TargetError, match="outside the image"):
        plan_tour(small_lung, np.array([[9e3, 0.0, 0.0]]))


@pytest.mark.slow
def test_exits_of_a_tour_with_required_plans_have_a_coupled_plan(
    small_lung: Lung, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each exit of a tour with required plans is a site from where a proved plan leads to the lesion."""
    atlas = la.build_atlas(small_lung, la.load_system("thin-scope"), rotations=12, site_spacing_mm=3.0)
    candidates = places(small_lung, 40)
    for lesion in candidates:
        try:
            accepts = coupled_plan_test(atlas, lesion, 0)
        except la.NoPlan:
            continue
        good = [p for p in np.unique(atlas.motions.tree_point).tolist() if accepts(0, p)]
        if good:
            break
    else:
        pytest.fail("no lesion can be reached")
    answer = plan_tour(small_lung, lesion, atlas=atlas)
    assert answer.plan_required
    assert {e.tree_point for e in answer.subtree.exits} <= set(good)
    assert not accepts(0, 0)

    # Where no direct arc leads, the plans of the coupled planner are the exits.
    monkeypatch.setattr(tour_module, "_points_of_arcs", lambda *_: frozenset())
    searched = plan_tour(small_lung, lesion, atlas=atlas, iterations=3)
    for each in searched.subtree.exits:
        place = small_lung.tree.points_lps[each.tree_point]
        sites = small_lung.tree.points_lps[atlas.motions.tree_point]
        assert np.linalg.norm(sites - place, axis=1).min() < 5.0
    weak = override(la.load_system("thin-scope"), {"name": "weak", "needle.max_length_mm": 1.0})
    short = la.build_atlas(small_lung, weak, rotations=4, site_spacing_mm=20.0)
    with pytest.raises(TargetError, match="no plan was found in 2 iterations"):
        plan_tour(small_lung, lesion, atlas=short, iterations=2)


@pytest.mark.slow
def test_tour_command_writes_its_files(small_phantom: Phantom, small_lung: Lung, tmp_path: Path) -> None:
    folder = tmp_path / "patient"
    write_phantom(small_phantom, folder)
    file = tmp_path / "lesions.txt"
    file.write_text("\n".join("lps:" + ",".join(f"{x:.2f}" for x in p) for p in places(small_lung, 3)))
    words = [
        "tour",
        str(folder),
        "--targets",
        str(file),
        "--no-require-plan",
        "--cache",
        str(tmp_path / "cache"),
    ]
    assert main([*words, "--out", str(tmp_path / "out")]) == 0
    assert json.loads((tmp_path / "out" / "tour.json").read_text())["one_by_one_mm"] > 0
    assert (tmp_path / "out" / "tour.png").read_bytes()[:4] == b"\x89PNG"
    assert main([*words, "--speed", "0", "--out", str(tmp_path / "out")]) == 2

"""The reachability map against single arcs tried one by one; resuming; the frame of what is written."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import GridMismatchError, SettingsError
from anatomy.grid import Grid, Volume
from anatomy.io.images import read_volume
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, FISSURE, OBSTACLES, OUTSIDE
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.planning.coupled import direct_candidates, reach_scan
from lungaccess.planning.reachability.layers import (
    LEFT,
    RIGHT,
    _earlier_neighbours,
    lung_regions,
    voxel_seeds,
)
from lungaccess.planning.reachability.reach_map import (
    KINDS,
    NOT_COUNTED,
    ReachMap,
    compare_reach,
    map_reach,
    reach_grid,
)
from lungaccess.plans.assemble import assemble
from lungaccess.problem.task import Task
from stages.needle.environment import NeedleEnvironment, direct_arcs, needle_environment
from stages.needle.kernels import tree
from stages.needle.kernels.reach_arcs import DIRECT, NO_CLEARANCE, SEARCHED, UNREACHED
from stages.needle.kernels.reach_search import reach_by_search
from stages.needle.path import ArcPath, direct_path, path_from_tree
from stages.needle.reach import RANDOM_SHARE, RRT_ITERATIONS, ReachScan
from tests.stages.scenes import Canvas

SYSTEM = la.load_system("ultrathin")
SPACING_MM = 9.0
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def atlas(small_lung: Lung) -> la.Atlas:
    return la.build_atlas(small_lung, SYSTEM, rotations=12, stop_spacing_mm=4.0, site_spacing_mm=3.0)


@pytest.fixture(scope="module")
def environment(small_lung: Lung, atlas: la.Atlas) -> NeedleEnvironment:
    return needle_environment(small_lung, SYSTEM.needle, SYSTEM.margins, with_fissures=atlas.with_fissures)


@pytest.fixture(scope="module")
def reach(small_lung: Lung, atlas: la.Atlas) -> ReachMap:
    return map_reach(small_lung, SYSTEM, spacing_mm=SPACING_MM, atlas=atlas)


def arcs_to(
    environment: NeedleEnvironment, atlas: la.Atlas, point: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    entries = atlas.deployments
    blockers, _lengths, costs = direct_arcs(
        environment, entries.positions, entries.tangents, entries.branch, point
    )
    return blockers == 0, costs


def test_every_point_agrees_with_all_arcs_tried(
    reach: ReachMap, environment: NeedleEnvironment, small_lung: Lung, atlas: la.Atlas
) -> None:
    assert atlas.with_fissures
    ratios = []
    for ijk in np.argwhere(reach.kinds.array != NOT_COUNTED):
        point, kind = reach.kinds.grid.lps(ijk), reach.kinds.array[tuple(ijk)]
        clear, costs = arcs_to(environment, atlas, point)
        assert (kind == DIRECT) == clear.any()
        if clear.any():
            ratios.append(float(reach.cost.array[tuple(ijk)]) / costs[clear].min())
            continue
        assert kind in (UNREACHED, NO_CLEARANCE)
        room = small_lung.exact_clearance_mm(point, (OBSTACLES & ~AIRWAY) | FISSURE, cap_mm=2.0)[0]
        assert (kind == NO_CLEARANCE) == (room < environment.required_clearance_mm)
        assert reach.cost.array[tuple(ijk)] == reach.clearance_mm.array[tuple(ijk)] == 0.0
    assert min(ratios) >= 1.0 - 1e-6
    assert np.median(ratios) < 1.3
    assert len(ratios) > 100 and {UNREACHED, NO_CLEARANCE} <= set(reach.kinds.array.ravel().tolist())


def test_counted_is_free_lung_tissue(reach: ReachMap, small_lung: Lung) -> None:
    rng = np.random.default_rng(0)
    for ijk in rng.integers(0, reach.kinds.grid.shape, (300, 3)):
        label = small_lung.label_at(reach.kinds.grid.lps(ijk))
        free = label & (OBSTACLES | FISSURE) == 0
        assert (reach.kinds.array[tuple(ijk)] != NOT_COUNTED) == free


def test_the_clearance_is_kept(
    environment: NeedleEnvironment, small_lung: Lung, atlas: la.Atlas, reach: ReachMap
) -> None:
    from anatomy.poses import pose

    entries = atlas.deployments
    scan = ReachScan(environment, entries.positions, entries.tangents, entries.branch)
    points = reach.kinds.grid.lps(np.argwhere(reach.kinds.array == DIRECT))[:40]
    reached = scan.reach(points, np.zeros(len(points), dtype=np.uint64))
    assert (reached.kinds == DIRECT).all()
    for n, point in enumerate(points):
        entry = reached.entries[n]
        path = direct_path(pose(entries.positions[entry], entries.tangents[entry]), point)
        assert np.allclose(path.frames()[-1][:3, 3], point, atol=1e-6)
        sampled, lengths = path.sample(0.05)
        beyond = sampled[lengths >= min(SYSTEM.needle.exit_exemption_mm, path.length_mm)]
        gap = small_lung.exact_clearance_mm(beyond, OBSTACLES | FISSURE, cap_mm=6.0)
        assert reached.clearance_mm[n] <= gap.min() + 1e-6 or gap.min() >= 6.0 - 1e-9
        if path.length_mm > SYSTEM.needle.exit_exemption_mm + 1.0:
            assert reached.clearance_mm[n] >= environment.required_clearance_mm - 1.2


def test_points_of_a_cube_agree_with_each_alone(
    reach: ReachMap, environment: NeedleEnvironment, small_lung: Lung, atlas: la.Atlas
) -> None:
    entries, rng = atlas.deployments, np.random.default_rng(8)
    scan = ReachScan(environment, entries.positions, entries.tangents, entries.branch)
    kinds = reach.kinds.array
    for kind in (DIRECT, UNREACHED):
        for centre in rng.permutation(reach.kinds.grid.lps(np.argwhere(kinds == kind)))[:6]:
            points = centre + rng.uniform(-5.0, 5.0, (40, 3))
            seeds = np.zeros(len(points), dtype=np.uint64)
            together = scan.reach(points, seeds)
            alone = [scan.reach(point[None], seeds[:1]).kinds[0] for point in points]
            assert np.array_equal(together.kinds, alone)


@pytest.mark.slow
def test_a_search_only_adds(small_lung: Lung, atlas: la.Atlas) -> None:
    plain, searched, again = (
        map_reach(small_lung, SYSTEM, spacing_mm=12.0, atlas=atlas, trees=trees) for trees in (0, 1, 1)
    )
    gained = searched.kinds.array == SEARCHED
    assert gained.any()
    assert (plain.kinds.array[gained] == UNREACHED).all()
    assert np.array_equal(np.where(gained, UNREACHED, searched.kinds.array), plain.kinds.array)
    assert (searched.cost.array[gained] > 0.0).all() and (searched.clearance_mm.array[gained] > 0.0).all()
    assert np.array_equal(searched.cost.array, again.cost.array)
    assert searched.gained_and_lost_ml(plain) == (gained.sum() * 12.0**3 / 1000.0, 0.0)


def plan_to_voxel(reach: ReachMap, atlas: la.Atlas, ijk: np.ndarray) -> la.Plan:
    """Return the plan from the deployment that the map states, by the arcs that the map's search found."""
    entry, point = int(reach.deployment.array[tuple(ijk)]), reach.kinds.grid.lps(ijk)
    task = Task(lung=atlas.lung, system=reach.system, target=la.point_target(atlas.lung, point))
    arcs = direct_candidates(task, atlas)
    found = arcs.proved(entry)
    if reach.kinds.array[tuple(ijk)] == SEARCHED:
        made = arcs.candidate(entry)
        path = path_again(reach_scan(atlas, trees=reach.trees), reach.kinds.grid, ijk, made.deployment)
        assert arcs.evaluator.proves(made.deployment, path)
        found = replace(made, path=path)
    return assemble(task, found, iteration=0, timing={})


def path_again(scan: ReachScan, grid: Grid, ijk: np.ndarray, deployment: Any) -> ArcPath:
    rows, environment = RRT_ITERATIONS * tree.ROWS_PER_STEP, scan.environment
    nodes, parents = np.zeros((rows, tree.NODE_COLUMNS)), np.zeros(rows, dtype=np.int64)
    last = reach_by_search(
        environment.obstacles, environment.limits, scan._objective, scan._starts, scan._branches, scan._order,
        grid.lps(ijk)[None], scan.trees, RRT_ITERATIONS, RANDOM_SHARE, voxel_seeds(grid, ijk[None]), nodes,
        parents, np.zeros(scan.trees, dtype=np.int64), np.full(1, UNREACHED), np.zeros((1, 2)),
        np.full(1, -1),
    )  # fmt: skip
    return path_from_tree(deployment.lps_from_tip, nodes, parents, last)


@pytest.mark.parametrize(
    ("trees", "kind", "count"), [(0, DIRECT, 4), pytest.param(1, SEARCHED, 1, marks=pytest.mark.slow)]
)
def test_a_reachable_voxel_has_a_plan_that_the_checker_accepts(
    trees: int, kind: int, count: int, reach: ReachMap, small_lung: Lung, atlas: la.Atlas
) -> None:
    made = map_reach(small_lung, SYSTEM, spacing_mm=12.0, atlas=atlas, trees=trees) if trees else reach
    assert np.array_equal(made.deployment.array >= 0, made.reached)
    voxels = np.argwhere(made.kinds.array == kind)
    for ijk in np.random.default_rng(3).permutation(voxels)[:count]:
        plan = plan_to_voxel(made, atlas, ijk)
        assert la.check(plan, small_lung).accepted


class StoppedError(Exception):
    pass


def stop_at(share: float) -> Callable[[float], None]:
    def tell(done: float) -> None:
        if done >= share:
            raise StoppedError

    return tell


def test_a_stopped_run_goes_on(small_lung: Lung, atlas: la.Atlas, reach: ReachMap, tmp_path: Path) -> None:
    with pytest.raises(StoppedError):
        map_reach(
            small_lung, SYSTEM, spacing_mm=SPACING_MM, atlas=atlas, work=tmp_path, progress=stop_at(0.7)
        )
    layers = sorted(tmp_path.glob(".reach-*/layer-*.npz"))
    assert len(layers) > 3
    layers[0].write_bytes(layers[0].read_bytes()[:40])
    layers[1].write_bytes(b"")
    resumed = map_reach(small_lung, SYSTEM, spacing_mm=SPACING_MM, atlas=atlas, work=tmp_path)
    assert 0 < resumed.resumed_layers == len(layers) - 2
    for name in ("kinds", "cost", "clearance_mm", "deployment"):
        assert np.array_equal(getattr(resumed, name).array, getattr(reach, name).array)
    assert not list(tmp_path.glob(".reach-*"))


def test_another_question_does_not_go_on(small_lung: Lung, atlas: la.Atlas, tmp_path: Path) -> None:
    with pytest.raises(StoppedError):
        map_reach(small_lung, SYSTEM, spacing_mm=14.0, atlas=atlas, work=tmp_path, progress=stop_at(0.9))
    other = replace(atlas, system=replace(SYSTEM, needle=replace(SYSTEM.needle, max_length_mm=60.0)))
    begun = map_reach(small_lung, other.system, spacing_mm=14.0, atlas=other, work=tmp_path)
    assert begun.resumed_layers == 0
    assert list(tmp_path.glob(".reach-*/layer-*.npz"))


def test_a_known_voxel_is_where_it_was(reach: ReachMap, small_lung: Lung, tmp_path: Path) -> None:
    """The frame survives writing and reading, also of a lung whose axes point the other way."""
    written = reach.save(tmp_path, "map")
    names = [f"map{end}.nrrd" for end in ("", "-cost", "-clearance", "-deployment")]
    assert [path.name for path in written] == names
    volumes = (reach.kinds, reach.cost, reach.clearance_mm, reach.deployment)
    for path, volume in zip(written, volumes, strict=True):
        back = read_volume(path)
        assert np.allclose(back.grid.lps_from_ijk, reach.kinds.grid.lps_from_ijk, atol=1e-9)
        assert np.array_equal(back.array, volume.array) and back.array.dtype == volume.array.dtype
    ijk = np.argwhere(reach.kinds.array == DIRECT)[7]
    point = reach.kinds.grid.lps(ijk)
    back = read_volume(written[0])
    assert back.array[tuple(np.rint(back.grid.ijk(point)).astype(int))] == DIRECT
    assert small_lung.grid.contains(point)
    assert b"space: left-posterior-superior" in written[0].read_bytes()[:2000]


def test_the_grid_covers_the_lung(small_lung: Lung) -> None:
    turned = np.eye(4)
    turned[:3, :3] = np.array([[-0.6, 0.8, 0.0], [-0.8, -0.6, 0.0], [0.0, 0.0, 1.0]]) * [0.5, 0.7, 1.1]
    turned[:3, 3] = (30.0, -20.0, 5.0)
    box = Grid(shape=(41, 30, 23), lps_from_ijk=turned)
    lung: Any = type("Box", (), {"grid": box})
    for spacing in (3.0, 2.5):
        grid = reach_grid(lung, spacing)
        assert np.allclose(grid.spacing_mm, spacing)
        corners = np.array(np.meshgrid(*[(-0.5, n - 0.5) for n in box.shape])).reshape(3, -1).T
        index = grid.ijk(box.lps(corners))
        assert (index >= -0.5 - 1e-9).all() and (index <= np.array(grid.shape) - 0.5 + 1e-9).all()
        assert (np.array(grid.shape) * spacing < np.array(box.shape) * box.spacing_mm + spacing).all()
        assert np.allclose(grid.lps([-0.5] * 3), box.lps([-0.5] * 3))


def test_shares_add_up(reach: ReachMap) -> None:
    *sides, total = reach.by_region()
    assert [side.name for side in sides] == ["right lung", "left lung"]
    assert sum(total.shares) == pytest.approx(1.0)
    assert sum(side.volume_ml for side in sides) == pytest.approx(total.volume_ml)
    assert sum(side.volume_ml * side.reached for side in sides) == pytest.approx(
        total.volume_ml * total.reached
    )
    assert total.volume_ml == (reach.kinds.array > 0).sum() * SPACING_MM**3 / 1000.0
    assert 0.0 < total.median_clearance_mm < 50.0 and total.median_cost > 0.0


def test_left_is_left(reach: ReachMap, small_lung: Lung) -> None:
    assert reach.regions.lungs_are_separate
    codes = reach.regions.volume
    points = codes.grid.lps(np.argwhere(codes.array == LEFT))
    others = codes.grid.lps(np.argwhere(codes.array == RIGHT))
    carina = small_lung.tree.carina_lps[0]
    assert points[:, 0].mean() > carina > others[:, 0].mean()
    assert np.array_equal(codes.array > 0, reach.kinds.array > 0)


def test_one_lung_is_divided_at_the_carina() -> None:
    canvas = Canvas.empty([-20, -10, -10], [20, 10, 10], 1.0)
    lung = canvas.lung()
    regions = lung_regions(lung, lung.grid, (lung.labels & (OUTSIDE | AIRWAY)) == 0)
    assert not regions.lungs_are_separate
    left = lung.grid.lps(np.argwhere(regions.volume.array == LEFT))
    right = lung.grid.lps(np.argwhere(regions.volume.array == RIGHT))
    assert left[:, 0].min() > lung.tree.carina_lps[0] >= right[:, 0].max()


def test_lobes_are_regions_if_the_patient_has_them() -> None:
    canvas = Canvas.empty([-20, -10, -10], [20, 10, 10], 1.0)
    bare = canvas.lung()
    where = (bare.labels & (OUTSIDE | AIRWAY)) == 0
    upper = np.indices(bare.grid.shape)[2] >= 10
    array = np.asfortranarray(np.where(upper, 4, 5).astype(np.uint8))
    lung = canvas.lung(lobes=Volume(grid=bare.grid, array=array))
    parts = dict(lung_regions(lung, lung.grid, where).parts())
    assert (parts["left upper lobe"] == (where & upper)).all()
    assert (parts["left lower lobe"] == (where & ~upper)).all() and not parts["right upper lobe"].any()
    assert "left upper lobe" not in dict(lung_regions(bare, bare.grid, where).parts())


def test_neighbours_come_before() -> None:
    counted = np.random.default_rng(1).uniform(size=(9, 7, 3)) < 0.6
    places = np.argwhere(counted)
    for n, near in enumerate(_earlier_neighbours(counted)):
        for axis, other in enumerate(near):
            before = places[n] - np.eye(3, dtype=int)[axis]
            there = before.min() >= 0 and counted[tuple(before)]
            assert (other >= 0) == there
            if there:
                assert other < n and tuple(places[other]) == tuple(before)


@pytest.mark.slow
def test_devices_are_compared(small_lung: Lung) -> None:
    stiff = replace(SYSTEM, name="stiff", needle=replace(SYSTEM.needle, max_curvature_per_mm=0.002))
    thick = replace(
        SYSTEM,
        name="thick",
        scope=replace(
            SYSTEM.scope, outer_diameter_mm=15.0, min_bending_radius_mm=8.0, min_shaft_radius_mm=8.0
        ),
    )
    told: list[str] = []
    maps = compare_reach(
        small_lung, (SYSTEM, stiff, thick), spacing_mm=25.0, progress=lambda name, _share: told.append(name)
    )
    shares = [each.total.reached for each in maps]
    assert shares[0] > shares[1] > shares[2] == 0.0
    assert maps[2].entries == 0 and np.isnan(maps[2].total.median_cost)
    assert set(told) == {SYSTEM.name, "stiff", "thick"}
    gained, lost = maps[1].gained_and_lost_ml(maps[0])
    assert (gained - lost) == pytest.approx((shares[1] - shares[0]) * maps[0].total.volume_ml)


def test_bad_input_is_refused(
    small_lung: Lung, atlas: la.Atlas, environment: NeedleEnvironment, reach: ReachMap
) -> None:
    for spacing in (0.1, 100.0, float("nan")):
        with pytest.raises(SettingsError, match="spacing"):
            map_reach(small_lung, SYSTEM, spacing_mm=spacing, atlas=atlas)
    with pytest.raises(SettingsError, match="atlas was made for"):
        map_reach(small_lung, la.load_system("thin-scope"), atlas=atlas)
    with pytest.raises(SettingsError, match="at least 1 arc"):
        ReachScan(environment, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), arcs=0)
    finer = Volume(grid=reach_grid(small_lung, 10.0), array=np.zeros(reach_grid(small_lung, 10.0).shape))
    with pytest.raises(GridMismatchError):
        reach.gained_and_lost_ml(replace(reach, kinds=finer))


@pytest.mark.slow
def test_the_command(small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setattr("lungaccess.problem.patients.load_patient", lambda *_args, **_options: small_lung)
    command = ["reach", "patient", "--system", "ultrathin", "--spacing", "30", "--out", str(tmp_path)]
    assert main([*command, "--json"]) == ExitCode.OK
    (written,) = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in written["regions"]] == ["right lung", "left lung", "total"]
    assert set(written["regions"][0]["shares"]) == set(KINDS)
    assert sum(written["regions"][0]["states_ml"].values()) == pytest.approx(
        written["regions"][0]["volume_ml"]
    )
    assert json.loads((tmp_path / "reach.json").read_text()) == [written]
    assert (tmp_path / "reach.png").read_bytes().startswith(PNG)
    assert read_volume(tmp_path / "reach.nrrd").array.any()
    assert main([*command, "--compare", "thin-scope"]) == ExitCode.OK
    shown = capsys.readouterr().out
    assert "ultrathin" in shown and "thin-scope" in shown and "gained" in shown
    for stem in ("reach-1-ultrathin", "reach-2-thin-scope"):
        assert (tmp_path / f"{stem}.nrrd").is_file() and (tmp_path / f"{stem}.png").is_file()
    assert main([*command, "--spacing", "0"]) == ExitCode.BAD_INPUT
    assert main([*command, "--compare", "nonesuch"]) == ExitCode.BAD_INPUT

"""Diverse plan sets: different, proved, and honestly compared."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.grid import Volume
from anatomy.lung import Lung
from lungaccess.cli import app as cli
from lungaccess.planning import Alternative, diverse_plans, with_front
from lungaccess.planning.coupled import DirectArcs
from lungaccess.planning.coupled.kernels.direct_arcs import choose_separated
from lungaccess.planning.coupled.search.direct_candidates import SAMPLES, _branches_first, _samples
from lungaccess.problem.request import Request
from lungaccess.problem.target import Target
from stages.needle.path import direct_path
from tests.lungaccess.planning.coupled.planning import SYSTEM
from tests.lungaccess.resample import needle_walk


def alternatives(lung: Lung, target: Target, **options: Any) -> tuple[Alternative, ...]:
    """Return a set of small cost, whose best plan is searched for briefly."""
    return la.alternatives(lung, SYSTEM, target, **{"goal": "default", "iterations": 5, **options})


@pytest.fixture(scope="module")
def found(small_lung: Lung, atlas: la.Atlas) -> tuple[Alternative, ...]:
    target = la.resolve_target(small_lung)
    return alternatives(small_lung, target, atlas=atlas, count=8, separation_mm=3.0)


@pytest.mark.slow
def test_plans_differ_and_pass_the_check(found: tuple[Alternative, ...], small_lung: Lung) -> None:
    assert len(found) >= 3
    for one, other in itertools.combinations(found, 2):
        a, b = needle_walk(one.plan).points[::20], needle_walk(other.plan).points[::20]
        gaps = np.linalg.norm(a[:, None] - b[None], axis=-1)
        assert max(gaps.min(axis=1).max(), gaps.min(axis=0).max()) >= 3.0 - 0.3
    for each in found:
        assert la.check(each.plan, small_lung).accepted


def test_where_no_arc_leads_the_planner_searches(
    small_lung: Lung, atlas: la.Atlas, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = la.resolve_target(small_lung)
    monkeypatch.setattr(diverse_plans, "separated_candidates", lambda *_: iter(()))
    (only,) = alternatives(small_lung, target, atlas=atlas, iterations=3)
    *_, best = la.plan(small_lung, SYSTEM, target, atlas=atlas, iterations=3, goal="default")
    assert only.plan.digest == best.digest and only.on_front


def others(lung: Lung, atlas: la.Atlas, objective: str = "default") -> list[la.Plan]:
    """Return the direct ways that are separated, whatever is searched for beside them."""
    asked = Request.of(lung, SYSTEM, la.resolve_target(lung), goal=objective)
    return list(diverse_plans._others(asked, atlas, 8, 3.0))


def test_the_best_comes_first_and_all_others_are_direct(
    found: tuple[Alternative, ...], small_lung: Lung, atlas: la.Atlas
) -> None:
    target = la.resolve_target(small_lung)
    *_, best = la.plan(small_lung, SYSTEM, target, atlas=atlas, iterations=5, goal="default")
    assert found[0].plan.digest == best.digest
    assert all(each.plan.method == diverse_plans.METHOD for each in found[1:])
    direct = {_tubes_of(each) for each in others(small_lung, atlas)}
    assert {_tubes_of(each.plan) for each in found[1:]} <= direct


def _tubes_of(plan: la.Plan) -> tuple[float, float, bytes]:
    """Return what tells deployments apart, whatever motion brings the scope to its tip."""
    tube = plan.tube
    return tube.rotation_rad, tube.inner_insertion_mm, plan.scope.lps_from_scope_tip.tobytes()


def test_each_branch_comes_first_once(small_lung: Lung, atlas: la.Atlas) -> None:
    branches = [each.tube.exit.branch for each in others(small_lung, atlas)]
    first = list(dict.fromkeys(branches))
    assert branches[: len(first)] == first
    assert _branches_first(np.array([4, 4, 2, 4, 7, 2])).tolist() == [0, 2, 4, 1, 3, 5]


def patchy(lung: Lung) -> Lung:
    """A cost map of patches, between 0.01 and 100, so that short paths are seldom cheap ones."""
    coarse = 10.0 ** np.random.default_rng(0).uniform(-2.0, 2.0, [n // 6 + 1 for n in lung.grid.shape])
    values = np.kron(coarse, np.ones((6, 6, 6)))[tuple(slice(n) for n in lung.grid.shape)]
    return replace(lung, cost=Volume(grid=lung.grid, array=np.asfortranarray(values, dtype=np.float32)))


@pytest.mark.parametrize(
    "objective", ["inverse_clearance", "cost_map", "voxel_sum", "length_mm", "length=1,cost-map=20"]
)
def test_the_cheapest_under_the_objective_come_first(
    small_lung: Lung, atlas: la.Atlas, objective: str
) -> None:
    """Of each branch first, then of all; the order is that of estimates, which are some per cent off."""
    lung = patchy(small_lung)
    found = others(lung, atlas, objective)
    by_branch: dict[int, list[float]] = {}
    for each in found:
        by_branch.setdefault(each.tube.exit.branch, []).append(each.cost)
    cheapest = [costs[0] for costs in by_branch.values()]
    rest = [each.cost for each in found[len(cheapest) :]]
    for costs in (cheapest, rest, *by_branch.values()):
        assert all(later > 0.97 * sooner for sooner, later in itertools.pairwise(costs)), costs


def test_samples_are_all_and_hold_every_branch_first() -> None:
    rng = np.random.default_rng(0)
    for total in (0, 5, 40_000):
        branch = np.sort(rng.integers(0, 5, total)) * 3
        branch[-1:] = 99
        parts = list(_samples(branch))
        assert sorted(np.concatenate(parts).tolist()) == list(range(total))
        assert set(branch[parts[0]]) == set(branch)
        assert len(parts[0]) <= 10_000


def test_lines_are_apart_if_a_point_strays() -> None:
    straight = np.column_stack([np.zeros((9, 2)), np.linspace(0.0, 40.0, 9)])
    bowed, near, longer = straight.copy(), straight.copy(), straight.copy()
    bowed[4, 0], near[4, 0], longer[-1, 2] = 6.0, 3.0, 45.5
    lines, chosen = np.stack([straight, near, bowed, straight, longer]), np.zeros(5, dtype=np.int64)
    count = choose_separated(lines, np.arange(5), 5.0, chosen)
    assert chosen[:count].tolist() == [0, 2, 4]
    assert choose_separated(lines, np.arange(5), 5.0, chosen[:2]) == 2


def test_criteria_are_those_of_the_plan(found: tuple[Alternative, ...]) -> None:
    for each in found:
        plan, values = each.plan, each.criteria
        assert values["inverse_clearance"] == plan.costs["inverse_clearance"]
        beyond = plan.tube.inner_insertion_mm - plan.tube.exit.arc_length_mm
        assert values["length_in_tissue_mm"] == pytest.approx(plan.needle.length_mm + beyond)
        assert values["clearance_mm"] <= min(plan.clearance_mm["needle"]["vessel"], values["pleura_mm"])


def test_front(found: tuple[Alternative, ...]) -> None:
    assert any(each.on_front for each in found)
    alone = with_front([found[0].plan])
    assert alone[0].on_front
    worse = replace(found[0].plan, costs={name: cost + 1.0 for name, cost in found[0].plan.costs.items()})
    assert [each.on_front for each in with_front([worse, found[0].plan])] == [False, True]


def test_lines_are_the_arcs() -> None:
    rng = np.random.default_rng(0)
    tangents = rng.standard_normal((20, 3))
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    entries = SimpleNamespace(positions=rng.standard_normal((20, 3)), tangents=tangents)
    target = np.array([3.0, 40.0, -10.0])
    entries.tangents[0] = (target - entries.positions[0]) / np.linalg.norm(target - entries.positions[0])
    arcs: Any = SimpleNamespace(
        atlas=SimpleNamespace(deployments=entries),
        task=SimpleNamespace(target=SimpleNamespace(lps_mm=target)),
        _by_aim=lambda _chosen: [(slice(None), target)],
    )
    lines = DirectArcs.lines(arcs, np.arange(20), SAMPLES)
    for line, position, tangent in zip(lines, entries.positions, tangents, strict=True):
        frame = np.eye(4)
        frame[:3, 2] = tangent
        frame[:3, 0] = np.linalg.svd(tangent[None])[2][1]
        frame[:3, 1] = np.cross(tangent, frame[:3, 0])
        frame[:3, 3] = position
        points = direct_path(frame, target).sample(0.01)[0]
        gaps = np.linalg.norm(line[:, None] - points[None], axis=-1).min(axis=1)
        assert gaps.max() < 0.011 and np.allclose(line[[0, -1]], [position, target], atol=1e-9)


def test_bad_input(small_lung: Lung, atlas: la.Atlas) -> None:
    target = la.resolve_target(small_lung)
    for wrong in ({"count": 0}, {"separation_mm": 0.0}, {"goal": "beauty"}):
        with pytest.raises(SettingsError):
            alternatives(small_lung, target, atlas=atlas, **wrong)
    other = replace(SYSTEM, name="other", scope=replace(SYSTEM.scope, outer_diameter_mm=2.9))
    with pytest.raises(SettingsError, match="atlas"):
        la.alternatives(small_lung, other, target, atlas=atlas)


def test_an_atlas_serves_another_needle(small_lung: Lung, atlas: la.Atlas) -> None:
    other = replace(SYSTEM, name="other", needle=replace(SYSTEM.needle, max_curvature_per_mm=1.0 / 40.0))
    target = la.resolve_target(small_lung)
    (only,) = la.alternatives(small_lung, other, target, goal="default", iterations=0, atlas=atlas, count=1)
    assert only.plan.system == other


@pytest.mark.slow
def test_command(
    small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("lungaccess.cli.options.load_lung", lambda *_: small_lung)

    def files_of(name: str, separation_mm: str) -> list[str]:
        words = ["alternatives", "patient", "--nodule", "1", "--system", "ultrathin", "--count", "2"]
        words += ["--procedure", "open-loop", "--iterations", "2", "--separation", separation_mm]
        assert cli.main([*words, "--out", str(tmp_path / name), "--cache", str(tmp_path)]) == 0
        return sorted(path.name for path in (tmp_path / name).iterdir() if path.is_file())

    assert files_of("plans", "2") == ["plan-01.json", "plan-02.json", "trade_off.svg"]
    assert la.check(la.Plan.load(tmp_path / "plans" / "plan-01.json"), small_lung).accepted
    assert "of at most" not in capsys.readouterr().out
    assert "plan-02.json" not in files_of("far", "200")
    assert "1 of at most 2 plans: no further direct way" in " ".join(capsys.readouterr().out.split())

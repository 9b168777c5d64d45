"""Plans with one stated value edited, and a valid digest, are refused."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anatomy.base.settings import override
from anatomy.grid import Volume
from lungaccess.judging.checking import check
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import load_system, system_fingerprint
from stages.needle.path import ArcPath
from tests.lungaccess.judging.checking.verdict import refusals
from tests.lungaccess.tube_shapes import shared_curvatures


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"lung_key": "other"}, "patient.key"),
        ({"patient_name": "Other"}, "patient.name"),
        ({"sources": {"airway.nii.gz": "1" * 64}}, "patient.sources"),
        ({"breath_hold": "expiration"}, "patient.breath_hold"),
        ({"system_fingerprint": "0" * 64}, "system.fingerprint"),
        ({"schema": "lungaccess-plan-0"}, "record.schema"),
        ({"objective": "beauty"}, "costs.objective"),
        ({"fissures_are_obstacles": False}, "patient.fissures"),
        ({"target_lps": np.array([60.0, 0.0, 30.0])}, "target.reached"),
        ({"target_origin": "nodule"}, "target.in_nodule"),
        (
            {"required_clearance_mm": {"outer_tube": 1.45, "inner_tube": 1.25, "needle": 0.9}},
            "clearance.required.needle",
        ),
        (
            {"costs": {"inverse_clearance": 1.0, "cost_map": 0.0, "length_mm": 25.0}},
            "costs.inverse_clearance",
        ),
        ({"costs": {"inverse_clearance": 1.0, "length_mm": 25.0}}, "costs.names"),
        ({"clearance_mm": {"tube": {}}}, "clearance.names"),
        ({"clearance_mm": {"tube": {}, "needle": {"bone": 3.0}}}, "clearance.names"),
        ({"exemption__branch": 2}, "exemption.branch"),
        ({"exemption__needle_length_mm": 8.0}, "exemption.length"),
        ({"exemption__needle_length_mm": -1.0}, "exemption.length.sign"),
        ({"tube__exit__branch": 2, "exemption__branch": 2}, "tube.exit.branch"),
        ({"tube__exit__wall_angle_rad": 1.2}, "tube.exit.angle"),
        ({"tube__exit__arc_length_mm": 29.0}, "tube.exit.arc"),
        ({"tube__exit__wall_run_mm": 1.0}, "tube.wall_run.stated"),
        ({"tube__exit__wall_run_mm": 6.5}, "tube.wall_run.stated.most"),
        ({"tube__exit__wall_run_mm": 5.5}, "tube.wall_run.stated_limit"),
        ({"tube__rotation_rad": 0.8}, "tube.tip.position"),
        ({"tube__inner_insertion_mm": 38.5}, "tube.arcs.length"),
        ({"tube__outer_insertion_mm": 21.0}, "tube.arcs.radius"),
        ({"tube__outer_insertion_mm": 40.0}, "record.lengths"),
        ({"tube__lateral_sweep_mm": 1.5}, "tube.sweep.stated_limit"),
        ({"scope__generation": 1}, "scope.generation"),
        ({"scope__length_mm": 30.0}, "scope.length"),
        ({"scope__length_from_carina_mm": 30.0}, "scope.length_from_carina"),
        ({"scope__min_lumen_margin_mm": 2.0}, "scope.margin"),
        ({"scope__branches": [0, 2]}, "scope.branch"),
        ({"scope__branches": [0, 3]}, "scope.branches"),
        ({"scope__max_curvature_per_mm": 0.02}, "scope.curvature"),
        ({"needle__length_mm": 24.0}, "needle.length"),
        ({"needle__accumulated_turn_rad": 0.05}, "needle.turn"),
        ({"needle__max_angle_from_start_rad": 0.01}, "needle.angle"),
        ({"needle__end_lps": np.array([60.0, 0.0, 30.0])}, "needle.end"),
        ({"needle__arcs": ()}, "needle.arcs"),
    ],
)
def test_one_value_edited(plan: Plan, lung: Any, tools: Any, values: dict[str, Any], expected: str) -> None:
    assert expected in refusals(tools.changed(plan, **values), lung)


def test_target_given_is_the_target_planned(plan: Plan, lung: Any) -> None:
    assert "target.given" in refusals(plan, lung, target_lps=plan.target_lps + [0.0, 0.5, 0.0])


@pytest.mark.parametrize("factor", [1.2, 3.0])
def test_curvature_too_high(plan: Plan, lung: Any, tools: Any, system: Any, factor: float) -> None:
    """The needle of a tighter plan, consistent in itself, ends where it says."""
    arcs = tuple((a.length_mm, a.roll_rad, factor * a.curvature_per_mm) for a in plan.needle.arcs)
    wrong = tools.toy_plan(lung, system, plan.tube.outer_insertion_mm, plan.tube.inner_insertion_mm, arcs)
    assert refusals(wrong, lung) == {"needle.curvature"}


def test_turning_limits(plan: Plan, lung: Any, tools: Any) -> None:
    for key in ("needle.max_angle_from_start_deg", "needle.max_accumulated_turn_deg", "needle.max_length_mm"):
        strict = override(plan.system, {key: 4.0, "name": "own"})
        wrong = tools.changed(plan, system=strict, system_fingerprint=system_fingerprint(strict))
        found = refusals(wrong, lung)
        assert len(found) == 1
        assert found <= {"needle.angle.limit", "needle.turn.limit", "needle.length.limit"}


@pytest.mark.parametrize("n", [0, 1, 2])
def test_roll_of_an_arc_edited(plan: Plan, lung: Any, tools: Any, n: int) -> None:
    arcs = list(plan.needle.arcs)
    arcs[n] = dataclasses.replace(arcs[n], roll_rad=arcs[n].roll_rad + 0.1)
    assert "needle.end" in refusals(tools.changed(plan, needle__arcs=tuple(arcs)), lung)


@pytest.mark.parametrize(
    "where", ["scope__lps_from_scope_tip", "tube__lps_from_tip", "needle__lps_from_start"]
)
@pytest.mark.parametrize("kind", ["position", "turn", "tilt", "mirror", "scale"])
def test_pose_edited(plan: Plan, lung: Any, tools: Any, where: str, kind: str) -> None:
    stage, name = where.split("__")
    pose = getattr(getattr(plan, stage), name).copy()
    if kind == "position":
        pose[:3, 3] += [0.02, 0.0, 0.0]
    elif kind == "mirror":
        pose[:3, 0] *= -1
    elif kind == "scale":
        pose[:3, :3] *= 1.01
    else:
        angle = 0.02
        pose = tools.turned(pose, angle) if kind == "turn" else pose @ tools.arc(1e-9, angle / 1e-9)
    assert refusals(tools.changed(plan, **{where: pose}), lung)


def test_margin_edited(plan: Plan, lung: Any, tools: Any, system: Any) -> None:
    thin = override(system, {"margins.segmentation_margin_mm": 0.1})
    wrong = tools.changed(plan, system=thin, system_fingerprint=system_fingerprint(thin))
    assert {"system.preset", "clearance.required.needle"} <= refusals(wrong, lung)
    wrong = tools.toy_plan(lung, thin, plan.tube.outer_insertion_mm, plan.tube.inner_insertion_mm)
    assert refusals(wrong, lung) == {"system.preset"}
    renamed = override(thin, {"name": "own"})
    wrong = tools.toy_plan(lung, renamed, plan.tube.outer_insertion_mm, plan.tube.inner_insertion_mm)
    assert refusals(wrong, lung, system=system) == {"system.given"}
    assert refusals(wrong, lung, system=renamed) == set()


def test_exit_exemption_of_the_system_edited(plan: Plan, lung: Any, tools: Any, system: Any) -> None:
    long = override(system, {"needle.exit_exemption_mm": 20.0})
    wrong = tools.changed(
        plan, system=long, system_fingerprint=system_fingerprint(long), exemption__needle_length_mm=20.0
    )
    assert "system.preset" in refusals(wrong, lung)


@pytest.mark.parametrize("name", ["scope__length_mm", "needle__end_lps", "tube__lps_from_tip", "target_lps"])
def test_not_a_number(plan: Plan, lung: Any, tools: Any, name: str) -> None:
    for value in (np.nan, np.inf):
        shape = np.shape(_get(plan, name))
        wrong = tools.changed(plan, **{name: np.full(shape, value) if shape else value})
        assert refusals(wrong, lung) == {"record.finite"}


def _get(plan: Plan, name: str) -> Any:
    value: Any = plan
    for part in name.split("__"):
        value = getattr(value, part)
    return value


@pytest.mark.parametrize("value", [1e300, -1e300, 1e6])
@pytest.mark.parametrize("name", ["scope__states", "tube__rotation_rad", "needle__end_lps", "target_lps"])
def test_absurd_numbers(plan: Plan, lung: Any, tools: Any, name: str, value: float) -> None:
    shape = np.shape(_get(plan, name))
    wrong = tools.changed(plan, **{name: np.full(shape, value) if shape else value})
    assert "record.lengths" in refusals(wrong, lung)


def test_far_away_from_everything(plan: Plan, lung: Any, tools: Any) -> None:
    for step in (60.0, 5000.0):
        away = [0.0, step, 0.0]
        entry, pose = plan.scope.lps_from_entry.copy(), plan.scope.lps_from_scope_tip.copy()
        entry[:3, 3] += away
        pose[:3, 3] += away
        wrong = tools.changed(plan, scope__lps_from_entry=entry, scope__lps_from_scope_tip=pose)
        assert {"scope.start", "scope.fits", "tube.tip.position"} <= refusals(wrong, lung)


def test_sweep_understated(plan: Plan, lung: Any, tools: Any, system: Any) -> None:
    """4 mm of the curve leave the scope straightened: the tubes move sideways while the inner advances."""
    outer, inner = plan.tube.outer_insertion_mm, 44.0
    system = override(system, {"tubes.max_wall_run_mm": 8.0, "name": "wall"})
    longer = tools.toy_plan(lung, system, outer, inner, ((12.0, 0.4, 0.0),), straightened_rad=0.06)
    sweep = _sweep_by_hand(system, outer, inner)
    assert 0.2 < sweep < system.tubes.max_lateral_sweep_mm
    honest = tools.changed(longer, tube__lateral_sweep_mm=sweep, tube__follow_the_leader_error_mm=sweep)
    assert refusals(honest, lung) == set()
    for value in (0.0, 0.7 * sweep):
        assert "tube.sweep.stated" in refusals(tools.changed(honest, tube__lateral_sweep_mm=value), lung)
    assert "tube.leader.stated" in refusals(tools.changed(honest, tube__follow_the_leader_error_mm=0.0), lung)
    strict = override(system, {"tubes.max_lateral_sweep_mm": 0.5 * sweep, "name": "own"})
    wrong = tools.changed(honest, system=strict, system_fingerprint=system_fingerprint(strict))
    assert {"tube.sweep.limit", "tube.sweep.stated_limit"} <= refusals(wrong, lung)


def _sweep_by_hand(system: Any, outer: float, inner: float) -> float:
    """Largest distance to the final shape while both tubes, then the inner one, advance."""
    tubes = system.tubes
    ahead, within = shared_curvatures(system)

    def shape(e2: float, e1: float) -> np.ndarray:
        s = np.arange(0.0, e1 + 1e-9, 0.02)
        curved = s >= e1 - tubes.inner.curved_length_mm
        k = np.where(s < e2, within, ahead) * curved
        heading = np.cumsum(k) * 0.02
        return np.cumsum(np.stack([np.sin(heading), np.cos(heading)], axis=1), axis=0) * 0.02

    final = shape(outer, inner)
    steps = [(e, e) for e in np.linspace(5.0, outer, 8)] + [(outer, e) for e in np.linspace(outer, inner, 24)]
    worst = 0.0
    for e2, e1 in steps:
        points = shape(e2, e1)[::20]
        worst = max(worst, float(np.sqrt(((points[:, None] - final[None]) ** 2).sum(-1)).min(axis=1).max()))
    return worst


def test_tubes_beyond_their_limits(plan: Plan, lung: Any, tools: Any) -> None:
    for key, value, name in (
        ("tubes.max_extension_mm", 37.0, "tube.extension"),
        ("tubes.inner.length_mm", 650.0, "tube.protrusion"),
        ("tubes.min_wall_angle_deg", 40.0, "tube.exit.angle.limit"),
        ("tubes.max_wall_run_mm", 1.5, "tube.wall_run.limit"),
    ):
        own = override(plan.system, {key: value, "name": "own"})
        assert name in refusals(
            tools.changed(plan, system=own, system_fingerprint=system_fingerprint(own)), lung
        )


def test_clearance_overstated(plan: Plan, lung: Any, tools: Any) -> None:
    for stage in ("tube", "needle"):
        for name in plan.clearance_mm[stage]:
            stated = {key: dict(value) for key, value in plan.clearance_mm.items()}
            true = stated[stage][name]
            stated[stage][name] = true + 0.1 if true < 19.0 else 0.5
            found = refusals(tools.changed(plan, clearance_mm=stated), lung)
            assert any(item.startswith(f"{stage}.clearance.{name}.stated") for item in found)


def test_cost_map(plan: Plan, lung: Any, tools: Any) -> None:
    from types import SimpleNamespace

    cost = np.full(lung.labels.shape, 0.25, dtype=np.float32)
    mapped = SimpleNamespace(**{**vars(lung), "cost": Volume(grid=lung.grid, array=cost)})
    assert refusals(plan, mapped) == {"costs.cost_map"}
    costs = {**plan.costs, "cost_map": 0.25 * plan.needle.length_mm}
    assert refusals(tools.changed(plan, costs=costs), mapped) == set()
    crossed = len(voxels_on(plan, lung))
    costs["voxel_sum"] = 0.25 * crossed
    assert refusals(tools.changed(plan, costs=costs), mapped) == set()
    for wrong in (0.25 * crossed + 2.0, 0.25 * crossed - 2.0):
        costs["voxel_sum"] = wrong
        assert refusals(tools.changed(plan, costs=costs), mapped) == {"costs.voxel_sum"}


def voxels_on(plan: Plan, lung: Any) -> set[tuple[int, ...]]:
    """The voxels of samples of the needle's axis, 1e-3 mm apart."""
    path = ArcPath(
        lps_from_start=plan.needle.lps_from_start,
        arcs=np.array([[a.length_mm, a.roll_rad, a.curvature_per_mm] for a in plan.needle.arcs]),
    )
    return {tuple(v) for v in np.rint(lung.grid.ijk(path.sample(1e-3)[0])).astype(int).tolist()}


def test_nodule_as_target(plan: Plan, lung: Any, tools: Any) -> None:
    from types import SimpleNamespace

    points = lung.grid.lps(np.stack(np.meshgrid(*map(np.arange, lung.labels.shape), indexing="ij"), axis=-1))
    ball = np.linalg.norm(points - plan.target_lps, axis=-1) < 4.0
    with_nodule = SimpleNamespace(**{**vars(lung), "nodules": Volume(grid=lung.grid, array=ball)})
    aimed = tools.changed(plan, target_origin="nodule")
    assert refusals(aimed, with_nodule) == set()
    away = tools.changed(aimed, target_lps=plan.target_lps + [0.0, 6.0, 0.0])
    assert "target.in_nodule" in refusals(away, with_nodule)


PROVENANCE = {"timing", "seed", "iterations", "digest", "system"}
ALLOWED_TO_BE_CAREFUL = {"lateral_sweep_mm", "follow_the_leader_error_mm"}


def numbers(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths of all numbers in a JSON value that a user's safety hangs on."""
    if isinstance(value, dict):
        return [
            p
            for k, v in value.items()
            if k not in PROVENANCE | ALLOWED_TO_BE_CAREFUL
            for p in numbers(v, (*path, k))
        ]
    if isinstance(value, list):
        return [p for n, v in enumerate(value) for p in numbers(v, (*path, n))]
    return [path] if isinstance(value, float | int) and not isinstance(value, bool) else []


@settings(max_examples=25)
@given(data=st.data())
def test_any_number_edited_is_refused(plan: Plan, lung: Any, data: st.DataObject) -> None:
    """Pick a number anywhere in the file, change it by a little, make the digest fit: refused."""
    content = json.loads(plan.to_json())
    paths = numbers(content)
    group = data.draw(st.sampled_from(sorted({p[:2] for p in paths}, key=str)))
    path = data.draw(st.sampled_from([p for p in paths if p[:2] == group]))
    inner = content
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] += 1 if isinstance(inner[path[-1]], int) else data.draw(st.sampled_from([0.2, 0.5]))
    content["digest"] = _digest(content)
    try:
        wrong = Plan.from_json(json.dumps(content))
    except Exception as error:
        raise AssertionError(f"{path} made the file unreadable: {error}") from error
    careful = path[0] == "clearance_mm" and inner[path[-1]] > 20.0
    # The motion begins with a nearly straight scope in the trachea, where another twist is as good a motion.
    # A straight tube is the same however it is turned.
    as_good = path in {("scope", "states", 0, 1), ("tube", "shape", "relative_rotations_rad", "outer")}
    assert careful or as_good or not check(wrong, lung).accepted, path


def _digest(content: dict[str, Any]) -> str:
    import hashlib

    kept = {k: v for k, v in content.items() if k not in ("timing", "digest")}
    text = json.dumps(kept, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    return hashlib.sha256(text.encode()).hexdigest()


def test_preset_is_compared_by_name(plan: Plan) -> None:
    assert plan.system == load_system(plan.system.name)

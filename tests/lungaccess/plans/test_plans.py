"""A plan survives its file without loss, and a damaged file is refused."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from anatomy.base.errors import FileError, PlanFileError
from lungaccess.plans.file import SCHEMA, SHAPELESS
from lungaccess.plans.parts import (
    DeployedShape,
    Exemption,
    NeedleArc,
    NeedlePath,
    ScopeInsertion,
    TubeDeployment,
    WallExit,
)
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import load_system, system_fingerprint
from tests.lungaccess.tube_shapes import stated_shape

NUMBER = st.floats(allow_nan=False, allow_infinity=False)


def make_plan(values: np.ndarray | None = None, **changes: Any) -> Plan:
    """A plan of arbitrary numbers."""
    v = np.random.default_rng(0).normal(size=40) if values is None else values
    pose = v[:16].reshape(4, 4)
    system = load_system("thin-scope")
    stages: dict[str, Any] = {
        "scope": ScopeInsertion(
            lps_from_entry=pose.T,
            states=v[:9].reshape(3, 3),
            lps_from_scope_tip=pose,
            branches=np.array([0, 1]),
            generation=1,
            length_mm=v[3],
            length_from_carina_mm=v[4],
            min_lumen_margin_mm=v[5],
            max_curvature_per_mm=v[9],
        ),
        "tube": TubeDeployment(
            rotation_rad=v[6],
            outer_insertion_mm=v[7],
            inner_insertion_mm=v[8],
            lps_from_tip=pose,
            exit=WallExit(
                branch=1, point_lps=v[9:12], arc_length_mm=v[12], wall_angle_rad=v[13], wall_run_mm=v[14]
            ),
            lateral_sweep_mm=v[14],
            follow_the_leader_error_mm=v[15],
            shape=DeployedShape(
                relative_rotations_rad={"inner": v[30], "outer": v[31]},
                arcs=v[:12].reshape(3, 4),
                arc_error_mm=v[12],
                least_determinant=v[13],
            ),
        ),
        "needle": NeedlePath(
            lps_from_start=pose,
            arcs=(NeedleArc(length_mm=v[16], roll_rad=v[17], curvature_per_mm=v[18]),) * 2,
            end_lps=v[19:22],
            length_mm=v[22],
            max_angle_from_start_rad=v[23],
            accumulated_turn_rad=v[24],
        ),
        "exemption": Exemption(branch=1, exit_point_lps=v[25:28], needle_length_mm=v[28]),
    }
    head: dict[str, Any] = {
        "software_version": "0.1",
        "patient_name": "Patient [1] \u00e9",
        "lung_key": "k",
        "sources": {"b": "2", "a": "1"},
        "breath_hold": None,
        "system": system,
        "system_fingerprint": system_fingerprint(system),
        "target_lps": v[29:32],
        "target_origin": "nodule",
        "fissures_are_obstacles": True,
        "objective": "length_mm",
        "required_clearance_mm": {"needle": v[32]},
        "clearance_mm": {"needle": {"vessel": v[33]}, "tube": {}},
        "costs": {"length_mm": v[34]},
        "method": "atlas",
        "seed": 2**40,
        "iterations": 12,
        "timing": {"total_s": v[35]},
    }
    return Plan(**{**head, **stages, **changes})


def same(a: Any, b: Any) -> bool:
    """Bit for bit."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)
        )
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, tuple):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, dict) or hasattr(a, "items"):
        return list(a) == list(b) and all(same(a[k], b[k]) for k in a)
    return bool(a == b)


@given(st.lists(NUMBER, min_size=40, max_size=40))
def test_round_trip_without_loss(numbers: list[float]) -> None:
    plan = make_plan(np.array(numbers))
    text = plan.to_json()
    again = Plan.from_json(text)
    assert same(plan, again)
    assert again.to_json() == text
    assert again.digest == plan.digest


def test_file_round_trip(tmp_path: Path) -> None:
    plan = make_plan()
    plan.save(tmp_path / "plan.json")
    assert [p.name for p in tmp_path.iterdir()] == ["plan.json"]
    assert same(Plan.load(tmp_path / "plan.json"), plan)
    plan.save(tmp_path / "plan.json")
    assert json.loads((tmp_path / "plan.json").read_text())["digest"] == plan.digest


def test_digest_ignores_timing_alone() -> None:
    plan = make_plan()
    assert dataclasses.replace(plan, timing={"total_s": 9.0}).digest == plan.digest
    for change in (
        {"seed": 1},
        {"method": "rrt"},
        {"breath_hold": "inspiration"},
        {"target_lps": np.zeros(3)},
    ):
        assert dataclasses.replace(plan, **change).digest != plan.digest


def test_the_same_plan_gives_the_same_bytes() -> None:
    a = make_plan(sources={"b": "2", "a": "1"})
    b = make_plan(sources={"a": "1", "b": "2"})
    assert a.to_json() == b.to_json()


def test_numpy_and_whole_numbers_are_stored_alike() -> None:
    a = make_plan(costs={"length_mm": 5}, seed=np.int64(3))
    b = make_plan(costs={"length_mm": np.float64(5.0)}, seed=3)
    assert a.to_json() == b.to_json()


def test_parts_cannot_be_changed() -> None:
    plan = make_plan()
    with pytest.raises(ValueError, match="read-only"):
        plan.target_lps[0] = 1.0
    with pytest.raises(TypeError):
        plan.costs["length_mm"] = 0.0  # type: ignore[index]
    with pytest.raises(dataclasses.FrozenInstanceError):
        plan.seed = 1  # type: ignore[misc]


def test_arrays_are_copied() -> None:
    target = np.zeros(3)
    plan = make_plan(target_lps=target)
    target[0] = 1.0
    assert plan.target_lps[0] == 0.0


@pytest.mark.parametrize("value", [np.zeros(2), np.zeros((3, 1)), "abc", [[1.0], [2.0, 3.0]]])
def test_wrong_shape(value: Any) -> None:
    with pytest.raises(PlanFileError, match="target_lps"):
        make_plan(target_lps=value)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_not_finite_is_never_written(value: float, tmp_path: Path) -> None:
    for change in (
        {"target_lps": np.full(3, value)},
        {"costs": {"length_mm": value}},
        {"timing": {"total_s": value}},
    ):
        with pytest.raises(PlanFileError, match="finite"):
            make_plan(**change).save(tmp_path / "plan.json")
    assert list(tmp_path.iterdir()) == []


def edited(change: Any) -> str:
    content = json.loads(make_plan().to_json())
    change(content)
    return json.dumps(content)


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.update(seed=1),
        lambda c: c["needle"]["arcs"][1].update(roll_rad=0.0),
        lambda c: c["scope"]["states"][0].__setitem__(0, 0.0),
        lambda c: c["system"]["margins"].update(segmentation_margin_mm=0.1),
        lambda c: c.update(digest="0" * 64),
        lambda c: c.pop("digest"),
        lambda c: c.pop("exemption"),
        lambda c: c.update(extra=1),
        lambda c: c["needle"].update(extra=1),
        lambda c: c.update(schema="lungaccess-plan-1"),
        lambda c: c.update(seed="1"),
        lambda c: c.update(seed=True),
        lambda c: c.update(seed=1.5),
        lambda c: c.update(costs=[1.0]),
        lambda c: c.update(fissures_are_obstacles=1),
        lambda c: c.update(breath_hold=3),
        lambda c: c.update(target_lps=[1.0, 2.0]),
        lambda c: c.update(target_lps=[1.0, 2.0, "x"]),
        lambda c: c.update(target_lps=[1.0, 2.0, None]),
        lambda c: c.update(target_lps=[1.0, 2.0, True]),
        lambda c: c.update(target_lps=[1.0, 2.0, float("nan")]),
        lambda c: c["tube"]["exit"].update(arc_length_mm=float("inf")),
        lambda c: c["system"].update(unknown=1),
        lambda c: c["system"]["needle"].update(diameter_mm=-1.0),
        lambda c: c.update(scope=None),
        lambda c: c.update(needle=[]),
    ],
)
def test_edited_file_is_refused(change: Any) -> None:
    with pytest.raises(PlanFileError):
        Plan.from_json(edited(change))


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", "3", '{"schema": 1, "schema": 2}', '{"a": 1e999}', "[" * 9999]
)
def test_not_a_plan(text: str) -> None:
    with pytest.raises(PlanFileError):
        Plan.from_json(text)


def test_huge_number_is_not_finite() -> None:
    text = make_plan().to_json().replace(f'"seed": {2**40}', '"seed": 1e999')
    with pytest.raises(PlanFileError):
        Plan.from_json(text)


@pytest.mark.parametrize("number", ["1e999", "-1e999", "1" + 400 * "0", "NaN"])
def test_no_measure_is_infinite(number: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is refused by itself, not because the digest is that of other numbers."""
    monkeypatch.setattr("lungaccess.plans.file.digest", lambda _plan: "any")
    content = json.loads(make_plan().to_json()) | {"digest": "any"}
    assert Plan.from_json(json.dumps(content)).seed == 2**40
    for part, key in (("tube", "lateral_sweep_mm"), ("needle", "length_mm"), ("costs", "length_mm")):
        changed = content | {part: content[part] | {key: "here"}}
        with pytest.raises(PlanFileError, match=None if number == "NaN" else f"{part}.{key}"):
            Plan.from_json(json.dumps(changed).replace('"here"', number))


@given(st.integers(0, 10**9))
def test_truncated_file(cut: int) -> None:
    text = make_plan().to_json()
    with pytest.raises(PlanFileError):
        Plan.from_json(text[: cut % (len(text) - 2)])


def test_missing_binary_or_unwritable_file(tmp_path: Path) -> None:
    with pytest.raises(PlanFileError):
        Plan.load(tmp_path / "none.json")
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(PlanFileError):
        Plan.load(tmp_path / "binary.json")
    with pytest.raises(FileError):
        make_plan().save(tmp_path / "no" / "such" / "folder" / "plan.json")
    with pytest.raises(FileError):
        make_plan().save(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["binary.json"]


def test_schema_is_stated() -> None:
    assert make_plan().schema == SCHEMA
    assert json.loads(make_plan().to_json())["schema"] == SCHEMA


def test_a_plan_with_a_line_for_the_scope_says_what_it_lacks() -> None:
    old = make_plan().to_json().replace(SCHEMA, "lungaccess-plan-1")
    with pytest.raises(PlanFileError, match="a line but no motion") as refused:
        Plan.from_json(old)
    assert "again for the same patient, target and system" in str(refused.value)


@pytest.mark.parametrize("factor", [1.0, 0.75])
def test_a_plan_of_the_format_before_gets_shape_and_segment(toy_plan: Plan, factor: float) -> None:
    """Its shape is that of its insertions without a needle, of which it knows one share of strain."""
    content = json.loads(toy_plan.to_json())
    content["schema"] = SHAPELESS
    del content["digest"], content["tube"]["shape"], content["system"]["needle"]["slotted_segments"]
    del content["system"]["needle_preloaded"]
    content["system"]["needle"]["strain_factor"] = factor
    kept = {key: value for key, value in content.items() if key != "timing"}
    canonical = json.dumps(kept, sort_keys=True, separators=(",", ":")).encode()
    content["digest"] = hashlib.sha256(canonical).hexdigest()
    read = Plan.from_json(json.dumps(content))
    tube, found = toy_plan.tube, read.tube.shape
    assert not read.system.needle_preloaded
    wanted = stated_shape(read.system.tubes, tube.outer_insertion_mm, tube.inner_insertion_mm)
    assert found.relative_rotations_rad == wanted.relative_rotations_rad
    np.testing.assert_allclose(found.arcs, wanted.arcs, atol=1e-9)
    assert read.system.needle is not None and read.system.needle.strain_factor(1000.0) == factor
    same = dataclasses.replace(
        read, system=toy_plan.system, tube=dataclasses.replace(read.tube, shape=tube.shape)
    )
    assert same.to_json() == toy_plan.to_json()
    content["tube"]["outer_insertion_mm"] += 1.0
    with pytest.raises(PlanFileError, match="edited or damaged"):
        Plan.from_json(json.dumps(content))

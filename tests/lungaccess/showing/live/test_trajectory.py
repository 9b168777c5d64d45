"""Trajectories: joints lead where the plan ends, none is faster than stated, and others read the files."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from anatomy.base.errors import SettingsError
from lungaccess.plans.plan import Plan
from lungaccess.showing.live import Speeds, plan_trajectory, write_trajectory
from lungaccess.showing.live.trajectory import joint_trajectory, table_text, tip_path, yaml_text

SPEEDS = Speeds(scope_mm_per_s=5.0, tube_mm_per_s=1.0, needle_mm_per_s=0.5, needle_deg_per_s=20.0)


def test_the_devices_end_where_the_plan_has_them(toy_plan: Plan) -> None:
    moves = plan_trajectory(toy_plan)
    assert np.abs(moves.lps_from_scope_tip[-1] - toy_plan.scope.lps_from_scope_tip).max() < 1e-9
    assert np.abs(moves.lps_from_tube_tip[-1][:3, 3] - toy_plan.tube.lps_from_tip[:3, 3]).max() < 1e-6
    assert np.abs(moves.lps_from_tube_tip[-1][:3, 2] - toy_plan.tube.lps_from_tip[:3, 2]).max() < 1e-6
    assert np.abs(moves.lps_from_needle_tip[-1][:3, 3] - toy_plan.needle.end_lps).max() < 1e-6
    last = dict(zip(moves.joints, moves.values[-1], strict=True))
    assert last["outer_tube_insertion_mm"] == toy_plan.tube.outer_insertion_mm
    assert last["inner_tube_insertion_mm"] == toy_plan.tube.inner_insertion_mm
    assert last["inner_tube_rotation_rad"] == toy_plan.tube.rotation_rad
    assert last["needle_insertion_mm"] == pytest.approx(toy_plan.needle.length_mm)
    assert last["needle_roll_rad"] == pytest.approx(sum(arc.roll_rad for arc in toy_plan.needle.arcs))
    assert np.allclose(moves.values[-1, :3], toy_plan.scope.states[-1])


def test_the_tips_follow_the_plans_curves(toy_plan: Plan) -> None:
    moves = plan_trajectory(toy_plan)
    needle = [n for n, stage in enumerate(moves.stages) if stage == "needle"]
    curve = toy_plan.curves(0.05).needle.points_lps
    tips = moves.lps_from_needle_tip[needle][:, :3, 3]
    assert np.linalg.norm(tips[:, None] - curve, axis=2).min(axis=1).max() < 0.03
    # While the tubes go out together they keep to their final shape up to the sweep that the plan states.
    tubes = [n for n, stage in enumerate(moves.stages) if stage == "tubes"]
    curve = toy_plan.curves(0.05).tubes.points_lps
    tips = moves.lps_from_tube_tip[tubes][:, :3, 3]
    assert np.linalg.norm(tips[:, None] - curve, axis=2).min(axis=1).max() < 1.0


def test_one_device_moves_after_the_other_and_time_rises(toy_plan: Plan) -> None:
    moves = plan_trajectory(toy_plan, SPEEDS, step_s=0.25)
    assert np.diff(moves.time_s).min() > 1e-9 and np.diff(moves.time_s).max() < 0.25 + 1e-9
    order = [stage for n, stage in enumerate(moves.stages) if n == 0 or stage != moves.stages[n - 1]]
    assert order == ["scope", "tubes", "needle"]


def test_no_joint_is_faster_than_stated_and_one_is_as_fast(toy_plan: Plan) -> None:
    moves = plan_trajectory(toy_plan, SPEEDS)
    rates = np.abs(np.diff(moves.values, axis=0)) / np.diff(moves.time_s)[:, None]
    turn = math.radians(30.0)
    tubes = [1.0, turn] * (len(moves.joints) // 2 - 3)
    most = np.array([5.0, turn, turn, *tubes, 0.5, math.radians(20.0)])
    assert len(most) == len(moves.joints) - 1
    used = rates[:, :-1] / most
    assert used.max() < 1.0 + 1e-9
    assert used.max(axis=1).min() > 1.0 - 1e-6, "some joint always moves at its speed"


def test_the_table_is_read_by_python(toy_plan: Plan) -> None:
    moves = plan_trajectory(toy_plan)
    rows = list(csv.DictReader(io.StringIO(table_text(moves))))
    assert len(rows) == len(moves.time_s)
    last = rows[-1]
    assert last["stage"] == "needle"
    place = [float(last[f"tip_{axis}_mm"]) for axis in "xyz"]
    assert np.abs(np.array(place) - toy_plan.needle.end_lps).max() < 1e-6
    turn = Rotation.from_quat([float(last[f"tip_q{axis}"]) for axis in "xyzw"]).as_matrix()
    assert np.abs(turn - moves.lps_from_needle_tip[-1][:3, :3]).max() < 1e-8


def test_the_joints_have_the_layout_of_ros_2_in_si_units(toy_plan: Plan) -> None:
    moves = plan_trajectory(toy_plan)
    content = yaml.safe_load(yaml_text(joint_trajectory(moves)))
    assert set(content) == {"header", "joint_names", "points"}
    assert set(content["header"]) == {"stamp", "frame_id"}
    assert set(content["header"]["stamp"]) == {"sec", "nanosec"}
    assert content["joint_names"][:3] == ["scope_advance", "scope_twist", "scope_bend"]
    assert content["joint_names"][-3:] == ["needle_insertion", "needle_roll", "needle_curvature"]
    times = []
    for point in content["points"]:
        assert set(point) == {"positions", "velocities", "accelerations", "effort", "time_from_start"}
        assert len(point["positions"]) == len(point["velocities"]) == len(content["joint_names"])
        assert all(isinstance(value, float) for value in point["positions"])
        times.append(point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"])
    assert np.abs(np.array(times) - moves.time_s).max() < 1e-8
    last = dict(zip(content["joint_names"], content["points"][-1]["positions"], strict=True))
    assert last["needle_insertion"] == pytest.approx(1e-3 * toy_plan.needle.length_mm)
    assert last["needle_curvature"] == pytest.approx(1e3 * toy_plan.needle.arcs[-1].curvature_per_mm)
    # A controller that follows velocities arrives where the next position is.
    positions = np.array([point["positions"] for point in content["points"]])[:, :-1]
    rates = np.array([point["velocities"] for point in content["points"]])[:, :-1]
    moved = positions[:-1] + rates[:-1] * np.diff(times)[:, None]
    assert np.abs(moved - positions[1:]).max() < 1e-6


def test_a_path_has_the_layout_of_ros_2_in_metres(toy_plan: Plan) -> None:
    content = yaml.safe_load(yaml_text(tip_path(plan_trajectory(toy_plan), "needle")))
    assert set(content) == {"header", "poses"}
    for pose in content["poses"]:
        assert set(pose) == {"header", "pose"} and set(pose["pose"]) == {"position", "orientation"}
        turn = [pose["pose"]["orientation"][axis] for axis in "xyzw"]
        assert np.linalg.norm(turn) == pytest.approx(1.0)
    end = [content["poses"][-1]["pose"]["position"][axis] for axis in "xyz"]
    assert np.abs(np.array(end) - 1e-3 * toy_plan.needle.end_lps).max() < 1e-9
    assert content["header"]["frame_id"] == "patient_lps"


def test_the_files(toy_plan: Plan, tmp_path: Path) -> None:
    written = write_trajectory(plan_trajectory(toy_plan), tmp_path / "out")
    assert set(written) == {each.name for each in (tmp_path / "out").iterdir()} == {
        "trajectory.csv", "joint_trajectory.yaml", "scope_path.yaml", "tubes_path.yaml", "needle_path.yaml",
    }  # fmt: skip
    again = write_trajectory(plan_trajectory(toy_plan), tmp_path / "again")
    for name in again:
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / "out" / name).read_bytes()


@pytest.mark.parametrize("step_s", [0.0, -1.0, float("nan"), float("inf")])
def test_steps_are_above_zero(step_s: float, toy_plan: Plan) -> None:
    with pytest.raises(SettingsError, match="apart"):
        plan_trajectory(toy_plan, step_s=step_s)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_speeds_have_a_range(value: float) -> None:
    with pytest.raises(SettingsError):
        Speeds(needle_mm_per_s=value)

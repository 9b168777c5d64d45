"""Why a path is no answer to a query: each limit of the needle, one at a time."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from anatomy.margins import Margins
from anatomy.structures import VESSEL
from stages.needle.device import Needle
from stages.needle.environment import needle_environment
from stages.needle.path import ArcPath, Query, violation
from tests.stages.scenes import Canvas

AROUND = np.array([[20.0, math.pi / 2, 1 / 60], [35.0, math.pi, 1 / 60]])
"""Up to 20 degrees aside, past a vessel, and 15 degrees to the other side: 55 degrees in all."""


def start() -> np.ndarray:
    frame = np.eye(4)
    frame[2, 3] = -28.0
    return frame


def around(arcs: Any = AROUND) -> ArcPath:
    return ArcPath(lps_from_start=start(), arcs=np.array(arcs))


def reason(path: ArcPath, *, needle: Any = None, asked: Any = None, tolerance_mm: float = 0.0) -> str:
    canvas = Canvas.empty([-32, -32, -32], [32, 32, 32], 1.0)
    canvas.add(canvas.ball([0, 0, 0], 4.0), VESSEL)
    device = Needle(**{"diameter_mm": 1.0, "max_curvature_per_mm": 1 / 30, **(needle or {})})
    environment = needle_environment(canvas.lung(), device, Margins(), with_fissures=False)
    target = around().frames()[-1][:3, 3]
    query = Query(**{"lps_from_start": start(), "target": target, **(asked or {})})
    return violation(environment, query, path, goal_tolerance_mm=tolerance_mm)


def test_a_path_within_all_limits_is_an_answer() -> None:
    assert reason(around()) == ""


@pytest.mark.parametrize(
    ("limit", "short", "enough", "expected"),
    [
        ("max_length_mm", 54.9, 55.1, "longer"),
        ("max_curvature_per_mm", 1 / 60.1, 1 / 59.9, "tightly"),
        ("max_accumulated_turn_deg", 52.4, 52.6, "in all"),
        ("max_angle_from_start_deg", 19.0, 19.2, "direction"),
    ],
)
def test_each_limit_of_the_needle_is_tested(limit: str, short: float, enough: float, expected: str) -> None:
    assert expected in reason(around(), needle={limit: short})
    assert reason(around(), needle={limit: enough}) == ""


@pytest.mark.parametrize(
    ("asked", "more", "expected"),
    [
        ({"inserted_mm": 94.9}, {"inserted_mm": 95.1}, "longer"),
        ({"turned_rad": math.radians(127.4)}, {"turned_rad": math.radians(127.6)}, "in all"),
        ({"reference": [0.0, 0.0, 1.0]}, {"reference": [0.0, -1.0, 0.1]}, "direction"),
    ],
)
def test_what_lies_behind_the_start_counts(asked: Any, more: Any, expected: str) -> None:
    assert reason(around(), asked=asked) == ""
    assert expected in reason(around(), asked=more)


def test_a_path_ends_at_the_target_and_begins_at_the_start() -> None:
    beside = {"target": around().frames()[-1][:3, 3] + [0.0, 0.0, 0.9]}
    assert "misses" in reason(around(), asked=beside)
    assert reason(around(), asked=beside, tolerance_mm=1.0) == ""
    moved = start()
    moved[0, 3] += 0.01
    assert "elsewhere" in reason(ArcPath(lps_from_start=moved, arcs=AROUND), tolerance_mm=1.0)


def test_every_arc_is_proved_clear() -> None:
    through = around([[10.0, 0.0, 0.0], [40.0, 0.0, 0.0]])
    assert reason(through, asked={"target": through.frames()[-1][:3, 3]}) == "too near: vessel"


@pytest.mark.parametrize("value", [-1.0, math.nan])
def test_numbers_that_are_no_arcs_are_refused(value: float) -> None:
    for column in (0, 2):
        arcs = AROUND.copy()
        arcs[1, column] = value
        assert reason(around(arcs), tolerance_mm=100.0) != ""


def test_the_largest_angle_to_a_direction() -> None:
    path = around()
    assert path.max_angle_from_start_rad(start()[:3, 2]) == path.max_angle_from_start_rad()
    frames = np.concatenate([ArcPath(lps_from_start=f, arcs=[[s, r, k]]).frames()[-1:, :3, 2]
                             for f, (length, r, k) in zip(path.frames(), path.arcs, strict=False)
                             for s in np.linspace(0.0, length, 50)])  # fmt: skip
    direction = np.array([0.6, 0.0, 0.8])
    assert path.max_angle_from_start_rad(direction) == pytest.approx(
        math.acos((frames @ direction).min()), abs=1e-3
    )

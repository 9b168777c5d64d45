"""The bend of a route beside the axis: a point stated twice is no kink, and hides none."""

from __future__ import annotations

import numpy as np
import pytest

from lungaccess.checking.findings import Finding, Findings
from lungaccess.checking.route import BENDING_RADIUS_MM, _check_bend


def bend_of(points: np.ndarray) -> Finding:
    """What the check finds of a route that lies beside the axis all along."""
    found = Findings()
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    before_tip = np.append(np.cumsum(steps[::-1])[::-1], 0.0)
    _check_bend(points, np.full(len(points), 1.0), before_tip + 1e-9, found)
    (finding,) = found.report().findings
    return finding


def arc(radius_mm: float) -> np.ndarray:
    """Points of a quarter of a circle."""
    angle = np.linspace(0.0, 0.5 * np.pi, 40)
    return radius_mm * np.stack([1.0 - np.cos(angle), np.zeros(40), np.sin(angle)], axis=1) + 100.0


@pytest.mark.parametrize("radius_mm", [9.0, 10.0, 30.0])
def test_curvature_of_an_arc(radius_mm: float) -> None:
    finding = bend_of(arc(radius_mm))
    assert finding.ok == (radius_mm >= BENDING_RADIUS_MM)
    assert finding.value == pytest.approx(1.0 / radius_mm, rel=0.01)


@pytest.mark.parametrize("apart_mm", [0.0, 1.4e-14, 1e-9])
@pytest.mark.parametrize("radius_mm", [9.0, 30.0])
def test_a_point_stated_twice_is_no_kink_and_hides_none(radius_mm: float, apart_mm: float) -> None:
    points = arc(radius_mm)
    twice = np.insert(points, 20, points[20] + [-apart_mm, 0.0, 0.0], axis=0)
    assert bend_of(twice).value == pytest.approx(bend_of(points).value, rel=1e-6)


@pytest.mark.parametrize("count", [2, 50])
def test_a_kink_of_many_points_in_one_place_is_seen(count: int) -> None:
    line = np.stack([np.zeros(20), np.zeros(20), np.arange(20.0)], axis=1)
    turned = line[-1] + np.arange(1.0, 20.0)[:, None] * [0.3, 0.0, 0.954]
    corner = line[-1] + np.linspace(0.0, 9e-7, count)[:, None] * [0.15, 0.0, 0.98]
    assert not bend_of(np.concatenate([line, corner, turned])).ok

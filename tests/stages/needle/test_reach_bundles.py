"""The arcs from one start to the points of a ball: how far they may be apart, and what that rules out."""

from __future__ import annotations

import math

import numpy as np

from anatomy.poses import pose
from stages.needle.kernels import reach_arcs as kernel
from stages.needle.path import CURVATURE, ROLL, direct_path


def test_arcs_to_the_points_of_a_ball_are_never_farther_apart_than_stated() -> None:
    rng = np.random.default_rng(5)
    inverted, apart = kernel.inverted_aside.py_func, kernel._greatest_spread.py_func
    spread, at_chord = kernel._spread.py_func, kernel._point_at_chord.py_func
    tightest, looked = 0.0, 0
    for _ in range(20_000):
        tangent = _unit(rng)
        start = (*rng.uniform(-50.0, 50.0, 3), *tangent)
        chord, lean = rng.uniform(5.0, 120.0), rng.uniform(0.0, 0.25 * math.pi)
        aside = _unit(rng)
        aside = _scaled(aside - (aside @ tangent) * tangent)
        q = np.array(start[:3]) + chord * (math.cos(lean) * tangent + math.sin(lean) * aside)
        radius = rng.uniform(0.1, 10.0)
        # On the ball's surface, where the bound is tight, more often than within.
        other = q + radius * min(1.0, rng.uniform(0.5, 1.5)) * _unit(rng)
        _chord2, middle = inverted(start, q)
        widest = spread(math.sqrt(_chord2), radius)
        if widest == math.inf:
            continue
        other_chord2, there = inverted(start, other)
        c = rng.uniform(0.0, 1.0) * (math.sqrt(_chord2) - radius)
        bound = apart(middle, widest, c)
        if bound == math.inf:
            continue
        assert c <= math.sqrt(other_chord2)
        one, two = (np.array(at_chord(start, each, c)) for each in (middle, there))
        gap = float(np.linalg.norm(one - two))
        assert gap <= bound * (1.0 + 1e-9) + 1e-12
        tightest, looked = max(tightest, gap / bound if bound > 0.0 else 0.0), looked + 1
    assert looked > 10_000 and tightest > 0.95


def test_the_place_at_a_chord_lies_on_the_arc() -> None:
    rng = np.random.default_rng(6)
    for _ in range(200):
        lps_from_start = pose(rng.uniform(-50.0, 50.0, 3), _unit(rng))
        start = (*lps_from_start[:3, 3], *lps_from_start[:3, 2])
        q = lps_from_start[:3, 3] + rng.uniform(-60.0, 60.0, 3)
        chord2, aside = kernel.inverted_aside.py_func(start, q)
        c = rng.uniform(0.0, 1.0) * math.sqrt(chord2)
        place = np.array(kernel._point_at_chord.py_func(start, aside, c))
        assert abs(np.linalg.norm(place - lps_from_start[:3, 3]) - c) < 1e-9
        # The arc to the place is the first part of the arc to the point.
        part, whole = direct_path(lps_from_start, place), direct_path(lps_from_start, q)
        assert part.length_mm <= whole.length_mm + 1e-9
        assert abs(part.arcs[0, CURVATURE] - whole.arcs[0, CURVATURE]) < 1e-9
        assert abs(math.remainder(part.arcs[0, ROLL] - whole.arcs[0, ROLL], 2.0 * math.pi)) < 1e-5


def _unit(rng: np.random.Generator) -> np.ndarray:
    return _scaled(rng.normal(size=3))


def _scaled(vector: np.ndarray) -> np.ndarray:
    return np.asarray(vector / np.linalg.norm(vector))

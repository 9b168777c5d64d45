"""The index of start poses finds exactly what a look at each pose finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import lungaccess as la
from anatomy.lung import Lung
from stages.needle.environment import NeedleEnvironment, needle_environment, workspace_lengths
from stages.needle.reach import StartIndex

SYSTEM = la.load_system("ultrathin")


def environment_of(lung: Lung, radius_mm: float, longest_mm: float, angle_deg: float) -> NeedleEnvironment:
    needle = replace(
        SYSTEM.needle,
        max_curvature_per_mm=1.0 / radius_mm,
        max_length_mm=longest_mm,
        max_angle_from_start_deg=angle_deg,
    )
    return needle_environment(lung, needle, SYSTEM.margins, with_fissures=False)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 3000),
    spread=st.sampled_from([0.0, 2.0, 30.0, 300.0]),
    lean=st.sampled_from([0.0, 0.05, 0.5, 10.0]),
    radius=st.sampled_from([30.0, 50.0, 121.0]),
    longest=st.sampled_from([20.0, 150.0]),
    angle=st.sampled_from([60.0, 90.0, 120.0]),
)
def test_the_index_agrees_with_a_scan(
    small_lung: Lung,
    seed: int,
    count: int,
    spread: float,
    lean: float,
    radius: float,
    longest: float,
    angle: float,
) -> None:
    rng = np.random.default_rng(seed)
    places = rng.normal(0.0, 1.0, (count, 3)) * spread
    directions = rng.normal(0.0, 1.0, 3) + lean * rng.normal(0.0, 1.0, (count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    index = StartIndex(places, directions)
    environment = environment_of(small_lung, radius, longest, angle)
    assert index.count == count
    for _ in range(5):
        target = rng.normal(0.0, 40.0, 3)
        lengths = workspace_lengths(environment, places, directions, target)
        expected = np.argsort(lengths, kind="stable")[: int(np.isfinite(lengths).sum())]
        found, found_lengths = index.holding(environment, target)
        assert np.array_equal(found, expected)
        assert np.array_equal(found_lengths, lengths[expected])


@pytest.mark.slow
def test_an_atlas_answers_the_same(small_lung: Lung) -> None:
    entries = la.build_atlas(small_lung, SYSTEM, rotations=8).deployments
    environment = needle_environment(small_lung, SYSTEM.needle, SYSTEM.margins, with_fissures=False)
    index = StartIndex(entries.positions, entries.tangents)
    rng = np.random.default_rng(0)
    held = 0
    for start in rng.choice(entries.count, 20, replace=False):
        target = entries.positions[start] + rng.uniform(10.0, 60.0) * entries.tangents[start]
        lengths = workspace_lengths(environment, entries.positions, entries.tangents, target)
        found, _ = index.holding(environment, target)
        held += len(found)
        assert np.array_equal(np.sort(found), np.flatnonzero(np.isfinite(lengths)))
    assert held > 100


def test_a_bundle_out_of_reach_is_passed_over_only_if_all_its_poses_are(small_lung: Lung) -> None:
    """A target on the edge of one pose's workspace, the other poses of its bundle looking elsewhere."""
    environment = environment_of(small_lung, 50.0, 100.0, 90.0)
    directions = np.array([[np.cos(a), np.sin(a), 0.0] for a in np.linspace(-0.1, 0.1, 21)])
    index = StartIndex(np.zeros((21, 3)), directions)
    edge = np.array([50.0 * np.sin(0.8), 50.0 * (1.0 - np.cos(0.8)), 0.0])
    turned = np.array([[np.cos(0.1), -np.sin(0.1), 0.0], [np.sin(0.1), np.cos(0.1), 0.0], [0.0, 0.0, 1.0]])
    found, lengths = index.holding(environment, turned @ edge * (1.0 + 1e-9))
    assert found.tolist() == [20]
    assert lengths[0] == pytest.approx(40.0, rel=1e-3)

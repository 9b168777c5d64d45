"""Exact depth and containment, against brute force."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from anatomy.tree.depth import exact_depth_mm, inside, segments_inside


def _mask(rng: np.random.Generator, fill: float) -> np.ndarray:
    mask = np.zeros((9, 8, 7), bool)
    mask[1:-1, 1:-1, 1:-1] = rng.random((7, 6, 5)) < fill
    return mask


@given(st.integers(0, 2**32 - 1), st.floats(0.5, 1.0))
def test_depth_is_the_distance_to_the_nearest_box(seed: int, fill: float):
    rng = np.random.default_rng(seed)
    mask = _mask(rng, fill)
    spacing = rng.uniform(0.4, 2.0, 3)
    ijk = rng.uniform(-0.5, np.array(mask.shape) - 0.5, (40, 3))
    empty = np.argwhere(~mask)
    away = np.maximum(np.abs(ijk[:, None] - empty) - 0.5, 0.0) * spacing
    np.testing.assert_allclose(
        exact_depth_mm(mask, spacing, ijk), np.linalg.norm(away, axis=2).min(axis=1), atol=1e-12
    )


@given(st.integers(0, 2**32 - 1), st.floats(0.7, 1.0))
def test_segments_inside_agrees_with_dense_samples(seed: int, fill: float):
    rng = np.random.default_rng(seed)
    mask = _mask(rng, fill)
    begin = rng.uniform(0.6, np.array(mask.shape) - 1.6, (30, 3))
    end = begin + rng.normal(0, 1.0, (30, 3))
    t = np.linspace(0, 1, 2001)[:, None, None]
    dense = inside(mask, begin + t * (end - begin)).all(axis=0)
    said = segments_inside(mask, begin, end)
    # Samples can miss a corner that is cut by less than their distance, never the other way round.
    assert not (said & ~dense).any()
    assert (said == dense).mean() > 0.9


def test_step_over_an_edge_is_not_inside():
    mask = np.zeros((4, 4, 3), bool)
    mask[1, 1, 1] = mask[2, 2, 1] = True
    begin, end = np.array([[1.0, 1.0, 1.0]]), np.array([[2.0, 2.0, 1.0]])
    assert not segments_inside(mask, begin, end)[0]
    mask[1, 2, 1] = True
    assert not segments_inside(mask, begin, end)[0]
    mask[2, 1, 1] = True
    assert segments_inside(mask, begin, end)[0]


def test_no_segments():
    none = np.zeros((0, 3))
    assert segments_inside(np.ones((3, 3, 3), bool), none, none).shape == (0,)

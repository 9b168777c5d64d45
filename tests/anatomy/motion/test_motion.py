"""The motion of a patient: against the phantom's known truth, its proved bounds, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError, FrameError, SettingsError
from anatomy.base.records import plain_values
from anatomy.build import build_lung
from anatomy.grid import Grid
from anatomy.lung import Lung
from anatomy.motion.motion import LEFT, RIGHT, Motion, cell_bounds
from anatomy.motion.prepare import continued_unfolded, prepare_motion
from anatomy.motion.source import MotionSource, share_of_motion
from anatomy.phantom import Phantom
from anatomy.phantom.files import PhantomBreathing
from anatomy.store import folder_name, open_lung
from anatomy.structures import OUTSIDE
from tests.anatomy.stored_toy import SOURCES
from tests.anatomy.toys import toy


def prepared(source: MotionSource, lung: Lung) -> Motion:
    return prepare_motion(source, lung.labels, lung.grid, float(lung.tree.carina_lps[0]))


def places(lung: Lung, side: int) -> np.ndarray:
    """Places in a lung, away from the midline, where the phantom's truth jumps."""
    points = lung.grid.lps(6 * np.argwhere((lung.labels[::6, ::6, ::6] & OUTSIDE) == 0))
    return points[(points[:, 0] > 20.0) if side == LEFT else (points[:, 0] < -20.0)]


@pytest.fixture(scope="module")
def truth(small_phantom: Phantom) -> PhantomBreathing:
    return PhantomBreathing.of(small_phantom)


@pytest.fixture(scope="module")
def source(small_phantom: Phantom, truth: PhantomBreathing) -> MotionSource:
    return truth.source(small_phantom)


@pytest.fixture(scope="module")
def motion(source: MotionSource, small_lung: Lung) -> Motion:
    return prepared(source, small_lung)


@pytest.mark.parametrize("side", [RIGHT, LEFT])
def test_the_phantoms_field_is_brought_from_end_exhale_to_its_masks(
    motion: Motion, truth: PhantomBreathing, small_lung: Lung, side: int
) -> None:
    at = places(small_lung, side)
    error = np.linalg.norm(motion.displacements_mm(at, side) - truth.at_masks(at), axis=1)
    assert np.percentile(error, 95) < 0.1
    # The place at end-exhale of what the masks show moves back to it.
    exhaled = motion.moved(at, 0.0, side)
    assert np.percentile(np.linalg.norm(exhaled + truth.from_exhale(exhaled) - at, axis=1), 95) < 0.1


def test_a_field_from_end_inhale_gives_the_same_motion(
    source: MotionSource, motion: Motion, truth: PhantomBreathing, small_lung: Lung
) -> None:
    grid = source.grid
    assert grid is not None
    points = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1)).reshape(-1, 3)
    back = -truth.at_masks(points).reshape(*grid.shape, 3)
    other = prepared(replace(source, vectors=back, maps_from="end-inhale"), small_lung)
    at = places(small_lung, LEFT)
    assert np.abs(other.displacements_mm(at, LEFT) - motion.displacements_mm(at, LEFT)).max() < 0.1


def test_phases_are_linear_and_begin_at_the_masks(motion: Motion, small_lung: Lung) -> None:
    at = places(small_lung, RIGHT)
    d = motion.displacements_mm(at, RIGHT)
    assert np.array_equal(motion.moved(at, 1.0, RIGHT), at)
    assert np.allclose(motion.moved(at, 0.25, RIGHT), at - 0.75 * d)
    assert np.abs(motion.pulled_back(motion.moved(at, 0.3, RIGHT), 0.3, RIGHT) - at).max() < 1e-6
    half = replace(motion, amplitude=0.5)
    assert np.allclose(half.moved(at, 0.0, RIGHT), at - 0.5 * d)
    assert half.key != motion.key
    with pytest.raises(SettingsError, match=r"0 \(end-exhale\)"):
        motion.moved(at, 1.5, RIGHT)


def test_the_bounds_of_cells_hold_everywhere_in_them() -> None:
    rng = np.random.default_rng(4)
    nodes, step = rng.normal(0.0, 0.8, (5, 6, 7, 3)), 5.0
    bounds = cell_bounds(nodes, step)
    tightest = np.inf
    for _ in range(3000):
        cell, f = rng.integers(0, [4, 5, 6]), rng.random(3)
        corner = nodes[tuple(slice(n, n + 2) for n in cell)]
        weights = np.array([[1.0 - x, x] for x in f])
        slopes = [np.where(np.eye(3, dtype=bool)[axis][:, None], [-1.0, 1.0], weights) for axis in range(3)]
        gradient = np.stack([np.einsum("abcr,a,b,c->r", corner, *w) for w in slopes], axis=1) / step
        low, high, norm = bounds[tuple(cell)]
        assert np.linalg.norm(gradient, 2) <= norm
        for share in (-0.7, 0.4, 1.0):
            least = np.linalg.svd(np.eye(3) + share * gradient)[1][-1]
            proved = 1.0 + share * (low if share > 0 else high)
            assert proved <= least
            tightest = min(tightest, least - proved)
    assert tightest < 0.2


def test_the_bounds_are_exact_for_an_affine_motion() -> None:
    gradient = np.array([[0.1, 0.3, 0.0], [-0.1, -0.2, 0.05], [0.0, 0.0, 0.15]])
    at = np.moveaxis(np.indices((3, 3, 3)), 0, -1) * 5.0
    bounds = cell_bounds(at @ gradient.T, 5.0)
    ends = np.linalg.eigvalsh(0.5 * (gradient + gradient.T))[[0, -1]]
    assert np.allclose(bounds[..., :2], ends, atol=1e-5)
    assert np.allclose(bounds[..., 2], np.linalg.norm(gradient), atol=1e-5)


def test_a_reversed_direction_is_refused(source: MotionSource, small_lung: Lung) -> None:
    vectors = source.vectors
    assert vectors is not None
    with pytest.raises(AnatomyError, match="to the head.*maps_from"):
        prepared(replace(source, vectors=-vectors), small_lung)


def test_a_field_in_another_frame_is_refused(source: MotionSource, small_lung: Lung) -> None:
    grid = source.grid
    assert grid is not None
    matrix = grid.lps_from_ijk.copy()
    matrix[1, 3] += 150.0
    elsewhere = Grid(shape=grid.shape, lps_from_ijk=matrix)
    with pytest.raises(FrameError, match="covers .* of the lungs"):
        prepared(replace(source, grid=elsewhere), small_lung)


def test_a_motion_that_folds_is_refused(source: MotionSource, small_lung: Lung) -> None:
    grid = source.grid
    assert grid is not None
    mirrored = np.zeros((*grid.shape, 3))
    mirrored[..., 1] = -1.2 * grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1))[..., 1]
    with pytest.raises(AnatomyError, match="not proved to be invertible"):
        prepared(replace(source, vectors=mirrored, masks_phase=0.0), small_lung)


def test_landmark_pairs_predict_the_truth(truth: PhantomBreathing, small_lung: Lung) -> None:
    rng = np.random.default_rng(0)
    inhale = np.concatenate([rng.permutation(places(small_lung, side))[:150] for side in (RIGHT, LEFT)])
    noise = rng.normal(0.0, 0.3, inhale.shape)
    exhale = inhale - truth.at_masks(inhale) + noise
    motion = prepared(
        MotionSource(description="pairs", masks_phase=1.0, exhale_lps=exhale, inhale_lps=inhale), small_lung
    )
    at = places(small_lung, LEFT)
    assert np.linalg.norm(motion.displacements_mm(at, LEFT) - truth.at_masks(at), axis=1).mean() < 0.3
    # Half of the noisy pairs predict the other half to little more than their own noise.
    assert 0.3 < motion.figures["left_out_mm"] < 0.8
    few = MotionSource(description="", masks_phase=1.0, exhale_lps=exhale[:9], inhale_lps=inhale[:9])
    with pytest.raises(AnatomyError, match="9 pairs of landmarks in the right lung"):
        prepared(few, small_lung)


def test_the_population_warns_and_moves_each_height_as_it_says(small_lung: Lung) -> None:
    stated = MotionSource(description="population", masks_phase=0.0, population_motion_mm=10.0)
    motion = prepared(stated, small_lung)
    assert motion.warning_only
    assert "not a promise" in motion.warnings[0]
    at = places(small_lung, RIGHT)
    height = [small_lung.height_share(point) for point in at]
    expected = [-10.0 * share_of_motion(each) for each in height]
    assert np.abs(motion.displacements_mm(at, RIGHT)[:, 2] - expected).max() < 0.5


@pytest.mark.slow
def test_a_field_of_the_lungs_alone_is_continued_beyond_them(
    source: MotionSource, motion: Motion, small_lung: Lung
) -> None:
    grid, vectors = source.grid, source.vectors
    assert grid is not None and vectors is not None
    at = np.rint(small_lung.grid.ijk(grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1)))).astype(int)
    at = np.clip(at, 0, np.array(small_lung.labels.shape) - 1)
    inside = (small_lung.labels[tuple(np.moveaxis(at, -1, 0))] & OUTSIDE) == 0
    other = prepared(replace(source, vectors=vectors * inside[..., None]), small_lung)
    places_left = places(small_lung, LEFT)
    gap = other.displacements_mm(places_left, LEFT) - motion.displacements_mm(places_left, LEFT)
    assert np.percentile(np.linalg.norm(gap, axis=1), 95) < 0.5


def test_a_field_that_jumps_between_the_lungs_is_continued() -> None:
    values = np.zeros((12, 5, 5, 3))
    values[6:, ..., 2] = -20.0
    inside = np.zeros((12, 5, 5), dtype=bool)
    inside[5:10] = True
    out, share = continued_unfolded(values, inside, 5.0)
    assert 0.1 < share < 0.5
    assert np.allclose(out[7:10, ..., 2], -20.0)
    assert out[5, ..., 2].max() < -15.0


def test_a_stored_lung_breathes_as_before(tmp_path: Path) -> None:
    stated = MotionSource(description="population", masks_phase=0.0, population_motion_mm=10.0)
    images = replace(toy(), motion=stated)
    built = build_lung(images)
    stored = open_lung({"a": "b"}, lambda: images, cache=tmp_path)
    again = open_lung({"a": "b"}, lambda: pytest.fail("it is in the cache"), cache=tmp_path)
    assert built.motion is not None and stored.motion is not None and again.motion is not None
    assert built.motion.key == stored.motion.key == again.motion.key
    again_plain, built_plain = (plain_values(each.motion, "", {}) for each in (again, built))
    assert again_plain == built_plain
    assert np.array_equal(built.labels, build_lung(toy()).labels)


def test_a_lung_without_motion_is_stored_without(tmp_path: Path) -> None:
    lung = open_lung(SOURCES, toy, cache=tmp_path)
    assert lung.motion is None
    assert '"motion": null' in (tmp_path / folder_name(lung.key) / "lung.json").read_text()

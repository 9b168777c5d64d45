"""Lungs onto lungs: a mask of the other end of the breath tells a motion from its opposite."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError
from anatomy.grid import Grid, Volume
from anatomy.lung import Lung
from anatomy.motion.motion import Motion
from anatomy.motion.plausible import require_onto_lungs
from anatomy.motion.prepare import prepare_motion
from anatomy.phantom import Phantom
from anatomy.phantom.files import PhantomBreathing
from anatomy.structures import OUTSIDE

SPACING_MM = 2.0


@pytest.fixture(scope="module")
def truth(small_phantom: Phantom) -> PhantomBreathing:
    return PhantomBreathing.of(small_phantom)


@pytest.fixture(scope="module")
def exhaled(truth: PhantomBreathing, small_lung: Lung) -> Volume:
    """The lungs at end-exhale by the phantom's truth; its masks show end-inhale."""
    corners = small_lung.grid.corners_lps
    low, high = corners.min(axis=0), corners.max(axis=0)
    shape = np.ceil((high - low) / SPACING_MM).astype(int) + 1
    grid = Grid.from_spacing(shape, (SPACING_MM,) * 3, low)
    at = grid.lps(np.moveaxis(np.indices(grid.shape), 0, -1)).reshape(-1, 3)
    index = np.rint(small_lung.grid.ijk(at + truth.from_exhale(at))).astype(int)
    inside = ((index >= 0) & (index < np.asarray(small_lung.grid.shape))).all(axis=1)
    inside[inside] = (small_lung.labels[tuple(index[inside].T)] & OUTSIDE) == 0
    return Volume(grid=grid, array=inside.reshape(grid.shape))


@pytest.fixture(scope="module")
def motion(small_phantom: Phantom, truth: PhantomBreathing, small_lung: Lung, exhaled: Volume) -> Motion:
    source = replace(truth.source(small_phantom), other_lungs=exhaled)
    return prepare_motion(source, small_lung.labels, small_lung.grid, float(small_lung.tree.carina_lps[0]))


def test_the_true_motion_leads_lungs_onto_lungs(motion: Motion, small_lung: Lung, exhaled: Volume) -> None:
    figures = motion.figures
    assert figures["lungs_dice"] > 0.98 > figures["lungs_dice_unmoved"]
    assert figures["lungs_borders_mm"] < 1.0
    still = replace(motion, amplitude=0.0)
    unmoved = require_onto_lungs(still, small_lung.labels, small_lung.grid, exhaled)
    assert unmoved["lungs_borders_mm"] > figures["lungs_borders_mm"]
    assert unmoved["lungs_dice"] == unmoved["lungs_dice_unmoved"]


def test_a_motion_that_leads_away_and_lungs_of_another_are_refused(
    motion: Motion, small_lung: Lung, exhaled: Volume
) -> None:
    away = replace(motion, nodes=-motion.nodes)
    aside = Volume(grid=replace(exhaled.grid, lps_from_ijk=_moved(exhaled.grid)), array=exhaled.array)
    for other, mask in ((away, exhaled), (motion, aside)):
        with pytest.raises(AnatomyError, match="onto the other lungs with a Dice of"):
            require_onto_lungs(other, small_lung.labels, small_lung.grid, mask)


def _moved(grid: Grid) -> np.ndarray:
    matrix = grid.lps_from_ijk.copy()
    matrix[0, 3] += 40.0
    return matrix

"""Airway trees of real lungs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from anatomy.io.images import read_mask
from anatomy.tree import tree_from_mask
from tests.anatomy.tubes import outside_mm


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize(("patient", "generations"), [("Patient1", 7), ("Patient2", 12)])
def test_tree_of_a_patient(data_dir: Path, patient: str, generations: int):
    lumen = read_mask(data_dir / "med-rad" / patient / "bronchialTree.nii.gz")
    tree = tree_from_mask(lumen)
    assert outside_mm(tree, lumen) == 0.0
    assert (tree.radius_mm > 0).all()
    assert tree.report.gaps_bridged == ()
    assert tree.report.warnings == ()
    assert tree.generation.max() == generations
    assert tree.points_lps[0, 2] > tree.carina_lps[2] + 80
    main = sorted(tree.children(0), key=lambda b: tree.points_lps[tree.branch_points(b)[-1], 0])
    assert len(main) == 2
    right, left = main
    # The left main bronchus is on the patient's left (+x), longer and thinner than the right one.
    assert tree.points_lps[tree.branch_points(left)[-1], 0] > tree.carina_lps[0] + 20
    assert tree.points_lps[tree.branch_points(right)[-1], 0] < tree.carina_lps[0] - 10
    assert tree.branch_length_mm[left] > 1.5 * tree.branch_length_mm[right]
    assert tree.branch_mean_radius_mm[left] < tree.branch_mean_radius_mm[right]
    steps = np.linalg.norm(tree.points_lps[1:] - tree.points_lps[tree.parent_point[1:]], axis=1)
    assert 0.4 < np.median(steps) < 1.0
    assert steps.max() < 1.2


@pytest.mark.slow
@pytest.mark.data
@pytest.mark.parametrize("patient", ["Patient1", "Patient2"])
def test_every_part_of_the_lumen_is_near_its_tree(data_dir: Path, patient: str):
    from scipy.spatial import KDTree

    lumen = read_mask(data_dir / "med-rad" / patient / "bronchialTree.nii.gz")
    tree = tree_from_mask(lumen)
    voxels = lumen.grid.lps(np.argwhere(lumen.array))
    distance, index = KDTree(tree.points_lps).query(voxels, k=32)
    assert (distance - 2.0 * tree.radius_mm[index]).min(axis=1).max() < 4.0

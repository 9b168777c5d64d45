"""What a user should look at before trusting an airway tree."""

from __future__ import annotations

import numpy as np

from anatomy.airway_tree import AirwayTree

ADULT_TRACHEA_MM = (5.0, 14.0)
"""Radii between which the trachea of an adult lies, wide disease included."""

MAIN_LENGTH_RATIO = 0.8
"""The left main bronchus is about twice as long as the right one; less than this share of it means a
mirrored image."""
SHORT_TRACHEA_RADII = 6.0
"""A trachea is about twelve radii long; below half of that it is taken for cut."""


def warnings_of(tree: AirwayTree) -> tuple[str, ...]:
    """List what is unusual about a tree, one sentence each."""
    found = []
    radius = float(np.median(tree.radius_mm[tree.branch_points(0)]))
    length = float(tree.branch_length_mm[0])
    if not ADULT_TRACHEA_MM[0] <= radius <= ADULT_TRACHEA_MM[1]:
        low, high = ADULT_TRACHEA_MM
        found.append(f"The trachea has the radius {radius:.1f} mm; in adults it is {low:g} to {high:g} mm.")
    if length < SHORT_TRACHEA_RADII * radius:
        found.append(f"Only {length:.0f} mm of the trachea are in the mask.")
    if _looks_mirrored(tree):
        found.append(
            "The main bronchus on the patient's left is the shorter one; it is the right one in nearly "
            "everybody. Check that the mask is not mirrored."
        )
    return tuple(found)


def _looks_mirrored(tree: AirwayTree) -> bool:
    """Tell whether the first division has its shorter branch on the left (LPS +x)."""
    main = [b for b in tree.children(0) if tree.parent_point[tree.branch_start[b]] == tree.carina_point]
    if len(main) != 2 or any(len(tree.children(b)) == 0 for b in main):
        return False
    ends = tree.points_lps[[tree.branch_start[b + 1] - 1 for b in main]]
    left = main[int(np.argmax(ends[:, 0]))]
    right = main[int(np.argmin(ends[:, 0]))]
    return bool(tree.branch_length_mm[left] < MAIN_LENGTH_RATIO * tree.branch_length_mm[right])

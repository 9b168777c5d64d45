"""Figures of a segmentation that tell a person where to look before trusting it."""

from typing import Any

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.segmentation.parts import Parts

LEAST_WIDE_MM = 2.5
"""A branch this much wider than its parent, and at least so wide, looks like a leak into the lung."""


@frozen_record
class Quality:
    """Figures and warnings about one segmentation; the tree is None if none could be made of the airway."""

    volumes_l: dict[str, float]
    tree: AirwayTree | None
    ends: int
    warnings: tuple[str, ...]

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for a record."""
        tree = self.tree
        return {
            "volumes_l": {name: round(volume, 5) for name, volume in self.volumes_l.items()},
            "airway": {
                "ends": self.ends,
                "branches": 0 if tree is None else int(tree.n_branches),
                "deepest_generation": 0 if tree is None else int(tree.generation.max()),
                "length_mm": 0.0 if tree is None else round(float(tree.branch_length_mm.sum()), 1),
                "gaps_bridged": 0 if tree is None else len(tree.report.gaps_bridged),
                "loops_opened": 0 if tree is None else len(tree.report.loops_opened),
            },
            "warnings": list(self.warnings),
        }


def quality_of(parts: Parts) -> Quality:
    """Measure a segmentation."""
    litre = parts.ct.grid.voxel_volume_mm3 * 1e-6
    counted = {
        "right lung": parts.right,
        "left lung": parts.left,
        "airway lumen": parts.lumen,
        "airway wall": parts.wall,
        "large vessels": parts.large_vessels,
        "all vessels": parts.all_vessels,
        "nodule": parts.nodule,
    }
    volumes = {name: float(np.count_nonzero(mask)) * litre for name, mask in counted.items()}
    warnings = _volume_warnings(volumes)
    tree = parts.tree
    if isinstance(tree, AnatomyError):
        failed = f"No airway tree could be made: {tree}"
        return Quality(volumes_l=volumes, tree=None, ends=0, warnings=(*warnings, failed))
    ends = sum(len(tree.children(branch)) == 0 for branch in range(tree.n_branches))
    warnings += [*tree.report.warnings, *_leaks(tree)]
    return Quality(volumes_l=volumes, tree=tree, ends=ends, warnings=tuple(warnings))


def _volume_warnings(volumes: dict[str, float]) -> list[str]:
    both = volumes["right lung"] + volumes["left lung"]
    # From a child to a large adult after breathing in.
    least, most = (1.5, 9.0)
    if least <= both <= most:
        return []
    return [f"The lungs have {both:.2f} l in all; {least:g} to {most:g} l are usual in adults."]


def _leaks(tree: AirwayTree) -> list[str]:
    """Warn of branches that are much wider than what they grow from."""
    radius = np.asarray(tree.branch_mean_radius_mm)
    parent = np.asarray(tree.branch_parent)
    # A bronchus is never so much wider than its parent; a leak is.
    wide = (parent >= 0) & (radius >= LEAST_WIDE_MM) & (radius > 1.6 * radius[np.maximum(parent, 0)])
    found = []
    for branch in np.flatnonzero(wide):
        place = ", ".join(f"{x:.0f}" for x in tree.points_lps[tree.branch_start[branch + 1] - 1])
        found.append(
            f"Leak suspected at LPS ({place}) mm: an airway of {radius[branch]:.1f} mm radius grows "
            f"from one of {radius[parent[branch]]:.1f} mm."
        )
    return found

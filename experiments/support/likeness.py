"""How a lung is built, in numbers that a synthetic and a real one can be compared by.

All of it is measured on the finished `Lung`, so that both kinds of lung go through the same segmentation of
the airway into branches, and what a mask does not show counts for neither.
"""

from __future__ import annotations

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.records import frozen_value
from anatomy.base.typed import Array, Float, Mask
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL

GENERATIONS = (1, 2, 3, 4, 5, 6, 7, 8)
DEPTHS_MM = ((2.0, 5.0), (5.0, 10.0), (10.0, 15.0), (15.0, 20.0), (20.0, 30.0), (30.0, 60.0))
"""Shells by distance to the pleura; nearer than 2 mm a mask is half a voxel of chance."""
FAR_MM = 60.0
"""So far from the carina no vessel is on its way from the heart into the lung."""
ENDS_MM = 2.0
"""The direction of a branch leaves out so much at its beginning, which lies in the parent."""
QUANTILES = (0.25, 0.5, 0.75)


@frozen_value
class Likeness:
    """The numbers of one lung.

    Args:
        lung_l: Volume of the lungs, litres.
        branches, deepest: Of the airway tree: how many branches, and the highest generation.
        length_mm, diameter_mm, angle_deg (mapping of int to tuple of 3 float): By generation, quartiles and
            median of the branches that end in a fork (length) or of all (others): arc length, inner diameter,
            and angle to the parent branch.
        vessel_share, far_vessel_share: Share of the lung's volume that vessels take up, by the shells of
            `DEPTHS_MM`: in all of the lung, and more than `FAR_MM` from the carina.
        clearance_mm (tuple of 3 float): Quartiles of the distance of free tissue, 5 to 25 mm from the pleura,
            from vessels and airways.
    """

    name: str
    lung_l: float
    branches: int
    deepest: int
    length_mm: dict[int, tuple[float, ...]]
    diameter_mm: dict[int, tuple[float, ...]]
    angle_deg: dict[int, tuple[float, ...]]
    vessel_share: tuple[float, ...]
    far_vessel_share: tuple[float, ...]
    clearance_mm: tuple[float, ...]


def likeness_of(lung: Lung) -> Likeness:
    """Measure a lung."""
    lengths, diameters, angles = _branches(lung.tree)
    labels = np.asarray(lung.labels)
    depth = _corner_distance(lung, "pleura")
    inside = (labels & OUTSIDE) == 0
    voxel_mm3 = float(np.prod(lung.grid.spacing_mm))
    shells = [inside & (depth >= low) & (depth < high) for low, high in DEPTHS_MM]
    far = _far_from_carina(lung)
    free = inside & ((labels & (AIRWAY | VESSEL | FISSURE)) == 0) & (depth >= 5.0) & (depth < 25.0)
    nearest = np.minimum(_corner_distance(lung, "vessel"), _corner_distance(lung, "airway"))
    return Likeness(
        name=lung.name,
        lung_l=float(inside.sum()) * voxel_mm3 * 1e-6,
        branches=lung.tree.n_branches,
        deepest=int(lung.tree.generation.max()),
        length_mm=lengths,
        diameter_mm=diameters,
        angle_deg=angles,
        vessel_share=tuple(_share(labels, VESSEL, shell) for shell in shells),
        far_vessel_share=tuple(_share(labels, VESSEL, shell & far) for shell in shells),
        clearance_mm=_quartiles(nearest[free]),
    )


def _share(labels: Array, bit: int, where: Array) -> float:
    return float(((labels[where] & bit) != 0).mean()) if where.any() else 0.0


def _far_from_carina(lung: Lung) -> Mask:
    """Return the voxels more than `FAR_MM` from the carina; the grid may lie aslant."""
    steps = np.asarray(lung.grid.lps_from_ijk)[:3, :3]
    away = lung.grid.lps(np.zeros(3)) - lung.tree.carina_lps
    index = np.ogrid[tuple(slice(n) for n in lung.grid.shape)]
    squared = sum((away[axis] + sum(steps[axis, d] * index[d] for d in range(3))) ** 2 for axis in range(3))
    return np.asarray(squared > FAR_MM**2)


def _quartiles(values: Array) -> tuple[float, ...]:
    return tuple(float(each) for each in np.quantile(values, QUANTILES)) if len(values) else ()


def _corner_distance(lung: Lung, name: str) -> Array:
    """Return the distance stored at the low corner of every voxel, mm: as good as that of its centre here."""
    stored = lung.fields[name].corners
    ni, nj, nk = lung.grid.shape
    return np.asarray(stored[:ni, :nj, :nk], dtype=np.float32) / np.float32(256.0)


def _branches(
    tree: AirwayTree,
) -> tuple[dict[int, tuple[float, ...]], dict[int, tuple[float, ...]], dict[int, tuple[float, ...]]]:
    """Return quartiles of length, diameter and angle by generation."""
    forks = np.zeros(tree.n_branches, dtype=np.bool_)
    forks[tree.branch_parent[1:]] = True
    length = np.array([_length_mm(tree, branch) for branch in range(tree.n_branches)])
    diameter = np.array(
        [2.0 * float(np.median(tree.radius_mm[tree.branch_points(b)])) for b in range(tree.n_branches)]
    )
    directions = np.array([_direction(tree, branch) for branch in range(tree.n_branches)])
    cosine = (directions[1:] * directions[tree.branch_parent[1:]]).sum(axis=1)
    angle = np.concatenate([[0.0], np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))])
    found: list[dict[int, tuple[float, ...]]] = []
    for values, chosen in ((length, forks), (diameter, np.ones_like(forks)), (angle, np.ones_like(forks))):
        found.append({g: _quartiles(values[chosen & (tree.generation == g)]) for g in GENERATIONS})
    return found[0], found[1], found[2]


def _polyline(tree: AirwayTree, branch: int) -> Float:
    nodes = tree.branch_points(branch)
    hangs_on = int(tree.parent_point[nodes[0]])
    return np.asarray(tree.points_lps[nodes if hangs_on < 0 else np.append(hangs_on, nodes)])


def _length_mm(tree: AirwayTree, branch: int) -> float:
    return float(np.linalg.norm(np.diff(_polyline(tree, branch), axis=0), axis=1).sum())


def _direction(tree: AirwayTree, branch: int) -> Float:
    """Return the unit chord of a branch without its first millimetres."""
    line = _polyline(tree, branch)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    begin = min(ENDS_MM, 0.3 * along[-1])
    start = np.array([np.interp(begin, along, line[:, axis]) for axis in range(3)])
    chord = line[-1] - start
    return np.asarray(chord / max(float(np.linalg.norm(chord)), 1e-9))

"""The equivalent resistance of airways [Pan2025, eq. 3]."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float
from anatomy.grid import read_only

EXAMPLE_BETA = 2.5
"""With this weight the paper's worked example gives what it prints; with its stated 0.2 it does not."""


@settings
class Resistances:
    """Weights of the equivalent resistance [Pan2025, eq. 3], with the values that the paper states.

    Its worked example needs beta = 2.5, see `EXAMPLE_BETA`.  Angles are those with the preceding branch, in
    rad.  Down to which generation branches have cartilage is a reading: the paper tells it case by case.
    """

    alpha: Annotated[float, quantity("weight of length over diameter", at_least=0.0, at_most=1e3)] = 1.0
    beta: Annotated[float, quantity("weight of the angle", at_least=0.0, at_most=1e3)] = 0.2
    gamma: Annotated[float, quantity("weight of cartilage", at_least=0.0, at_most=1e3)] = 0.5
    eta: Annotated[float, quantity("resistance of a lesion", above=0.0, at_most=1e6)] = 1.0
    cartilage_generations: Annotated[int, quantity("generations with cartilage", at_least=0, at_most=30)] = 10

    def of(self, length_mm: float, diameter_mm: float, angle_rad: float, cartilage: float) -> float:
        """Return Z = alpha L / D + beta C + gamma B of one branch [Pan2025, eq. 3]."""
        return self.alpha * length_mm / diameter_mm + self.beta * angle_rad + self.gamma * cartilage


def branch_resistances(tree: AirwayTree, weights: Resistances) -> Float:
    """Return the resistance of every branch of a tree, `(B,)`.

    The angle is the one between the chord of a branch and that of its parent; that of the trachea is 0.
    """
    first, last = tree.branch_start[:-1], tree.branch_start[1:] - 1
    hook = np.where(tree.parent_point[first] < 0, first, tree.parent_point[first])
    chord = tree.points_lps[last] - tree.points_lps[hook]
    size = np.linalg.norm(chord, axis=1)
    direction = np.where(size[:, None] > 0, chord / np.maximum(size, 1e-12)[:, None], tree.tangents[last])
    parent = np.where(tree.branch_parent < 0, 0, tree.branch_parent)
    angle = np.arccos(np.clip(np.einsum("ij,ij->i", direction, direction[parent]), -1.0, 1.0))
    angle[0] = 0.0
    diameter = 2.0 * np.maximum(tree.branch_mean_radius_mm, 1e-3)
    cartilage = tree.generation <= weights.cartilage_generations
    z = (
        weights.alpha * tree.branch_length_mm / diameter
        + weights.beta * angle
        + weights.gamma * cartilage.astype(np.float64)
    )
    return read_only(np.asarray(z, dtype=np.float64))

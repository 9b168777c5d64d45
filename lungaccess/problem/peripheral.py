"""Random targets in the periphery of the lung, as in the studies of [Kuntz2015]."""

import numpy as np

from anatomy.base.errors import TargetError
from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL

PLEURA_MM = (5.0, 25.0)
"""Distances from the pleura between which targets count as peripheral: near it, but not at it."""
CLEAR_MM = 3.0
"""Least clearance of a target, about twice what the presets' needles require with their margins."""
DRAWS_A_POINT = 100_000
"""So many random points in a row without a target end the search for one; a lung needs some hundred."""


def peripheral_targets(lung: Lung, per_lung: int, seed: int) -> Float:
    """Draw targets `(2 per_lung, 3)` LPS mm, 5 to 25 mm from the pleura and at least 3 mm clear of all else.

    Those of the patient's left lung come first.  TargetError is raised if one side has none.
    """
    rng = np.random.default_rng(seed)
    points = [_peripheral_point(lung, rng, side) for side in (1.0, -1.0) for _ in range(per_lung)]
    return np.array(points, dtype=np.float64).reshape(-1, 3)


def _peripheral_point(lung: Lung, rng: np.random.Generator, side: float) -> Float:
    midline = lung.tree.carina_lps[0]
    for _ in range(DRAWS_A_POINT):
        point = lung.grid.lps(rng.uniform(-0.5, np.array(lung.grid.shape) - 0.5))
        if (point[0] - midline) * side > 0 and _is_peripheral(lung, point):
            return point
    raise TargetError(
        f"{lung.name} has no peripheral target in its {'left' if side > 0 else 'right'} lung: "
        f"none of {DRAWS_A_POINT} random points is one",
        expected=f"lung tissue {PLEURA_MM[0]:g} to {PLEURA_MM[1]:g} mm from the pleura and "
        f"{CLEAR_MM:g} mm clear of airways and vessels, on both sides of the carina",
        remedy="State the targets one by one",
    )


def _is_peripheral(lung: Lung, point: Float) -> bool:
    if lung.label_at(point) & (AIRWAY | VESSEL | OUTSIDE | FISSURE):
        return False
    low, high = PLEURA_MM
    return bool(
        low <= lung.fields["pleura"].lower_bound_mm(point)[0] <= high
        and lung.fields["obstacle"].lower_bound_mm(point)[0] >= CLEAR_MM
    )

"""Where the tip of a scope may be: beside the medial axis, looking on along the airway.

Proofs that a target is unreachable rule out all of this region, so every tip of a motion lies in it.
"""

from __future__ import annotations

import math

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.typed import Bool, Float, Int

MAX_OFF_AXIS_MM = 3.0
"""A tip lies at most so far from the nearest point of the tree.

That holds the whole cross-section which thin scopes leave free in bronchi of 10 mm, beyond which tubes leave.
"""
MAX_TURN_AT_TIP_RAD = math.radians(45.0)
"""A tip looks along the airway, within this angle of its direction: more means sideways."""


def in_tip_region(tree: AirwayTree, tips: Float) -> tuple[Int, Bool]:
    """Return the nearest tree point of each tip `(S,)`, and whether the tip lies in the region `(S,)`.

    Parameters
    ----------
    tips : (S, >= 6) float64
        Point and unit direction of each tip, LPS mm.
    """
    distance_mm, nearest = tree.nearest_point_index.query(tips[:, :3])
    cosine = np.einsum("sk,sk->s", tips[:, 3:6], tree.tangents[nearest])
    inside = (distance_mm <= MAX_OFF_AXIS_MM) & (cosine >= math.cos(MAX_TURN_AT_TIP_RAD))
    return np.asarray(nearest, dtype=np.int64), np.asarray(inside)

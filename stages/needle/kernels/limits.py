"""The needle's limits as an array of numbers.

`limits` is a `(N_LIMITS,)` float64 array indexed by the constants below; lengths in mm, angles in
radians, curvature in 1/mm.
"""

from __future__ import annotations

KAPPA = 0
MAX_LENGTH = 1
MAX_ANGLE = 2
MAX_TURN = 3
REQUIRED = 4
RADIUS = 5
EXEMPT_LENGTH = 6
MAX_STEP = 7
COST_STEP = 8
GOAL_TOLERANCE = 9
LOOKUP_STEP = 10
"""0: arcs are proved clear.  More: voxels are looked up at steps of so many mm, which proves nothing."""
N_LIMITS = 11

TINY = 1e-9
MIN_ARC_MM = 1e-6
"""Shorter arcs are no arcs."""

"""The needle's limits, as the kernels take them."""

from typing import NamedTuple

TINY = 1e-9
"""Rounding of limits, distances and shares that the kernels allow for."""
MIN_ARC_MM = 1e-6
"""Shorter arcs are no arcs."""


class Limits(NamedTuple):
    """What a needle keeps, and how finely its paths are looked at.

    Parameters
    ----------
    kappa : float
        Greatest curvature, 1/mm.
    max_angle_rad : float
        Greatest angle between the tip and its direction at the start.
    max_turn_rad : float
        Greatest sum of all turning.
    required_mm : float
        Clearance that the needle's axis keeps.
    radius_mm : float
        Radius of the needle.
    exempt_mm : float
        First length of the needle that may touch the wall of the pierced branch.
    max_step_mm : float
        Longest arc of a tree.
    cost_step_mm : float
        Longest step of integrals of 1 / clearance.
    goal_tolerance_mm : float
        How far from the target a path may end.
    leaving_sine : float
        0: the needle begins in tissue.  More: it begins at the wall of the pierced branch, in or beside its
        lumen, and leaves it at this sine of an angle or more, see `stages.needle.kernels.proof.exact_gap`.
    lookup_step_mm : float
        0: arcs are proved clear.  More: voxels are looked up at steps of so many mm, which proves nothing.
    """

    kappa: float
    max_length_mm: float
    max_angle_rad: float
    max_turn_rad: float
    required_mm: float
    radius_mm: float
    exempt_mm: float
    max_step_mm: float
    cost_step_mm: float
    goal_tolerance_mm: float
    leaving_sine: float = 0.0
    lookup_step_mm: float = 0.0

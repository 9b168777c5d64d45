"""Compiled kernels of the needle stage that its rooms share, and those that the coupled planner calls."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from stages.needle.kernels.connections import least_cosine, single_arc_exceeds
    from stages.needle.kernels.cost import CLEARANCE_FLOOR_MM, ObjectiveArrays, cost_of_arc, map_costs_on_arc
    from stages.needle.kernels.proof import Limits, Obstacles, blocker_on_arc, exact_gap

__getattr__, __dir__ = lazy_exports(__name__, __file__)

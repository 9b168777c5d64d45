"""Compiled kernels of the needle stage that its rooms share, and those that the coupled planner calls."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from stages.needle.kernels.connections import least_cosine as least_cosine
    from stages.needle.kernels.connections import single_arc_exceeds as single_arc_exceeds
    from stages.needle.kernels.cost import CLEARANCE_FLOOR_MM as CLEARANCE_FLOOR_MM
    from stages.needle.kernels.cost import ObjectiveArrays as ObjectiveArrays
    from stages.needle.kernels.cost import cost_of_arc as cost_of_arc
    from stages.needle.kernels.cost import map_costs_on_arc as map_costs_on_arc
    from stages.needle.kernels.limits import Limits as Limits
    from stages.needle.kernels.proof import Obstacles as Obstacles
    from stages.needle.kernels.proof import blocker_on_arc as blocker_on_arc

__getattr__, __dir__ = lazy_exports(__name__, __file__)

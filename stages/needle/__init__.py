"""The steerable needle: paths of arcs, searches for them, and proofs that there are none."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from stages.needle.costs import map_integral as map_integral
    from stages.needle.costs import obstacle_clearance_mm as obstacle_clearance_mm
    from stages.needle.costs import path_costs as path_costs
    from stages.needle.device import Needle as Needle
    from stages.needle.environment import RRT_STEP_MM as RRT_STEP_MM
    from stages.needle.environment import NeedleEnvironment as NeedleEnvironment
    from stages.needle.environment import direct_arcs as direct_arcs
    from stages.needle.environment import needle_environment as needle_environment
    from stages.needle.environment import workspace_lengths as workspace_lengths
    from stages.needle.kernels.cost import ObjectiveArrays as ObjectiveArrays
    from stages.needle.kernels.limits import Limits as Limits
    from stages.needle.kernels.proof import Obstacles as Obstacles
    from stages.needle.objective import NO_MAP as NO_MAP
    from stages.needle.objective import SHORTEST as SHORTEST
    from stages.needle.objective import TERMS as TERMS
    from stages.needle.objective import Objective as Objective
    from stages.needle.path import CURVATURE as CURVATURE
    from stages.needle.path import ArcPath as ArcPath
    from stages.needle.path import arc_transform as arc_transform
    from stages.needle.path import bend_direction as bend_direction
    from stages.needle.path import direct_path as direct_path
    from stages.needle.query import Query as Query
    from stages.needle.reach import DEFAULT_ARCS as DEFAULT_ARCS
    from stages.needle.reach import DIRECT as DIRECT
    from stages.needle.reach import NO_CLEARANCE as NO_CLEARANCE
    from stages.needle.reach import SEARCHED as SEARCHED
    from stages.needle.reach import UNREACHED as UNREACHED
    from stages.needle.reach import Reached as Reached
    from stages.needle.reach import ReachScan as ReachScan
    from stages.needle.search.base import Search as Search
    from stages.needle.search.optimal import OptimalSearch as OptimalSearch
    from stages.needle.search.planners import PLANNERS as PLANNERS
    from stages.needle.search.portfolio import PortfolioSearch as PortfolioSearch
    from stages.needle.search.successive_halving import successive_halving as successive_halving
    from stages.needle.start_index import StartIndex as StartIndex
    from stages.needle.violations import violation as violation

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""The steerable needle: paths of arcs, searches for them, and proofs that there are none.

A `Query` in a `NeedleEnvironment` is answered by a `Search`, by name in `PLANNERS`, which looks for an
`ArcPath` of low `Objective`; `violation` and `path_costs` tell how good a path is, whoever found it.
`NoPathProof` proves that there is none, `Replanner` plans again during the insertion, and `ReachScan` asks
about many points at once.  The planners of OMPL are in `stages.needle.ompl`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from stages.needle.costs import inverse_clearance as inverse_clearance
    from stages.needle.costs import map_integral as map_integral
    from stages.needle.costs import obstacle_clearance_mm as obstacle_clearance_mm
    from stages.needle.costs import path_costs as path_costs
    from stages.needle.costs import voxel_sum as voxel_sum
    from stages.needle.costs import voxels_crossed as voxels_crossed
    from stages.needle.device import Needle as Needle
    from stages.needle.environment import RRT_STEP_MM as RRT_STEP_MM
    from stages.needle.environment import NeedleEnvironment as NeedleEnvironment
    from stages.needle.environment import direct_arcs as direct_arcs
    from stages.needle.environment import environment_of_labels as environment_of_labels
    from stages.needle.environment import needle_environment as needle_environment
    from stages.needle.environment import workspace_lengths as workspace_lengths
    from stages.needle.infeasibility.certificate import NoPathProof as NoPathProof
    from stages.needle.kernels.cost import ObjectiveArrays as ObjectiveArrays
    from stages.needle.kernels.limits import Limits as Limits
    from stages.needle.kernels.proof import Obstacles as Obstacles
    from stages.needle.objective import NO_MAP as NO_MAP
    from stages.needle.objective import SHORTEST as SHORTEST
    from stages.needle.objective import TERMS as TERMS
    from stages.needle.objective import Objective as Objective
    from stages.needle.objective import Term as Term
    from stages.needle.path import CURVATURE as CURVATURE
    from stages.needle.path import LENGTH as LENGTH
    from stages.needle.path import ROLL as ROLL
    from stages.needle.path import ArcPath as ArcPath
    from stages.needle.path import arc_transform as arc_transform
    from stages.needle.path import bend_direction as bend_direction
    from stages.needle.path import blocker_on_path as blocker_on_path
    from stages.needle.path import direct_path as direct_path
    from stages.needle.query import Query as Query
    from stages.needle.reach import DEFAULT_ARCS as DEFAULT_ARCS
    from stages.needle.reach import DIRECT as DIRECT
    from stages.needle.reach import NO_CLEARANCE as NO_CLEARANCE
    from stages.needle.reach import SEARCHED as SEARCHED
    from stages.needle.reach import UNREACHED as UNREACHED
    from stages.needle.reach import Reached as Reached
    from stages.needle.reach import ReachScan as ReachScan
    from stages.needle.replanning.replanner import DEFAULT_SETTINGS as DEFAULT_SETTINGS
    from stages.needle.replanning.replanner import Failure as Failure
    from stages.needle.replanning.replanner import Replan as Replan
    from stages.needle.replanning.replanner import Replanner as Replanner
    from stages.needle.replanning.replanner import ReplanSettings as ReplanSettings
    from stages.needle.replanning.replanner import with_reserve as with_reserve
    from stages.needle.search.base import RestartingRRT as RestartingRRT
    from stages.needle.search.base import Search as Search
    from stages.needle.search.decision import Decision as Decision
    from stages.needle.search.optimal import OptimalSearch as OptimalSearch
    from stages.needle.search.planners import PLANNERS as PLANNERS
    from stages.needle.search.planners import MakeSearch as MakeSearch
    from stages.needle.search.portfolio import PortfolioSearch as PortfolioSearch
    from stages.needle.search.resolution import Cells as Cells
    from stages.needle.search.resolution import Outcome as Outcome
    from stages.needle.search.resolution import Resolution as Resolution
    from stages.needle.search.resolution import ResolutionSearch as ResolutionSearch
    from stages.needle.search.successive_halving import successive_halving as successive_halving
    from stages.needle.start_index import StartIndex as StartIndex
    from stages.needle.violations import violation as violation

__getattr__, __dir__ = lazy_exports(__name__, __file__)

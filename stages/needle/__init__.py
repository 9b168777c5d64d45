"""The steerable needle: paths of arcs, searches for them, and proofs that there are none.

A `Query` in a `NeedleEnvironment` is answered by a `Search`, by name in `searches`, which looks for an
`ArcPath` of low `Objective`; `violation` and `path_costs` tell how good a path is, whoever found it.
`NoPathProof` proves that there is none, `Replanner` plans again during the insertion, `ReachScan` asks
about many points at once, and `StartRegion` about many start poses.  The planners of OMPL are in
`stages.needle.ompl`.
"""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from stages.needle.costs import (
        InTissue,
        inverse_clearance,
        map_integral,
        obstacle_clearance_mm,
        path_costs,
        voxel_sum,
    )
    from stages.needle.device import Needle
    from stages.needle.environment import (
        RRT_STEP_MM,
        NeedleEnvironment,
        begun_at_wall,
        direct_arcs,
        environment_of_labels,
        needle_environment,
        workspace_lengths,
    )
    from stages.needle.infeasibility.certificate import NoPathProof
    from stages.needle.infeasibility.passage import NOT_BOUNDED, Passage, backward_reach
    from stages.needle.kernels.cost import ObjectiveArrays
    from stages.needle.kernels.proof import Limits, Obstacles
    from stages.needle.kernels.reach_arcs import DIRECT, NO_CLEARANCE, SEARCHED, UNREACHED
    from stages.needle.objective import DEFAULT, NO_MAP, SHORTEST, TERMS, Objective, Term
    from stages.needle.obstruction import Obstruction, easiest_obstruction, find_obstruction
    from stages.needle.path import (
        CURVATURE,
        LENGTH,
        ArcPath,
        Query,
        arc_transform,
        bend_direction,
        blocker_on_path,
        direct_path,
        violation,
    )
    from stages.needle.planner_choice import has_ompl, require_planner
    from stages.needle.planner_names import NEEDLE_PLANNERS, OMPL_PLANNERS, OMPL_TOLERANCE_MM, OUR_PLANNERS
    from stages.needle.reach import BLOCK_MM, DEFAULT_ARCS, Reached, ReachScan, StartIndex
    from stages.needle.replanning.insertion import Belief, Commands, TrueNeedle, Unknown, steer
    from stages.needle.replanning.replanner import Failure, Replan, Replanner, ReplanSettings
    from stages.needle.search.base import RestartingRRT, Search, first_path
    from stages.needle.search.decision import Decision
    from stages.needle.search.optimal import OptimalSearch
    from stages.needle.search.planners import searches
    from stages.needle.search.portfolio import PortfolioSearch, successive_halving
    from stages.needle.search.resolution import Outcome, Resolution, ResolutionSearch
    from stages.needle.start_region import (
        KINDS,
        REACHING,
        StartRegion,
        TriedStarts,
        prove_starts,
        proved_factor,
    )
    from stages.needle.start_region_trial import try_around, try_poses, try_starts

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""The coupled planner: it searches for plans of all stages, diverse plan sets, and counterfactuals."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.planning.coupled.atlas import Atlas, atlas_is_kept, build_atlas, open_atlas
    from lungaccess.planning.coupled.counterfactuals import Counterfactual, needle_changes, scope_changes
    from lungaccess.planning.coupled.exits import FeasibleExits, feasible_exits
    from lungaccess.planning.coupled.search.base import (
        Incumbent,
        ParallelSearch,
        PlanSearch,
        Step,
        evaluated_step,
    )
    from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
    from lungaccess.planning.coupled.search.direct_candidates import direct_candidates
    from lungaccess.planning.coupled.search.reach_scans import reach_scan

__getattr__, __dir__ = lazy_exports(__name__, __file__)

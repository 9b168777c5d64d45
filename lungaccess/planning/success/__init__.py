"""Plans that succeed: the search for the plan whose procedure most often ends well under given errors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.planning.success.diverse_plans import alternatives_for_success
    from lungaccess.planning.success.estimate import ChanceEstimator, Estimate, chance_of, estimate_success
    from lungaccess.planning.success.planner import PlannedSuccess, plan_for_success

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""Plans: what they hold, their files and costs, and their devices as curves."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.plans.costs import path_cost, path_costs
    from lungaccess.plans.curves import DeviceCurve, DeviceCurves
    from lungaccess.plans.file import SCHEMA
    from lungaccess.plans.no_plan import NoPlan
    from lungaccess.plans.parts import (
        Exemption,
        NeedleArc,
        NeedlePath,
        ScopeInsertion,
        TubeDeployment,
        WallExit,
    )
    from lungaccess.plans.plan import Plan

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""Plans: what they hold, their files and costs, and their devices as curves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.plans.costs import path_cost as path_cost
    from lungaccess.plans.costs import path_costs as path_costs
    from lungaccess.plans.curves import DeviceCurve as DeviceCurve
    from lungaccess.plans.curves import DeviceCurves as DeviceCurves
    from lungaccess.plans.file import SCHEMA as SCHEMA
    from lungaccess.plans.no_plan import NoPlan as NoPlan
    from lungaccess.plans.parts import Exemption as Exemption
    from lungaccess.plans.parts import NeedleArc as NeedleArc
    from lungaccess.plans.parts import NeedlePath as NeedlePath
    from lungaccess.plans.parts import ScopeRoute as ScopeRoute
    from lungaccess.plans.parts import TubeDeployment as TubeDeployment
    from lungaccess.plans.parts import WallExit as WallExit
    from lungaccess.plans.plan import Plan as Plan

__getattr__, __dir__ = lazy_exports(__name__, __file__)

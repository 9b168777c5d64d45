"""Plan safe access to lung nodules: bronchoscope, concentric tubes and steerable needle as one plan.

```python
import lungaccess as la

lung = la.load_patient("path/to/patient")
system = la.load_system("lung-default")
target = la.resolve_target(lung, "ras:64.9,201.1,1211.9")
for plan in la.plan(lung, system, target, time_s=10.0):
    print(plan.cost)
plan.save("plan.json")
print(la.check(plan, lung).accepted)
```
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from anatomy.airway_tree import AirwayTree as AirwayTree
    from anatomy.errors import LungaccessError as LungaccessError
    from anatomy.lung import Lung as Lung
    from lungaccess.checking import CheckReport as CheckReport
    from lungaccess.checking import check as check
    from lungaccess.coupled import Alternative as Alternative
    from lungaccess.coupled import Atlas as Atlas
    from lungaccess.coupled import alternatives as alternatives
    from lungaccess.coupled import build_atlas as build_atlas
    from lungaccess.coupled import open_atlas as open_atlas
    from lungaccess.coupled import plan as plan
    from lungaccess.one_stage import advise_scope as advise_scope
    from lungaccess.one_stage import deploy_tubes as deploy_tubes
    from lungaccess.one_stage import plan_needle as plan_needle
    from lungaccess.one_stage import plan_tour as plan_tour
    from lungaccess.plans.no_plan import NoPlan as NoPlan
    from lungaccess.plans.plan import Plan as Plan
    from lungaccess.problem import System as System
    from lungaccess.problem import Target as Target
    from lungaccess.problem import load_patient as load_patient
    from lungaccess.problem import load_system as load_system
    from lungaccess.problem import peripheral_targets as peripheral_targets
    from lungaccess.problem import point_target as point_target
    from lungaccess.problem import preset_names as preset_names
    from lungaccess.problem import resolve_target as resolve_target
    from lungaccess.reachability import UnreachableProof as UnreachableProof
    from lungaccess.reachability import compare_reach as compare_reach
    from lungaccess.reachability import map_reach as map_reach
    from lungaccess.report.html import plan_page as plan_page
    from lungaccess.risk import ErrorModel as ErrorModel
    from lungaccess.risk import assess as assess
    from lungaccess.risk import find_tolerances as find_tolerances
    from lungaccess.risk import load_errors as load_errors
    from lungaccess.slicer import export_slicer as export_slicer
    from lungaccess.study import read_study as read_study
    from lungaccess.study import run_study as run_study
    from stages.needle import Objective as Objective

__getattr__, __dir__ = lazy_exports(__name__, __file__)

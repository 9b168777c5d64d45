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

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from anatomy.airway_tree import AirwayTree
    from anatomy.base.errors import LungaccessError
    from anatomy.lung import Lung
    from lungaccess.judging import plan_with_presets
    from lungaccess.judging.appraisal import Appraisal, appraise
    from lungaccess.judging.checking import CheckReport, check
    from lungaccess.judging.explanation import Explanation, explain_no_plan, save_explanation
    from lungaccess.planning.coupled import (
        Alternative,
        Atlas,
        FeasibleExits,
        alternatives,
        build_atlas,
        feasible_exits,
        open_atlas,
        plan,
        plan_for_window,
    )
    from lungaccess.planning.one_stage import (
        advise_scope,
        deploy_tubes,
        plan_near_exit,
        plan_near_scope_tip,
        plan_needle,
        plan_tour,
        replan_from_scope,
        replan_from_tube,
        safe_scope_region,
    )
    from lungaccess.planning.procedure import Procedure, load_procedure, simulate_procedure
    from lungaccess.planning.reachability import UnreachableProof, compare_reach, map_reach, plan_to_voxel
    from lungaccess.planning.success import PlannedSuccess, alternatives_for_success, plan_for_success
    from lungaccess.plans.no_plan import NoPlan
    from lungaccess.plans.plan import Plan
    from lungaccess.plans.window import BreathingWindow
    from lungaccess.problem import (
        Place,
        System,
        Target,
        describe_place,
        load_patient,
        load_system,
        peripheral_targets,
        point_target,
        preset_names,
        presets_by_invasiveness,
        resolve_target,
    )
    from lungaccess.showing.report.html import plan_page
    from lungaccess.showing.slicer import export_slicer
    from lungaccess.study import read_study, run_study
    from lungaccess.uncertainty.breathing.window import breathing_window
    from lungaccess.uncertainty.risk import (
        ErrorModel,
        assess,
        find_tolerances,
        load_errors,
        safe_start_region,
    )
    from stages.needle import Objective

__getattr__, __dir__ = lazy_exports(__name__, __file__)

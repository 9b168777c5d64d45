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
    from lungaccess.checking import check as check
    from lungaccess.coupled.atlas import Atlas as Atlas
    from lungaccess.coupled.atlas import build_atlas as build_atlas
    from lungaccess.coupled.planner import plan as plan
    from lungaccess.plans.no_plan import NoPlan as NoPlan
    from lungaccess.plans.plan import Plan as Plan
    from lungaccess.problem.patients import load_patient as load_patient
    from lungaccess.problem.system import System as System
    from lungaccess.problem.system import load_system as load_system
    from lungaccess.problem.system import preset_names as preset_names
    from lungaccess.problem.target import Target as Target
    from lungaccess.problem.target import resolve_target as resolve_target
    from stages.needle import Objective as Objective

__getattr__, __dir__ = lazy_exports(__name__, __file__)

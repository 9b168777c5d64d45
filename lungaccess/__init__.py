"""Plan safe access to lung nodules: bronchoscope, concentric tubes and steerable needle as one plan.

```python
import lungaccess as la

lung = la.load_patient("path/to/patient")
system = la.load_system("lung-default")
target = la.resolve_target(lung, "ras:64.9,201.1,1211.9")
for plan in la.plan(lung, system, target, time_s=10.0):
    print(plan.costs["inverse_clearance"])
plan.save("plan.json")
print(la.check(plan, lung).accepted)
```
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

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

_HOME = {
    "AirwayTree": "anatomy.airway_tree",
    "Atlas": "lungaccess.coupled.atlas",
    "Lung": "anatomy.lung",
    "LungaccessError": "anatomy.errors",
    "NoPlan": "lungaccess.plans.no_plan",
    "Plan": "lungaccess.plans.plan",
    "System": "lungaccess.problem.system",
    "Target": "lungaccess.problem.target",
    "build_atlas": "lungaccess.coupled.atlas",
    "check": "lungaccess.checking",
    "load_patient": "lungaccess.problem.patients",
    "load_system": "lungaccess.problem.system",
    "plan": "lungaccess.coupled.planner",
    "preset_names": "lungaccess.problem.system",
    "resolve_target": "lungaccess.problem.target",
}

__all__ = [
    "AirwayTree",
    "Atlas",
    "Lung",
    "LungaccessError",
    "NoPlan",
    "Plan",
    "System",
    "Target",
    "build_atlas",
    "check",
    "load_patient",
    "load_system",
    "plan",
    "preset_names",
    "resolve_target",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that `import lungaccess` stays light."""
    if name not in _HOME:
        raise AttributeError(f"module 'lungaccess' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])

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

from anatomy.base.facade import lazy_exports

__getattr__, __dir__ = lazy_exports(__name__, __file__)

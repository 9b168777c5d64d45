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

import importlib.util
import os.path
import sys

for _name in ("anatomy", "stages"):
    _found = importlib.util.find_spec(_name)
    _place = os.path.dirname(os.path.dirname(os.path.realpath(__file__)))
    if _found is None or not os.path.realpath(_found.origin or "").startswith(os.path.join(_place, _name)):
        _said = (
            f"The package {_name} of lungaccess is hidden by {_found and _found.origin}, which Python finds "
            f"before {os.path.join(_place, _name)}. Rename what hides it, or run from another folder"
        )
        if sys.argv[:1] == ["-m"]:
            # Of `python -m lungaccess`, which would end with 1, the exit code of the answer "no".
            sys.stderr.write(_said + "\n")
            sys.exit(2)
        raise ImportError(_said)

from anatomy.base.facade import lazy_exports  # noqa: E402 -- it is known now whose package that is

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""Plan all three stages to a nodule.

`la.plan` yields a plan whenever it finds a better one. The same seed and number of iterations give the
same plans. The independent check judges the last plan before it is stored.
"""

import lungaccess as la
from lungaccess.showing.report import overview_png

lung = la.load_patient("phantom-3")
system = la.load_system("ultrathin")
target = la.resolve_target(lung, nodule=1)
for plan in la.plan(lung, system, target, iterations=100, seed=0, goal="default"):
    print(f"integral of 1 / clearance: {plan.costs['inverse_clearance']:.2f}")

print("accepted by the check:", la.check(plan, lung).accepted)
plan.save("plan.json")
overview_png(plan, lung, "coupled_plan.png")

"""Weigh several costs in one objective.

An objective is a cost or a weighted sum of costs. Here the length of the needle gets more and more weight
beside the integral of 1 / clearance. The picture shows both costs of the best plan for each weight.
"""

import matplotlib.pyplot as plt

import lungaccess as la

lung = la.load_patient("phantom-3")
system = la.load_system("ultrathin")
target = la.resolve_target(lung, nodule=1)
atlas = la.open_atlas(lung, system)  # what scope and tubes can do, for all searches
figure, ax = plt.subplots(figsize=(6, 4))
for weight in [0.0, 0.05, 0.2, 1.0]:
    objective = la.Objective(inverse_clearance=1.0, length=weight)
    *_worse, plan = la.plan(lung, system, target, goal=objective, atlas=atlas, iterations=100)
    ax.plot(plan.costs["length_mm"], plan.costs["inverse_clearance"], "o", label=f"{objective}")
ax.set(xlabel="length of the needle, mm", ylabel="integral of 1 / clearance", title="Weighted objectives")
ax.legend()
figure.savefig("objective.png")

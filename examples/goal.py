"""Add a goal of your own.

A goal is a function of a plan and its lung, and a word on which way is better. All that can be asked with
other goals can be asked with it: every device, constraint and search. A plan states its value, and is proved
and checked as any other. This one keeps the tip of the scope near the carina, where it is steered easily. The
picture shows what that costs.
"""

import matplotlib.pyplot as plt

import lungaccess as la


def beyond_carina(plan: la.Plan, lung: la.Lung) -> float:
    """Return how far the scope goes beyond the carina, mm along its body."""
    return float(plan.scope.length_from_carina_mm)


la.register_goal(la.Goal(name="shallow", words="scope beyond the carina", unit="mm", of=beyond_carina))
lung, system = la.load_patient("phantom-3"), la.load_system("lung-default")
target, atlas = la.resolve_target(lung, nodule=1), la.open_atlas(lung, system)
figure, ax = plt.subplots(figsize=(6, 4))
for goal in ["default", "shallow"]:
    *_, best = la.plan(lung, system, target, goal=goal, atlas=atlas, iterations=100)
    ax.scatter(beyond_carina(best, lung), best.costs["inverse_clearance"], label=goal, s=80)
ax.set(xlabel="scope beyond the carina, mm", ylabel="integral of 1 / clearance", title="Plans of two goals")
ax.legend(title="goal")
figure.savefig("goal.png")

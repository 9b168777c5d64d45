"""Plan for the chance of success, and what it trades.

The plan of least cost is far from everything, but not the one that most often succeeds. `plan_for_success`
makes the share of simulated procedures large that end in the nodule and touch nothing forbidden. Beside
both, a diverse plan set shows what success costs in length and clearance; a ring marks the plans that no
other beats in all three.
"""

import matplotlib.pyplot as plt

import lungaccess as la
from lungaccess.planning import with_front
from lungaccess.planning.success import chance_of, estimate_success

lung = la.load_patient("phantom-3")
system = la.load_system("ultrathin", fissures_allowed=True)
target = la.resolve_target(lung, nodule=1)
errors, procedure = la.load_errors("gated-ct"), la.load_procedure("open-loop")
atlas = la.open_atlas(lung, system)
*_, cheapest = la.plan(lung, system, target, atlas=atlas, iterations=50, goal="default")
*_, likeliest = la.plan_for_success(lung, system, target, errors=errors, atlas=atlas, iterations=10)
several = la.alternatives_for_success(lung, system, target, errors=errors, atlas=atlas, count=8)
plans = [cheapest, likeliest.plan, *(each.plan for each in several)]
# One luck for all: the draws that neither search has seen.
same = {"errors": errors, "procedure": procedure, "samples": 10_000, "seed": likeliest.plan.chance.seed}
rated = with_front(plans, [chance_of(estimate_success(plan, lung, **same)) for plan in plans])
figure, ax = plt.subplots(figsize=(7.5, 4.5))
lengths = [each.criteria["length_in_tissue_mm"] for each in rated]
shares = [100 * each.criteria["success"] for each in rated]
rings = ["red" if each.on_front else "none" for each in rated]
colours = [each.criteria["clearance_mm"] for each in rated]
dots = ax.scatter(lengths, shares, c=colours, edgecolors=rings, s=70, linewidths=2)
for name, length, share in zip(("least cost", "planned for success"), lengths, shares, strict=False):
    ax.annotate(name, (length, share), (-9, -4), textcoords="offset points", ha="right")
ax.set(xlabel="length in tissue, mm", ylabel="procedures that succeed, %", ylim=(0, 105))
figure.colorbar(dots, label="least clearance, mm")
figure.tight_layout()
figure.savefig("success.png")

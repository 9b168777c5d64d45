"""Plan for the chance of success, and what it trades.

The plan of least cost is far from everything, but not the one that most often succeeds. The goal of whoever
states none is success: the share of simulated procedures is made large that end in the nodule and touch
nothing forbidden. Beside it, a diverse plan set shows what success costs in length and clearance; a ring
marks the plans that no other beats in all three.
"""

import matplotlib.pyplot as plt

import lungaccess as la
from lungaccess.planning import with_front
from lungaccess.planning.success import chance_of, estimate_success

lung = la.load_patient("phantom-3")
system = la.load_system("ultrathin", fissures_allowed=True)
target, atlas = la.resolve_target(lung, nodule=1), la.open_atlas(lung, system)
assumed = {"errors": la.load_errors("gated-ct"), "procedure": la.load_procedure("open-loop")}
*_, cheapest = la.plan(lung, system, target, goal="default", atlas=atlas, iterations=50)
several = la.alternatives(lung, system, target, **assumed, atlas=atlas, count=8, iterations=10)
plans = [cheapest, *(each.plan for each in several)]
# One luck for all: the draws that the search has not seen.
same = {**assumed, "samples": 10_000, "seed": several[0].plan.chance.seed}
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

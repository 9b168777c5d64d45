"""Several plans to one target that differ.

`alternatives` returns a diverse plan set: every two needles are somewhere at least the separation apart.
A plan is on the Pareto front if no other plan of the set is at least as good in all criteria and better
in one.
"""

import matplotlib.pyplot as plt

import lungaccess as la
from lungaccess.coupled.alternatives import alternatives

lung = la.load_patient("phantom-3")
system = la.load_system("ultrathin")
target = la.resolve_target(lung, nodule=1)
found = alternatives(lung, system, target, count=8, separation_mm=5.0)
figure, ax = plt.subplots(figsize=(6, 4))
for number, each in enumerate(found, start=1):
    length, clearance = each.criteria["length_in_tissue_mm"], each.criteria["clearance_mm"]
    ax.plot(length, clearance, "o", color="C0" if each.on_front else "0.7")
    ax.annotate(str(number), (length, clearance), xytext=(4, 4), textcoords="offset points")
ax.set(xlabel="length in tissue, mm", ylabel="least clearance, mm", title="Diverse plans; front in blue")
figure.savefig("diverse_plans.png")

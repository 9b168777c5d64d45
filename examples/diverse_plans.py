"""Several plans to one target that differ.

`alternatives` returns a diverse plan set: every two needles are somewhere at least the separation apart.
The picture shows tubes and needles of the set from the front, over the airway tree.
"""

import matplotlib.pyplot as plt

import lungaccess as la

lung = la.load_patient("phantom-3")
system = la.load_system("ultrathin")
target = la.resolve_target(lung, nodule=1)
found = la.alternatives(lung, system, target, goal="default", count=8, separation_mm=5.0)
figure, ax = plt.subplots(figsize=(9, 5))
x, _y, z = lung.tree.points_lps.T
ax.plot(x, z, ".", color="0.8", markersize=2)
for number, each in enumerate(found, start=1):
    _scope, tubes, needle = each.plan.curves()
    length, clearance = each.criteria["length_in_tissue_mm"], each.criteria["clearance_mm"]
    label = f"{number}: {length:.0f} mm in tissue, clearance {clearance:.1f} mm"
    (line,) = ax.plot(tubes.points_lps[:, 0], tubes.points_lps[:, 2], linewidth=3)
    ax.plot(needle.points_lps[:, 0], needle.points_lps[:, 2], color=line.get_color(), label=label)
ax.plot(target.lps_mm[0], target.lps_mm[2], "k+", markersize=12)
ax.set(xlabel="LPS x, mm", ylabel="LPS z, mm", aspect="equal", title="A diverse plan set")
ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
figure.tight_layout()
figure.savefig("diverse_plans.png")

"""Lead a bronchoscope to a lesion.

The advisor computes motions of a real scope (advance, twist and bend), with its true radius inside the lumen.
The script prints instructions for each bifurcation. The picture shows the path of the tip from the front.
"""

import matplotlib.pyplot as plt

import lungaccess as la
from stages.scope.advisor import (
    Advisor,
    goal_at,
    instructions_along,
    lumen_of_lung,
    model_of,
    start_state,
    why_stopped,
)

lung = la.load_patient("phantom-3")
target = la.resolve_target(lung, nodule=1)
lumen, model = lumen_of_lung(lung), model_of(la.load_system("ultrathin").scope)
advisor = Advisor(lumen, model, goal_at(lumen, target.lps_mm, 5.0))  # a lesion of 5 mm radius
path = advisor.path(start_state(lumen, lung.tree, model), seed=1)
for instruction in instructions_along(path, lung.tree):
    print(instruction.text())
print(why_stopped(path, advisor.field, lung.tree))

figure, ax = plt.subplots(figsize=(6, 5))
ax.plot(lung.tree.points_lps[:, 0], lung.tree.points_lps[:, 2], ".", color="0.8", markersize=2)
tips = path.tips()
ax.plot(tips[:, 0, 3], tips[:, 2, 3], linewidth=2, label=f"{path.length_mm:.0f} mm inserted")
ax.plot(target.lps_mm[0], target.lps_mm[2], "k+", markersize=12, label="lesion")
ax.set(xlabel="LPS x, mm", ylabel="LPS z, mm", aspect="equal", title="Path of the bronchoscope")
ax.legend()
figure.savefig("advisor.png")

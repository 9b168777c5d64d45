"""Find the motions of a bronchoscope.

Each tip of the scope comes with a proved motion of its bending section. The picture shows the bodies that
some motions leave in the airway, and all tips, for two bronchoscopes, seen from the front.
"""

import matplotlib.pyplot as plt

import lungaccess as la
from stages.scope import find_motions

lung = la.load_patient("phantom-3")
figure, axes = plt.subplots(1, 2, figsize=(9, 5), sharey=True)
for ax, name in zip(axes, ["ultrathin", "therapeutic-scope"], strict=True):
    scope = la.load_system(name).scope
    motions = find_motions(lung, scope, reach_mm=60.0)
    x, _y, z = lung.tree.points_lps.T
    ax.plot(x, z, ".", color="0.8", markersize=2, label="airway tree")
    ax.plot(motions.tips[:, 0], motions.tips[:, 2], ".", markersize=2, label=f"{motions.count} tips")
    for tip in range(0, motions.count, max(1, motions.count // 12)):
        body = motions.motion(tip).body(1.0)
        ax.plot(body[:, 0, 3], body[:, 2, 3], "k-", linewidth=0.8)
    ax.set(title=f"{name}, {scope.outer_diameter_mm} mm", xlabel="LPS x, mm", aspect="equal")
    ax.legend()
axes[0].set_ylabel("LPS z, mm")
figure.savefig("scope_motions.png")

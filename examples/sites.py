"""Find the sites of a bronchoscope.

A site is a pose of the scope's tip on the medial axis of the airways, to which the lumen is proved wide
enough all the way. The picture compares the sites of two bronchoscopes, seen from the front.
"""

import matplotlib.pyplot as plt

import lungaccess as la
from stages.scope import find_sites

lung = la.load_patient("phantom-3")
figure, axes = plt.subplots(1, 2, figsize=(9, 5), sharey=True)
for ax, name in zip(axes, ["ultrathin", "therapeutic-scope"], strict=True):
    scope = la.load_system(name).scope
    sites = find_sites(lung, scope, reach_mm=60.0)
    x, _y, z = lung.tree.points_lps.T
    ax.plot(x, z, ".", color="0.8", markersize=2, label="airway tree")
    ax.plot(sites.poses[:, 0], sites.poses[:, 2], ".", markersize=3, label=f"{sites.count} sites")
    ax.set(title=f"{name}, {scope.outer_diameter_mm} mm", xlabel="LPS x, mm", aspect="equal")
    ax.legend()
axes[0].set_ylabel("LPS z, mm")
figure.savefig("sites.png")

"""Plan the needle alone, around a vessel.

The obstacles are a label volume with one ball of vessel between start and target. The same search runs
with two objectives: the shortest path, and the least integral of 1 / clearance.
"""

import matplotlib.pyplot as plt
import numpy as np

from anatomy import VESSEL, Grid
from stages.needle import Needle, Objective, Query, environment_of_labels, searches

grid = Grid.from_spacing((64, 64, 64), (1.0, 1.0, 1.0), (-31.5, -31.5, -31.5))
i, j, k = np.meshgrid(*[np.arange(64) - 31.5] * 3, indexing="ij")
labels = np.where(i**2 + j**2 + k**2 <= 16.0, VESSEL, 0).astype(np.uint16)
needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 30)
environment = environment_of_labels(labels, grid, needle, required_clearance_mm=1.0)

lps_from_start = np.eye(4)  # +z is the direction of insertion
lps_from_start[:3, 3] = 0.0, 0.0, -28.0
query = Query(lps_from_start=lps_from_start, target=np.array([0.0, 0.0, 28.0]))

objectives = {"length": Objective(length=1.0), "1 / clearance": Objective(inverse_clearance=1.0)}
figure, ax = plt.subplots(figsize=(8, 3))
ax.add_patch(plt.Circle((0.0, 0.0), 4.0, color="C3", alpha=0.5, label="vessel"))
for name, objective in objectives.items():
    search = searches()["optimal"](environment, query, 0, objective)
    for _slice in range(10):
        search.advance(500)
    points, _lengths = search.path.sample(step_mm=0.5)
    aside = np.linalg.norm(points[:, :2], axis=1)
    ax.plot(points[:, 2], aside, label=f"{name}: cost {search.cost:.2f}")
ax.set(xlabel="LPS z, mm", ylabel="distance from\nthe straight line, mm", aspect="equal", ylim=(-5, 15))
ax.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
figure.tight_layout()
figure.savefig("needle.png")

"""Add a planner of your own.

A search is made from a task and an atlas, and its `steps` yield a candidate whenever it finds a cheaper one.
The evaluator proves and costs each candidate, so a search does not have to be trusted. This one tries the
direct arcs of deployments in random order. The picture compares it with the planner of the project.
"""

from collections.abc import Iterator

import matplotlib.pyplot as plt
import numpy as np

import lungaccess as la
from lungaccess.planning.coupled import DirectArcs, Incumbent, Step, evaluated_step


class RandomArcs:
    """The direct arcs of random deployments, one a step."""

    def __init__(self, task, atlas: la.Atlas) -> None:
        self.arcs = DirectArcs(task, atlas)
        self.blocked = self.arcs.evaluator.blocked
        self.order = np.random.default_rng(task.seed).permutation(self.arcs.in_workspace)

    def steps(self) -> Iterator[Step]:
        incumbent = Incumbent()
        for iteration, entry in enumerate(self.order, start=1):
            candidate = self.arcs.candidate(int(entry))
            yield incumbent.improved(evaluated_step(self.arcs.evaluator, "random arcs", candidate, iteration))


la.register_planner("random-arcs", RandomArcs)
lung, system = la.load_patient("phantom-3"), la.load_system("ultrathin")
target, atlas = la.resolve_target(lung, nodule=1), la.open_atlas(lung, system)
figure, ax = plt.subplots(figsize=(6, 4))
for method in ["random-arcs", "atlas"]:
    plans = list(la.plan(lung, system, target, method=method, atlas=atlas, iterations=300, goal="default"))
    ax.step(
        [plan.iterations for plan in plans], [plan.cost for plan in plans], "o-", where="post", label=method
    )
ax.set(xlabel="iteration", ylabel="integral of 1 / clearance", title="Best plan of two planners")
ax.legend()
figure.savefig("planner.png")

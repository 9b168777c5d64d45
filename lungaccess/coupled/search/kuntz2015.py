"""Algorithm 1 of [Kuntz2015], for comparison."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lungaccess.coupled.search.atlas_search import AtlasSearch
from lungaccess.coupled.search.evaluator import Step
from lungaccess.plans.assemble import Candidate
from stages.scope import MedialAxis, looks_ahead
from stages.tube import tracking_length_mm

RRT_ITERATIONS = 300


class KuntzSearch(AtlasSearch):
    """Algorithm 1 of [Kuntz2015]: random placement, workspace rejection, RRT, keep the best.

    Lines 3-7 draw site, rotation and translations; line 8 rejects placements whose workspace does not
    hold the target; line 9 runs the RRT, here for a fixed number of iterations so that runs repeat.
    """

    rejects = True
    """Whether line 8 is carried out."""
    from_atlas = False

    def steps(self) -> Iterator[Step]:
        """Search forever; the caller stops."""
        best = math.inf
        axis = MedialAxis(self.task.lung.tree, self.atlas.sites.passable & self.atlas.sites.exits_ahead)
        iteration = 0
        while axis.length_mm > 0.0:
            iteration += 1
            step = self._algorithm_1(iteration, axis)
            if step.candidate is not None and step.cost < best:
                best = step.cost
            else:
                step = replace(step, candidate=None)
            yield step

    def _algorithm_1(self, iteration: int, axis: MedialAxis) -> Step:
        rng, tubes = self.rng, self.task.system.tubes
        tip = axis.sample(rng)
        rotation = float(rng.uniform(0.0, 2 * math.pi))
        outer, inner = np.sort(rng.uniform(0.0, tracking_length_mm(tubes), 2))
        seed = int(rng.integers(2**63))
        if not looks_ahead(self.task.lung.tree, tip):
            return Step(iteration=iteration, phase="Algorithm 1")
        deployment = self.judge.judge(tip.lps_from_scope_tip, rotation, float(outer), float(inner))
        if isinstance(deployment, str) or (self.rejects and not self.desk.reaches(deployment.lps_from_tip)):
            return Step(iteration=iteration, phase="Algorithm 1")
        path = self.desk.search(deployment, seed, RRT_ITERATIONS)
        candidate = None if path is None else Candidate(tip=tip, deployment=deployment, path=path)
        return self.desk.finished(iteration, "Algorithm 1", candidate)


class KuntzSearchWithoutRejection(KuntzSearch):
    """The same without line 8: the paper's measure of what rejection saves."""

    rejects = False

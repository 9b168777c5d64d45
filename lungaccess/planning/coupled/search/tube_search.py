"""The search for plans of a system without a needle: tubes aimed from the atlas, then along each motion."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from anatomy.base.typed import Float, Int
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kernels.aimed_tubes import COST, JOINTS
from lungaccess.planning.coupled.search.aimed_tubes import AimedTubes, aim_starts, cheapest_first
from lungaccess.planning.coupled.search.base import SearchInParts, Step, evaluated_step
from lungaccess.planning.coupled.search.entries import different
from lungaccess.planning.coupled.search.settings import ESTIMATE_SLACK
from lungaccess.problem.task import Task
from stages.scope import evenly

CHUNK = 200
"""Scope tips from which the tubes are aimed in one call, some 10 ms: then the caller may end the search."""
ROWS_MM = (evenly(0.25, 4.0), evenly(0.02, 0.26))
"""How much farther the scope may stop: a fraction of the 1 mm between the tips of an atlas and several times
as far as the next, then between the best of these and its neighbours."""


class TubeSearch(SearchInParts):
    """Aims the tubes at the target from the tips of the atlas, then from tips along the motions of the best.

    It ends when it has looked along the motions of all tips with a deployment to the target that differ.

    Attributes:
        blocked: How many attempts were refused, by the reason.
        clear ((C,) int64): After the direct steps the entries of the atlas with a deployment to the target,
            the cheapest first.
    """

    def __init__(self, task: Task, atlas: Atlas, aimed: AimedTubes | None = None) -> None:
        self.task, self.atlas = task, atlas
        self.arcs = aimed or AimedTubes(task, atlas)
        self.evaluator = self.arcs.evaluator
        super().__init__(self.evaluator.blocked)
        self.clear: Int = np.zeros(0, dtype=np.int64)

    def direct_steps(self) -> Iterator[Step]:
        """Aim from the tips of the atlas, those first from which a deployment ends nearest."""
        clear, costs = [self.clear], [np.zeros(0)]
        near, phase = self.arcs.promising, "aiming the tubes"
        for begin in range(0, len(near), CHUNK):
            chunk = near[begin : begin + CHUNK]
            found, why = self.arcs.aim(chunk)
            self.blocked.update(self.arcs.reasons(why))
            order = cheapest_first(found)
            yield Step(iteration=0, phase=phase)
            yield from self._finalists(phase, chunk[order], found[order])
            clear.append(chunk[order])
            costs.append(found[order, COST])
        self.clear = np.concatenate(clear)[np.argsort(np.concatenate(costs), kind="stable")]

    def _finalists(self, phase: str, entries: Int, found: Float) -> Iterator[Step]:
        """Evaluate the cheapest in full, as long as one may be better than all before."""
        # Proved deployments of a chunk: the estimated costs by which they are chosen may be in the wrong
        # order.
        left = 3
        for entry, row in zip(entries.tolist(), found, strict=True):
            if not left or row[COST] > ESTIMATE_SLACK * self.incumbent.cost:
                return
            made = self.arcs.made(self.arcs.tip(entry), row)
            step = evaluated_step(self.evaluator, phase, made)
            left -= step.candidate is not None
            yield self.incumbent.improved(step)

    def further_steps(self) -> Iterator[Step]:
        """Look along the motions, the cheapest first; each motion is an iteration."""
        number, parts = self.share
        ordered = different(self.atlas.deployments, self.clear)[number::parts]
        for iteration, entry in enumerate(ordered.tolist(), start=1):
            step = self._shifted(int(entry))
            yield self.incumbent.improved(replace(step, iteration=iteration))

    def _shifted(self, entry: int) -> Step:
        """Return the best deployment from tips along the motion to that of an entry."""
        phase, tubes = "looking along the motion of the scope", self.task.system.tubes
        first = self.arcs.aim(np.array([entry]))[0][0]
        tip, best = self.arcs.tip(entry), first
        for shifts_mm in ROWS_MM:
            row = self.evaluator.tip_rows.along(tip, shifts_mm)
            starts = aim_starts(tubes, best[JOINTS:], len(shifts_mm))
            if starts is None:
                break
            rows, why = self.arcs.aim_from(row.tips, row.proved, starts)
            self.blocked.update(self.arcs.reasons(why))
            order = cheapest_first(rows)
            if len(order) and rows[order[0], COST] < best[COST]:
                best, tip = rows[order[0]], self.evaluator.tip_rows.tip(row, int(order[0]))
        if best is first or best[COST] > ESTIMATE_SLACK * self.incumbent.cost:
            return Step(iteration=0, phase=phase)
        return evaluated_step(self.evaluator, phase, self.arcs.made(tip, best))

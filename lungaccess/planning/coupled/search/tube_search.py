"""The search for plans of a system without a needle: tubes aimed from the atlas, then along each motion."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import count

import numpy as np

from anatomy.base.typed import Float, Int
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kernels.aimed_tubes import COST
from lungaccess.planning.coupled.search.aimed_tubes import AimedTubes, AimStarts
from lungaccess.planning.coupled.search.base import Incumbent, Step, evaluated_step
from lungaccess.planning.coupled.search.entries import different
from lungaccess.planning.coupled.search.settings import ESTIMATE_SLACK
from lungaccess.plans.candidate import Candidate
from lungaccess.problem.task import Task
from stages.scope import evenly

CHUNK = 200
"""Scope tips from which the tubes are aimed in one call, some 10 ms: then the caller may end the search."""
FINALISTS = 3
"""Proved deployments of a chunk: the estimated costs by which they are chosen may be in the wrong order."""
ROWS_MM = (evenly(0.25, 4.0), evenly(0.02, 0.26))
"""How much farther the scope may stop: a fraction of the 1 mm between the tips of an atlas and several times
as far as the next, then between the best of these and its neighbours."""


class TubeSearch:
    """Aims the tubes at the target from the tips of the atlas, then from tips along the motions of the best.

    It ends when it has looked along the motions of all tips with a deployment to the target that differ.

    Attributes
    ----------
    blocked : Counter of str
        How many attempts were refused, by the reason.
    """

    def __init__(self, task: Task, atlas: Atlas) -> None:
        self._aimed = self.arcs = AimedTubes(task, atlas)
        self._atlas, self._evaluator = atlas, self._aimed.evaluator
        self.blocked = self._evaluator.blocked
        self._incumbent = Incumbent()

    def steps(self) -> Iterator[Step]:
        """Search until the caller stops or all is tried; the same task gives the same steps."""
        clear: list[Int] = []
        rows: list[Float] = []
        near = self._aimed.promising
        for begin in range(0, len(near), CHUNK):
            chunk = near[begin : begin + CHUNK]
            found, order = self._aimed.aim(chunk)
            yield Step(iteration=0, phase="aiming the tubes")
            yield from self._finalists(chunk, found, order)
            clear.append(chunk[order])
            rows.append(found[order])
        if clear:
            yield from self._along(np.concatenate(clear), np.concatenate(rows))

    def _finalists(self, entries: Int, found: Float, order: Int) -> Iterator[Step]:
        """Evaluate the cheapest in full, as long as one may be better than all before."""
        left = FINALISTS
        for n in order.tolist():
            if not left or found[n, COST] > ESTIMATE_SLACK * self._incumbent.cost:
                return
            tip = self._aimed.tip(int(entries[n]))
            step = self._step("aiming the tubes", self._aimed.candidate(tip, found[n]))
            left -= step.candidate is not None
            yield self._incumbent.improved(step)

    def _along(self, entries: Int, found: Float) -> Iterator[Step]:
        """Look along the motions, the cheapest first; each motion is an iteration."""
        order = np.argsort(found[:, COST], kind="stable")
        entries, found = entries[order], found[order]
        row_of = {int(entry): n for n, entry in enumerate(entries)}
        ordered = different(self._atlas.deployments, entries)
        for number, entry in zip(count(1), ordered.tolist(), strict=False):
            step = self._shifted(int(entry), found[row_of[int(entry)]])
            yield self._incumbent.improved(replace(step, iteration=number))

    def _shifted(self, entry: int, found: Float) -> Step:
        """Return the best deployment from tips along the motion to that of an entry."""
        tip = self._aimed.tip(entry)
        phase, best = "looking along the motion of the scope", found
        for shifts_mm in ROWS_MM:
            row = self._evaluator.tip_rows.along(tip, shifts_mm)
            numbers = np.arange(len(shifts_mm))
            starts = AimStarts.around(self._evaluator.task.system.tubes, best, len(shifts_mm))
            if starts is None:
                break
            rows, order = self._aimed.aim_from(row.tips, row.proved, numbers, starts)
            if len(order) and rows[order[0], COST] < best[COST]:
                best, tip = rows[order[0]], self._evaluator.tip_rows.tip(row, int(order[0]))
        if best is found or best[COST] > ESTIMATE_SLACK * self._incumbent.cost:
            return Step(iteration=0, phase=phase)
        return self._step(phase, self._aimed.candidate(tip, best))

    def _step(self, phase: str, candidate: Candidate | None) -> Step:
        return evaluated_step(self._evaluator, phase, candidate)

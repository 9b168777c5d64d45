"""The simplest ways to a target from the deployments of an atlas, with a needle and without one."""

from typing import Protocol

from anatomy.base.typed import Float, Int
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.search.aimed_tubes import AimedTubes
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task


class DirectCandidates(Protocol):
    """Ways to the target of a task, at most one from each entry of an atlas.

    They are the direct arcs of the needle, or without one the tubes aimed at the target.
    """

    task: Task
    atlas: Atlas
    evaluator: CandidateEvaluator

    @property
    def promising(self) -> Int:
        """The entries (N,) from which the target may be reached, the nearest first."""

    def evaluate(self, chosen: Int, slack: float) -> tuple[Int, Float, float]:
        """Return for entries (E,) what blocks them, 0 for nothing, their estimated costs, and the least."""

    def reasons(self, blockers: Int) -> dict[str, int]:
        """Return what blocks entries (E,) in words, and how many of them."""

    def clear(self) -> Int:
        """Return the entries (C,) with a clear way, the best first."""

    def candidate(self, entry: int) -> Candidate | None:
        """Return the way from an entry as a candidate, None if the tubes are refused."""

    def proved(self, entry: int) -> Candidate | None:
        """Return the way from an entry as a candidate, None if its proof fails."""

    def lines(self, chosen: Int, samples: int) -> Float:
        """Return points (E, samples, 3) of what the costs are of, LPS mm."""


def direct_candidates(
    task: Task, atlas: Atlas, evaluator: CandidateEvaluator | None = None, aims: Float | None = None
) -> DirectCandidates:
    """Return the simplest ways to the target of a task, or to aims beside it.

    Args:
        evaluator: What proves them, for instance also for phases of the breath; made of the task if None.
        aims ((S, 3) float64): Where the ways from each scope tip of the atlas end, LPS mm, nan for none; at
            the target if None.
    """
    made = AimedTubes if task.system.needle is None else DirectArcs
    return made(task, atlas, evaluator, aims)

"""The needle of a simulated procedure that is measured and planned again on its way."""

import numpy as np

from anatomy.base.typed import Float
from lungaccess.planning.procedure.policy import LEAST_CHANCE, OnTheWay, Policy, rest_of
from lungaccess.planning.procedure.truth import Attempt, Steered, insert_needle, unknown_of
from stages.needle import ArcPath, Query, Replan, Replanner, ReplanSettings


class PolicyReplanner(Replanner):
    """Goes on by what the policy chooses; it searches where no path is proved, for one that ends nearer.

    Args:
        query, plan: As those of `Replanner`.
    """

    def __init__(self, policy: Policy, query: Query, plan: ArcPath) -> None:
        super().__init__(policy.environment, query, plan)
        self._policy, self._asked = policy, query
        self._followed, self._begun_mm, self._turned = plan.arcs, 0.0, 0.0

    def replan(
        self, lps_from_tip: Float, target: Float, inserted_mm: float, *, turned_rad: float | None = None
    ) -> Replan:
        """Plan from the pose that the tip is in; see `Replanner.replan`."""
        rest, turned = rest_of(self._followed, inserted_mm - self._begun_mm)
        asked, total = self._asked, self._turned + turned if turned_rad is None else turned_rad
        way = OnTheWay(rest, inserted_mm, total, asked.lps_from_start[:3, 2], asked.branch)
        arcs, chance, proved = self._policy.from_needle(way, lps_from_tip, target, self.curvature_share)
        path = ArcPath(lps_from_start=lps_from_tip, arcs=arcs)
        found = Replan(path=path, miss_mm=float(np.linalg.norm(path.frames()[-1][:3, 3] - target)))
        if chance < LEAST_CHANCE or not proved:
            other = self._searched(way, lps_from_tip, target)
            nearer = other.path is not None and other.miss_mm < found.miss_mm
            found = other if chance < LEAST_CHANCE or nearer else found
        if found.path is not None:
            self._followed, self._begun_mm, self._turned = found.path.arcs, inserted_mm, total
        return found

    def _searched(self, way: OnTheWay, lps_from_tip: Float, target: Float) -> Replan:
        query = Query(
            lps_from_start=lps_from_tip, target=target, branch=way.branch, inserted_mm=way.inserted_mm,
            turned_rad=way.turned_rad, reference=way.reference,
        )  # fmt: skip
        rest = ArcPath(lps_from_start=lps_from_tip, arcs=way.rest)
        # The most by which a replan may miss the target.
        allowed = ReplanSettings(largest_miss_mm=min(self._policy.aside_mm, 10.0))
        replanner = Replanner(self._policy.environment, query, rest, settings=allowed)
        replanner.curvature_share = self.curvature_share
        return replanner.replan(lps_from_tip, target, way.inserted_mm)


def steered(
    policy: Policy,
    path: ArcPath,
    branch: int,
    true_tip: Float,
    target: Float,
    attempt: Attempt,
    doubt: Float,
    rng: np.random.Generator,
) -> Steered:
    """Return what comes of a needle that is measured on its way.

    Args:
        path: What it begins with.
        true_tip ((4, 4) float64): Where it truly starts.
        doubt ((6, 6) float64): Covariance of where it is taken to start, see `stages.needle.Unknown`.
    """
    steering = policy.procedure.needle
    query = Query(lps_from_start=path.lps_from_start, target=target, branch=branch)
    return insert_needle(
        policy.environment, query, path, PolicyReplanner(policy, query, path), attempt, true_tip, steering,
        unknown_of(policy.errors, steering, doubt), rng,
    )  # fmt: skip

"""Local sampling: random deployments near those of the atlas, each with a direct arc."""

import math

import numpy as np

from anatomy.base.typed import Float, Int, UInt64
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kernels.candidate import SCOPE_POSE
from lungaccess.planning.coupled.kernels.local_search import sample_deployments
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.coupled.search.entries import different
from lungaccess.planning.coupled.search.local_search import LocalSearch, TubeChoice
from lungaccess.plans.candidate import Candidate
from stages.needle import Needle
from stages.tube import many_shapes, shapes_of

MOST = 1000
"""Deployments of the atlas around which samples are drawn: about as many as one iteration has samples for."""
TRIES = 2000
"""Samples of an iteration, a few milliseconds at most: nearly all end at the limits of the needle."""
SPREADS = np.array([math.radians(15.0), 2.0])
"""How far rotation and insertions (mm) are varied: to the next entry of the atlas and beyond."""


class LocalSampling:
    """Samples deployments near entries of an atlas.

    Args:
        local_search: Has the arguments of the kernels.
        chosen ((N,) int64): Entries of the atlas, at least one.
    """

    def __init__(
        self, local_search: LocalSearch, arcs: DirectArcs, chosen: Int, rng: np.random.Generator
    ) -> None:
        self._local_search = local_search
        self._evaluator, self._rng = arcs.evaluator, rng
        entries, motions = arcs.atlas.deployments, arcs.atlas.motions
        numbers, self._pose_of = np.unique(entries.site[chosen], return_inverse=True)
        self._motions, self._numbers = motions, numbers
        self._poses = np.ascontiguousarray(motions.tips[numbers])
        self._rotations = np.array(entries.rotation_rad[chosen])
        self._shapes = many_shapes(shapes_of(arcs.task.system.tubes), entries.shape[chosen])

    def sample(self, cost_limit: float) -> Candidate | None:
        """Return the cheapest of TRIES samples if its estimated cost is below a limit."""
        state: UInt64 = self._rng.integers(2**64, size=1, dtype=np.uint64)
        search, best = self._local_search, TubeChoice.empty(self._local_search.design)
        cost = sample_deployments(
            search.tube(TubeChoice.empty(search.design)),
            search.needle,
            self._poses,
            self._pose_of,
            self._rotations,
            self._shapes,
            SPREADS,
            search.target,
            TRIES,
            cost_limit,
            state,
            best.x,
            best.shape,
        )
        if not cost < cost_limit:
            return None
        tip = self._motions.tip(int(self._numbers[int(best.x[SCOPE_POSE])]))
        return self._evaluator.direct(tip, *best.numbers)


def sampling_near_target(
    local_search: LocalSearch, arcs: DirectArcs, rng: np.random.Generator
) -> LocalSampling:
    """Return local sampling around the deployments from which the needle reaches the target, or nearly does.

    Up to half of MOST are different ones that may reach it at the least cost; the others miss it by least.
    """
    inside = different(arcs.atlas.deployments, arcs.by_bound[0])[: MOST // 2]
    target, most = arcs.task.target.lps_mm, MOST - len(inside)
    needle = arcs.evaluator.environment.needle
    outside = nearly_reaching(arcs.atlas, needle, target, most)
    return LocalSampling(local_search, arcs, np.concatenate([inside, outside]), rng)


def nearly_reaching(atlas: Atlas, needle: Needle, target: Float, most: int) -> Int:
    """Return `most` entries whose single arc to the target exceeds the needle's limits, nearest misses first.

    A miss is how far the target lies from the needle's workspace, or less.  It counts in relation to how far
    a variation of the deployment moves that workspace: a few mm, and more with the distance from the tubes.

    Args:
        target: (3,) float64, LPS mm.
    """
    entries = atlas.deployments
    offset = target - entries.positions
    away = np.sqrt(np.maximum(np.einsum("ni,ni->n", offset, offset), 1e-12))
    ahead = np.einsum("ni,ni->n", offset, entries.tangents)
    aside = np.sqrt(np.maximum(away**2 - ahead**2, 0.0))
    curvature, turn = 2.0 * aside / away**2, 2.0 * np.arctan2(aside, ahead)
    length = np.where(curvature > 1e-9, turn / np.maximum(curvature, 1e-9), np.abs(ahead))
    most_turn = math.radians(min(needle.max_angle_from_start_deg, needle.max_accumulated_turn_deg))
    radius = 1.0 / needle.max_curvature_per_mm
    miss = np.maximum(radius - np.hypot(ahead, aside - radius), (turn - most_turn) * away)
    miss = np.maximum(miss, length - needle.max_length_mm)
    miss[miss <= 0.0] = np.inf
    # By about this angle such a variation turns the tip of the tubes.
    return np.argsort(miss / (SPREADS[1] + 0.15 * away), kind="stable")[:most].astype(np.int64)

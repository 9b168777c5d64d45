"""Random deployments near those of the atlas, each with a single arc: what lies between its entries."""

from __future__ import annotations

import math

import numpy as np

from anatomy.typed import Float, Int, UInt64
from lungaccess.coupled.atlas import Atlas
from lungaccess.coupled.kernels.candidate import N_CHOICE, SCOPE_POSE
from lungaccess.coupled.kernels.local_search import sample_deployments
from lungaccess.coupled.search.local_search import Climber
from lungaccess.plans.assemble import Candidate
from stages.needle import Needle, direct_path
from stages.tube import TubeJudge

MOST = 1000
"""Deployments that are varied."""
TRIES = 2000
"""Of an iteration, a few milliseconds at most: nearly all of them end at the limits of the needle."""
SPREADS = np.array([math.radians(15.0), 2.0])
"""How far rotation and insertions (mm) are varied: to the next entry of the atlas and beyond."""
SWING_RAD = 0.15
"""So far such a change turns the tip of the tubes, roughly."""


class Scatter:
    """Draws deployments near entries of an atlas.

    Parameters
    ----------
    climber : Climber
    judge : TubeJudge
    atlas : Atlas
    chosen : (N,) int64
        Entries, at least one.
    rng : numpy.random.Generator
    """

    def __init__(
        self, climber: Climber, judge: TubeJudge, atlas: Atlas, chosen: Int, rng: np.random.Generator
    ) -> None:
        self._climber, self._judge, self._rng = climber, judge, rng
        entries, tree = atlas.deployments, atlas.lung.tree
        sites, self._row_of = np.unique(entries.site[chosen], return_inverse=True)
        self._tips = [atlas.sites.tip(tree, int(site)) for site in sites]
        frames = np.array([tip.lps_from_scope_tip for tip in self._tips])
        self._rows = np.ascontiguousarray(frames[:, :3, [3, 2, 0]].transpose(0, 2, 1).reshape(-1, 9))
        self._deployed = (entries.rotation_rad[chosen], entries.outer_mm[chosen], entries.inner_mm[chosen])

    def draw(self, dearest: float) -> Candidate | None:
        """Return the cheapest of TRIES deployments with an arc estimated to cost less than `dearest`."""
        state: UInt64 = self._rng.integers(2**64, size=1, dtype=np.uint64)
        best = np.zeros(N_CHOICE)
        cost = sample_deployments(
            self._climber.tube, self._climber.needle, self._rows, self._row_of, *self._deployed, SPREADS,
            self._climber.target, TRIES, dearest, state, best,
        )  # fmt: skip
        if not cost < dearest:
            return None
        tip, (rotation, outer, inner) = self._tips[int(best[SCOPE_POSE])], best[1:].tolist()
        deployment = self._judge.judge(tip.lps_from_scope_tip, rotation % (2.0 * math.pi), outer, inner)
        if isinstance(deployment, str):
            return None
        path = direct_path(deployment.lps_from_tip, np.array(self._climber.target))
        return Candidate(tip=tip, deployment=deployment, path=path)


def nearly_reaching(atlas: Atlas, needle: Needle, target: Float, most: int) -> Int:
    """Return `most` entries whose single arc to the target exceeds the needle's limits, nearest misses first.

    A miss is how far the target lies from the needle's workspace, or less, against how far a small change of
    the deployment moves that workspace: a few mm, and the farther from the tubes the more.

    Parameters
    ----------
    atlas : Atlas
    needle : Needle
    target : (3,) float64, LPS mm
    most : int
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
    return np.argsort(miss / (SPREADS[1] + SWING_RAD * away), kind="stable")[:most].astype(np.int64)

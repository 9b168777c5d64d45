"""Several passes from one place of the scope, planned together: where each of them ends.

Where passes of a plan at one point end is simulated once.  A pass that is aimed elsewhere errs as they do:
its tool is laid into the nodule as theirs were, moved by what was planned.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from lungaccess.planning.coupled.search.direct_candidates import DirectCandidates
from lungaccess.planning.procedure import Policy
from lungaccess.planning.procedure.simulation import passes_simulated
from lungaccess.planning.success.ratings import ChanceRating
from lungaccess.plans.assemble import with_devices
from lungaccess.plans.candidate import Candidate, with_tool_in_place
from lungaccess.plans.kernels.tissue import Wanted, taken_at, taken_in
from lungaccess.plans.plan import Plan
from lungaccess.plans.tissue import goal_radius
from lungaccess.problem.request import Request
from lungaccess.uncertainty.risk.assessor import taken_together
from stages.needle import direct_path

RINGS = ((0.35, 6), (0.7, 8), (1.0, 8), (1.5, 8), (2.0, 8))
"""Distances of aims from the target across the needle, in radii of the nodule, and how many lie so far."""
OTHER_TUBES = 6
"""So many other deployments from the place of the scope are tried: the first clear ones of the atlas."""
SWEEPS = 4
"""Each pass is chosen anew so many times while the others stay; it hardly ever takes three."""

OPEN_DRAWS, MEASURED_DRAWS = 1024, 400
"""Draws by which aims are chosen, and others of the same number by which plans compete."""
CHOOSING, COMPARING = 14, 15
"""Batches of these draws: no round of the contest has such a number."""
SAME_PLACE = 1e-9
"""The scope stands at a tip of the atlas if no number of the two frames differs by more."""
Maker = Callable[[Candidate], Plan]


@frozen_record
class _Ended:
    """Where passes at one point end: tools `(K, N, 9)`, nodules `(K, N, 3)` mm aside, what is clear."""

    ends: Float
    shifts_mm: Float
    wanted: Wanted
    clear: Bool

    @classmethod
    def of(cls, policy: Policy, draws: int, seed: int) -> "_Ended":
        """Return where the passes of a policy's plan end, by draws of a seed."""
        found, assessor = passes_simulated(policy, draws, seed), policy.assessor
        return cls(
            ends=np.array([each.ends for each in found]),
            shifts_mm=np.array([each.shifts_mm for each in found]),
            wanted=assessor.wanted,
            clear=np.all([assessor.touches_nothing(each.touched) for each in found], axis=0),
        )

    def taken(self, moved: Float) -> Float:
        """Return what each pass `(K, N)` takes if its tool is moved by a frame `(4, 4)`."""
        taken = np.zeros(self.ends.shape[:2])
        by = np.concatenate([moved[:3, :3].ravel(), moved[:3, 3]])
        for number in range(len(taken)):
            taken_in(self.wanted, self.shifts_mm[number], self.ends[number], by, taken[number])
        return taken


def with_passes(
    request: Request, rating: ChanceRating, direct: DirectCandidates, best: Candidate, make: Maker
) -> Plan:
    """Return the plan of a candidate with the passes that most often take enough together.

    One pass, all passes at its point, and passes spread over the nodule compete by draws that choose none of
    the ways: no more passes are planned than help.

    Args:
        make: Makes the whole plan of a candidate.
    """
    one, count = make(best), request.passes
    draws = OPEN_DRAWS if rating.procedure.is_open_loop else MEASURED_DRAWS
    same = one.with_further([one] * (count - 1))
    policy = Policy(same, request.lung, rating.errors, rating.procedure, radius_mm=request.radius_mm)
    ended = _Ended.of(policy, draws, rating.seed_of(CHOOSING))
    reach_mm = goal_radius(request.lung, request.target.lps_mm, request.radius_mm)[0]
    ways = list(_candidates(best, direct, reach_mm))
    frames = np.array([with_tool_in_place(request.system, each.path).frames()[-1] for each in ways])
    clear = [ended.clear] * len(ways)
    if rating.procedure.is_open_loop:
        # Where nothing is planned again, a way touches what it touches, wherever the others go.
        task = direct.evaluator.task
        clear = [
            rating.clear(with_devices(task, each, one), draws, rating.seed_of(CHOOSING)) for each in ways
        ]
    wanted = direct.evaluator.wanted
    enough = np.array([wanted is None or taken_at(wanted, each) >= wanted.least for each in frames])
    # Passes with the same tubes follow each other: the tubes are moved no more often than they have to be.
    tubes = [id(each.deployment) for each in ways]
    lead, *rest = _together(count, ended, frames, np.array(clear), enough).tolist()
    rest.sort(key=lambda way: (tubes[way] != tubes[lead], tubes.index(tubes[way])))
    first, *others = (one if way == 0 else make(ways[way]) for way in (lead, *rest))
    plans = [one, same, first.with_further(others)]
    gained = [rating.scorer(each)(COMPARING, draws, 1.0) for each in plans]
    # Of equals the one with fewer passes wins.
    return plans[int(np.argmax(gained))]


def _candidates(best: Candidate, direct: DirectCandidates, reach_mm: float) -> Iterator[Candidate]:
    """Yield proved ways from the place of the scope to aims about the target, the best one first."""
    yield best
    evaluator, atlas = direct.evaluator.beside(), direct.atlas
    frame, target = best.path.frames()[-1], evaluator.task.target.lps_mm
    aims = [target]
    for far, number in RINGS:
        angles = 2.0 * np.pi * np.arange(number) / number
        across = np.outer(np.cos(angles), frame[:3, 0]) + np.outer(np.sin(angles), frame[:3, 1])
        aims += list(target + far * reach_mm * across)
    # The needle is withdrawn to the tip of the tubes, or to where its last arc begins.
    starts = [(best, kept) for kept in sorted({0, len(best.path.arcs) - 1})]
    stands = best.tip.lps_from_scope_tip[:3, [3, 2, 0]].T.ravel()
    here = np.flatnonzero(np.abs(atlas.motions.tips - stands).max(axis=1) < SAME_PLACE)
    entries = direct.clear() if len(here) else np.zeros(0, dtype=np.int64)
    for entry in entries[np.isin(atlas.deployments.site[entries], here)][:OTHER_TUBES]:
        made = direct.proved(int(entry))
        starts += [] if made is None else [(made, 0)]
    for start, kept in starts:
        for aim in aims:
            last = direct_path(start.path.frames()[kept], aim)
            path = replace(start.path, arcs=np.concatenate([start.path.arcs[:kept], last.arcs]))
            other = replace(start, path=path)
            if evaluator.accepts(other):
                yield other


def _together(count: int, ended: _Ended, frames: Float, clear: Bool, enough: Bool) -> Int:
    """Return which way each pass goes, `(count,)`, so that passes most often take enough together.

    The first of the ways is the one at whose end passes were simulated.

    Args:
        frames ((W, 4, 4) float64): In which ways end.
        clear ((W, N) bool): In which draws they touch nothing forbidden.
        enough ((W,) bool): Which take enough as planned: the first pass does.
    """
    moved = np.tile(np.eye(4), (len(frames), 1, 1))
    moved[:, :3, :3] = frames[:, :3, :3] @ frames[0, :3, :3].T
    moved[:, :3, 3] = frames[:, :3, 3] - frames[0, :3, 3]
    taken = np.array([ended.taken(each) for each in moved])
    chosen, gained, best = np.zeros(count, dtype=np.int64), -1.0, 0.0
    for _sweep in range(SWEEPS):
        for number in range(count):
            others = [n for n in range(count) if n != number]
            kept, free = [taken[chosen[n], n] for n in others], clear[chosen[others]].all(axis=0)
            take = [
                taken_together([*kept, own], ended.wanted) >= ended.wanted.least for own in taken[:, number]
            ]
            shares = (np.array(take) & free & clear).mean(axis=1)
            shares = shares if number else np.where(enough, shares, -1.0)
            # Of equals the first wins, which is nearest to where passes were simulated.
            chosen[number], best = int(np.argmax(shares)), float(shares.max())
        if best <= gained:
            break
        gained = best
    return chosen

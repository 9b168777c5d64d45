"""Several passes from one place of the scope, planned together: where each of them ends.

Ways from the place of the scope lead to aims all over the nodule and beside it, from the tubes of the first
pass and from tubes that are turned or moved: a needle that leaves tubes near the nodule can hardly bend
aside.  What every way takes is known in the same draws, and the passes are those whose ways most often take
enough together.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise, product

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from lungaccess.planning.coupled.search.direct_candidates import DirectCandidates
from lungaccess.planning.coupled.search.window_search import varied
from lungaccess.planning.procedure import Policy
from lungaccess.planning.procedure.simulation import passes_simulated
from lungaccess.planning.success.ratings import ChanceRating
from lungaccess.plans.assemble import with_devices
from lungaccess.plans.candidate import Candidate, with_tool_in_place
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.plans.kernels.tissue import Wanted, taken_at, taken_in
from lungaccess.plans.plan import Plan
from lungaccess.plans.tissue import goal_radius
from lungaccess.problem.request import Request
from lungaccess.uncertainty.risk.assessor import RiskAssessor, numbers_of_pass
from lungaccess.uncertainty.risk.patient_errors import model_for
from stages.needle import direct_arcs, direct_path, workspace_lengths
from stages.tube import Deployment, SiteEnumerator

RINGS = ((0.35, 6), (0.7, 8), (1.0, 8), (1.5, 8), (2.0, 8))
"""Distances of aims from the target across the needle, in radii of the nodule, and how many lie so far."""
TURNS_RAD = np.radians((-16.0, -8.0, -4.0, -2.0, 0.0, 2.0, 4.0, 8.0, 16.0))
SHIFTS_MM = (-4.0, -2.0, 0.0, 2.0, 4.0)
"""By which the tubes of the first pass are turned and each of them is moved: finer than deployments of an
atlas are spaced, as passes are to end some millimetres apart."""
OF_AIM = 3
"""So many other deployments are kept for each aim: those whose needle keeps farthest from obstacles."""
SHORTLIST = 40
"""So many ways are looked at for all passes in open loop: those that help the best of them most."""
SWEEPS = 4
"""Each two passes are chosen anew so many times while the others stay; it hardly ever takes three."""

OPEN_DRAWS, MEASURED_DRAWS = (1024, 4096), (400, 400)
"""Draws by which aims are chosen, and others by which plans compete."""
CHOOSING, COMPARING = 14, 15
"""Batches of these draws: no round of the contest has such a number."""
Maker = Callable[[Candidate], Plan]


@frozen_record
class _Known:
    """What every way of each pass does in the same draws: `(K, W, N)` of passes, ways and draws.

    Args:
        taken: How much of the nodule is in the tool.
        clear: Whether nothing forbidden is touched.
    """

    taken: Float
    clear: Bool
    wanted: Wanted

    def share(self, kept: Bool, taken: Float, number: int) -> Float:
        """Return how often passes succeed `(W,)` if pass `number` goes each of the ways.

        Args:
            kept ((N,) bool): In which draws the other passes touch nothing forbidden.
            taken ((N,) float64): What these take together.
        """
        join = np.maximum if len(self.wanted.covered) else np.add
        enough = join(self.taken[number], taken) >= self.wanted.least
        return np.asarray((enough & self.clear[number] & kept).mean(axis=1))


def with_passes(
    request: Request, rating: ChanceRating, direct: DirectCandidates, best: Candidate, make: Maker
) -> Plan:
    """Return the plan of a candidate with the passes that most often take enough together.

    One pass, all passes at its point, and passes spread over the nodule compete by draws that choose none of
    the ways: no more passes are planned than help.

    Args:
        make: Makes the whole plan of a candidate.
    """
    draws, others = OPEN_DRAWS if rating.procedure.is_open_loop else MEASURED_DRAWS
    one = make(best)
    same = one.with_further([one] * (request.passes - 1))
    plans = [one, same, _spread(request, rating, direct, best, same, make, draws)]
    gained = [rating.scorer(each)(COMPARING, others, 1.0) for each in plans]
    # Of equals the one with fewer passes wins.
    return plans[int(np.argmax(gained))]


def _spread(
    request: Request, rating: ChanceRating, direct: DirectCandidates, best: Candidate, same: Plan,
    make: Maker, draws: int,
) -> Plan:  # fmt: skip
    """Return the plan with passes spread over the nodule, from the place of the best one.

    Args:
        same: The plan with all passes at the point of the best one.
    """
    reach_mm = goal_radius(request.lung, request.target.lps_mm, request.radius_mm)[0]
    candidates, wanted = list(_candidates(best, direct, reach_mm)), direct.evaluator.wanted
    frames = np.array([with_tool_in_place(request.system, each.path).frames()[-1] for each in candidates])
    enough = np.array([wanted is None or taken_at(wanted, each) >= wanted.least for each in frames])
    if rating.procedure.is_open_loop:
        made = [with_devices(direct.evaluator.task, each, same.passes[0]) for each in candidates]
        kept, known = _known_alone(request, rating, made, enough, draws)
        candidates, enough = [candidates[n] for n in kept], enough[kept]
    else:
        known = _known_beside(request, rating, same, frames, draws)
    first, *rest = _together(known, enough).tolist()
    # Passes with the same tubes follow each other: the tubes are moved no more often than they have to be.
    tubes = [id(each.deployment) for each in candidates]
    rest.sort(key=lambda way: (tubes[way] != tubes[first], tubes.index(tubes[way])))
    begun, *others = (make(candidates[way]) for way in (first, *rest))
    return begun.with_further(others)


def _known_alone(
    request: Request, rating: ChanceRating, plans: list[Plan], enough: Bool, draws: int
) -> tuple[list[int], _Known]:
    """Return some of the ways, and what they do where nothing is planned again: the same wherever others go.

    Args:
        plans: Of all ways.
        enough ((W,) bool): Which take enough as planned.
    """
    seed, lead_tubes = rating.seed_of(CHOOSING), plans[0].tube.lps_from_tip.tobytes()
    assessors = [RiskAssessor(each, request.lung, radius_mm=request.radius_mm) for each in plans]
    drawn = [each.draws(draws, seed) for each in assessors]
    wanted = assessors[0].wanted

    def known(chosen: list[int], numbers: Sequence[int]) -> _Known:
        found = np.zeros((2, len(numbers), len(chosen), draws))
        for at, way in enumerate(chosen):
            plan, assessor = plans[way], assessors[way]
            errors = model_for(rating.errors, plan, request.lung)
            moved = plan.tube.lps_from_tip.tobytes() != lead_tubes
            for row, number in enumerate(numbers):
                own = drawn[way].of_pass(assessor.n_arcs, numbers_of_pass(number, number if moved else 0))
                found[:, row, at] = assessor.taken_and_clear(own.deviations(errors))
        return _Known(taken=found[0], clear=found[1] > 0.0, wanted=wanted)

    first = known(list(range(len(plans))), [0])
    alone = np.where(enough, first.share(np.ones(draws, dtype=bool), np.zeros(draws), 0), -1.0)
    best = int(np.argmax(alone))
    helps = first.share(first.clear[0, best], first.taken[0, best], 0)
    kept = sorted({0, best, *np.argsort(-helps, kind="stable")[:SHORTLIST].tolist()})
    others = known(kept, range(1, request.passes))
    return kept, _Known(
        taken=np.concatenate([first.taken[:, kept], others.taken]),
        clear=np.concatenate([first.clear[:, kept], others.clear]),
        wanted=wanted,
    )


def _known_beside(request: Request, rating: ChanceRating, same: Plan, frames: Float, draws: int) -> _Known:
    """Return what ways do where the rest is planned again: they err as passes at one point do.

    Where those end is simulated once.  Their tools are laid into the nodule as they were, moved by what was
    planned.

    Args:
        frames ((W, 4, 4) float64): In which ways end; the first is where the passes of `same` end.
    """
    policy = Policy(same, request.lung, rating.errors, rating.procedure, radius_mm=request.radius_mm)
    assessor, taken = policy.assessor, np.zeros((request.passes, len(frames), draws))
    clear = np.ones(draws, dtype=bool)
    for number, found in enumerate(passes_simulated(policy, draws, rating.seed_of(CHOOSING))):
        clear &= assessor.touches_nothing(found.touched)
        for way, frame in enumerate(frames):
            turned = frame[:3, :3] @ frames[0, :3, :3].T
            by = np.concatenate([turned.ravel(), frame[:3, 3] - frames[0, :3, 3]])
            taken_in(assessor.wanted, found.shifts_mm, found.ends, by, taken[number, way])
    return _Known(taken=taken, clear=np.broadcast_to(clear, taken.shape), wanted=assessor.wanted)


def _candidates(best: Candidate, direct: DirectCandidates, reach_mm: float) -> Iterator[Candidate]:
    """Yield proved ways from the place of the scope to aims about the target, the best one first."""
    yield best
    evaluator = direct.evaluator.beside()
    frame, target = best.path.frames()[-1], evaluator.task.target.lps_mm
    aims = [target]
    for far, number in RINGS:
        angles = 2.0 * np.pi * np.arange(number) / number
        across = np.outer(np.cos(angles), frame[:3, 0]) + np.outer(np.sin(angles), frame[:3, 1])
        aims += list(target + far * reach_mm * across)
    tubes = list(_redeployed(best, evaluator))
    tips = np.array([each.lps_from_tip for each in tubes])
    at, towards = np.ascontiguousarray(tips[:, :3, 3]), np.ascontiguousarray(tips[:, :3, 2])
    branches = np.array([each.branch for each in tubes])
    for aim in aims:
        blockers, _lengths, costs = direct_arcs(evaluator.environment, at, towards, branches, aim)
        clear = np.flatnonzero(blockers == 0)
        # The needle is withdrawn to where its last arc begins, or to the tip of the tubes.
        starts = [best.path.frames()[len(best.path.arcs) - 1]] if len(best.path.arcs) > 1 else []
        for start in starts:
            arcs = np.concatenate([best.path.arcs[:-1], direct_path(start, aim).arcs])
            other = replace(best, path=replace(best.path, arcs=arcs))
            if evaluator.accepts(other):
                yield other
        left = OF_AIM
        for number in clear[np.argsort(np.where(clear == 0, -1.0, costs[clear]), kind="stable")].tolist():
            made = tubes[number]
            other = replace(best, deployment=made, path=direct_path(made.lps_from_tip, aim))
            if left and evaluator.accepts(other):
                left -= number > 0
                yield other


def _redeployed(best: Candidate, evaluator: CandidateEvaluator) -> Iterator[Deployment]:
    """Yield the tubes of a candidate, the same turned and moved, and others from the same place."""
    yield best.deployment
    system, frame = evaluator.task.system, best.tip.lps_from_scope_tip
    for turn, *shifts in product(TURNS_RAD.tolist(), SHIFTS_MM, SHIFTS_MM):
        if turn or any(shifts):
            other = varied(evaluator, best, turn, [*shifts, *[0.0] * len(system.tubes.nested)])
            if other is not None:
                yield other.deployment

    def worthwhile(positions: Float, tangents: Float) -> Bool:
        target = evaluator.task.target.lps_mm
        return np.isfinite(workspace_lengths(evaluator.environment, positions, tangents, target))

    enumerator = SiteEnumerator(
        evaluator.task.lung, system.tubes, system.margins, with_fissures=evaluator.task.with_fissures
    )
    found = enumerator.deployments(frame[:3, [3, 2, 0]].T.ravel(), worthwhile)
    for entry in range(found.count):
        made = evaluator.tubes.choose(frame, *found.choice(entry))
        if not isinstance(made, str):
            yield made


def _together(known: _Known, enough: Bool) -> Int:
    """Return which way each pass goes, `(K,)`, so that passes most often take enough together.

    Each two passes that follow each other are chosen anew together while the others stay.

    Args:
        enough ((W,) bool): Which ways take enough as planned: the first pass goes one of them.
    """
    count, candidates, _draws = known.taken.shape
    join = np.maximum if len(known.wanted.covered) else np.add
    chosen, best = np.zeros(count, dtype=np.int64), -1.0
    for _sweep in range(SWEEPS):
        before = best
        for one, two in pairwise((*range(count), 0)):
            others = [n for n in range(count) if n not in (one, two)]
            kept, taken = np.ones(known.clear.shape[2], dtype=bool), np.zeros(known.clear.shape[2])
            for n in others:
                kept, taken = kept & known.clear[n, chosen[n]], join(taken, known.taken[n, chosen[n]])
            for way in range(candidates):
                shares = known.share(kept & known.clear[one, way], join(taken, known.taken[one, way]), two)
                allowed = enough[way] if one == 0 else enough if two == 0 else True
                shares = np.where(allowed, shares, -1.0)
                if shares.max() > best:
                    best = float(shares.max())
                    chosen[one], chosen[two] = way, int(np.argmax(shares))
        if best <= before:
            break
    return chosen

"""Why there is no plan for a window of the breath: which phase and structure stop how many deployments."""

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator

from anatomy.base.words import plural
from lungaccess.planning.coupled.search.direct_candidates import direct_candidates
from lungaccess.planning.coupled.search.window_search import WindowSearch, WindowTubeSearch, window_search
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.window import WindowLimit
from lungaccess.uncertainty.breathing.window import require_motion

WORTH_SAYING = 0.01
"""Phases of which a plan is not worth a sentence are fewer than this share of the breath."""


def explain_window(search: WindowSearch | WindowTubeSearch, iterations: int) -> NoPlan | None:
    """Return the `NoPlan` of a search for a window; None if the breath is not what stops every deployment.

    Every deployment that reaches its aim is counted once: it misses the target, is stopped in the
    masks' phase, or is refused at a phase of the breath.
    """
    evaluator, task = search.window_evaluator, search.task
    reaching = direct_candidates(task, search.atlas, evaluator, search.aims.points).promising
    misses = search.aims.misses_mm[search.atlas.deployments.site[reaching]]
    missing = misses[misses > 0.0]
    refused = search.windows.refused
    if not len(missing) and not refused:
        return None
    counts: dict[str, int] = {}
    if len(missing):
        begin, end = (100.0 * phase for phase in evaluator.phases or (0.0, 1.0))
        where = f"between {begin:g} % and {end:g} % of the breath by {missing.min():.2f} mm at least"
        counts[f"miss the moving target {where}, wherever they aim"] = len(missing)
    with_needle, blockers = task.system.needle is not None, search.windows.blockers
    stopped = (
        "are stopped by {} in the masks' phase" if with_needle else "are refused in the masks' phase: {}"
    )
    for why, number in search.arcs.reasons(blockers[blockers != 0]).items():
        counts[stopped.format(why)] = number
    counts |= dict(_by_structure(refused.values()))
    left = len(reaching) - sum(counts.values())
    if left:
        counts["are refused by the whole proof in the masks' phase"] = left
    wanted = "a window" if evaluator.phases is None else "the phases {:g} to {:g}".format(*evaluator.phases)
    said = ", ".join(f"{number} {what}" for what, number in sorted(counts.items(), key=lambda each: -each[1]))
    reaches = "whose needle reaches its aim" if with_needle else "that may reach their aim"
    reason = f"of {plural(len(reaching), 'deployment')} {reaches} {said}"
    return NoPlan(
        f"No plan for {wanted} of the breath after {iterations} iterations: {reason}",
        reasons={f"breathing: deployments that {what}": number for what, number in counts.items()},
        main_reason=reason,
        advice=_advice(search),
    )


def _by_structure(limits: Iterable[WindowLimit]) -> Iterator[tuple[str, int]]:
    """Yield what the breath brings too near, with the phase at which it first does, and how often."""
    phases: dict[str, list[float]] = defaultdict(list)
    for limit in limits:
        phases[limit.what].append(limit.phase)
    for what, found in phases.items():
        where = f"at {100.0 * min(found):.0f} %"
        if max(found) - min(found) > WORTH_SAYING:
            where = f"between {100.0 * min(found):.0f} % and {100.0 * max(found):.0f} %"
        yield f"are refused {where} of the breath because {what}", len(found)


def _advice(search: WindowSearch | WindowTubeSearch) -> str:
    """Say which of the phases that were asked for a plan was found for, the most that there are."""
    asked = search.window_evaluator.phases
    simplest = "" if search.task.system.needle is None else " by a single arc"
    if asked is None:
        return f"No phase of the breath has a plan{simplest}; plan without --objective window"
    motion = require_motion(search.task.lung)
    middle = min(max(motion.masks_phase, asked[0]), asked[1])
    widest = window_search(search.task, search.atlas, None, widest=True, middle=middle)
    best = (0.0, 0.0)
    for number, step in enumerate(widest.windows.steps()):
        window = widest.window_evaluator.window
        for begin, end in () if step.candidate is None or window is None else window.phases.tolist():
            held = max(begin, asked[0]), min(end, asked[1])
            best = max(best, held, key=lambda each: each[1] - each[0])
        # Deployments whose windows are computed for the advice: of many, those that may have the widest.
        if number > 150:
            break
    first, last = math.ceil(100.0 * best[0]) / 100.0, math.floor(100.0 * best[1]) / 100.0
    if last - first < WORTH_SAYING:
        return f"No part of these phases was found that has a plan{simplest}"
    return f"The phases {first:g} to {last:g} have a plan (--phases {first:g}:{last:g})"

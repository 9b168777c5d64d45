"""Why there is no plan, or none for a window of the breath: the reasons counted, and what would help."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from anatomy.base.words import plural
from lungaccess.planning.coupled.atlas import Atlas, motions_of
from lungaccess.planning.coupled.counterfactuals import Counterfactual, find_counterfactuals
from lungaccess.planning.coupled.search.aimed_tubes import NO_SOLUTION, AimedTubes
from lungaccess.planning.coupled.search.direct_arcs import DirectArcs
from lungaccess.planning.coupled.search.direct_candidates import direct_candidates
from lungaccess.planning.coupled.search.window_search import WindowSearch, WindowTubeSearch, window_search
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.window import WindowLimit
from lungaccess.problem.task import Task
from lungaccess.uncertainty.breathing.window import require_motion
from stages.needle import needle_environment


def explain(
    task: Task, atlas: Atlas, blocked: Counter[str], iterations: int, *, counterfactuals: bool = True
) -> NoPlan:
    """Return the `NoPlan` of a search that ended without a plan.

    Args:
        blocked: How many direct arcs were stopped in the search, by what stopped them.
        counterfactuals: Whether changes of the device are looked for; without them the advice is empty.
    """
    if task.system.needle is None:
        return _explain_tubes(AimedTubes(task, atlas), blocked, iterations, counterfactuals)
    arcs = DirectArcs(task, atlas)
    main_reason = _before_the_needle(task, atlas) or _main_reason(arcs, blocked)
    found = f"No plan to the target after {iterations} iterations: {main_reason}"
    reasons = _reasons(arcs, blocked)
    if not counterfactuals:
        return NoPlan(found, reasons=reasons, main_reason=main_reason)
    direct = _reached(arcs)
    changes = find_counterfactuals(task, atlas) if atlas.deployments.count and not direct else ()
    return NoPlan(
        found,
        reasons=reasons,
        main_reason=main_reason,
        advice=_advice(arcs, direct, changes),
        counterfactuals={str(change): change.plan for change in changes},
    )


def _explain_tubes(
    aimed: AimedTubes, blocked: Counter[str], iterations: int, counterfactuals: bool
) -> NoPlan:
    """Return the `NoPlan` of a search without a needle."""
    atlas, near = aimed.atlas, len(aimed.promising)
    main_reason = _before_the_needle(aimed.task, atlas)
    if not main_reason:
        main_reason = f"the tip of the tubes was found to come within {aimed.nearest_mm:.1f} mm of the target"
        stopped = {why: n for why, n in blocked.items() if why != NO_SOLUTION}
        if stopped:
            main_reason += f"; nearer it is refused, mostly because {max(stopped, key=stopped.__getitem__)}"
    reasons = {
        **_scope_reasons(aimed.task, atlas),
        **{f"tube: {why}": count for why, count in atlas.deployments.refused.items()},
        "tube: scope tips with a deployment that ends near the target": near,
        **{f"tube, aimed at the target: {why}": count for why, count in sorted(blocked.items())},
    }
    advice = ""
    if atlas.motions.count == 0:
        advice = _thinner_scope(aimed.task, atlas.motions.passages.widest_scope_mm)
    changes = find_counterfactuals(aimed.task, atlas) if counterfactuals and atlas.deployments.count else ()
    if changes:
        advice = " or ".join(str(change) for change in changes)
        advice = f"{advice[0].upper()}{advice[1:]} would reach it"
    return NoPlan(
        f"No plan to the target after {iterations} iterations: {main_reason}",
        reasons=reasons,
        main_reason=main_reason,
        advice=advice
        or "A system with a needle goes on from where the tubes end; `--system auto` tries every preset",
        counterfactuals={str(change): change.plan for change in changes},
    )


def _before_the_needle(task: Task, atlas: Atlas) -> str:
    """Say what keeps scope or tubes from every deployment; nothing if there are some."""
    if atlas.motions.count == 0:
        scope = f"the scope ({task.system.scope.outer_diameter_mm:g} mm) fits nowhere"
        passages = atlas.motions.passages
        if (passages.passable & passages.exits_ahead).any():
            return (
                "no motion brings the scope to a place from which tubes leave the airway: its bending "
                "section does not pass the forks"
            )
        generation, excess = atlas.motions.passages.narrowest
        if generation < 0:
            return f"{scope}; no airway lies in lung tissue"
        return f"{scope}; the airway is too narrow at generation {generation}, {_typically(task, excess)}"
    if atlas.deployments.count == 0:
        return "the tubes cannot leave the airway safely from any scope tip"
    return ""


def _main_reason(arcs: DirectArcs, blocked: Counter[str]) -> str:
    if not len(arcs.in_workspace):
        return "the target lies outside the needle's workspace for every deployment"
    obstacles = blocked.copy()
    del obstacles["nothing"], obstacles["the needle's limits"]
    most = f", mostly by {obstacles.most_common(1)[0][0]}" if obstacles else ""
    count = arcs.atlas.deployments.count
    # A few deployments far off would else hide that the needle cannot bend to the target from all others.
    if len(arcs.in_workspace) < 0.01 * count:
        return (
            f"the target lies outside the needle's workspace for {count - len(arcs.in_workspace)} of {count} "
            f"deployments, and every path tried from the others is blocked{most}"
        )
    return f"every path tried from a deployment that could reach the target is blocked{most}"


def _reasons(arcs: DirectArcs, blocked: Counter[str]) -> dict[str, int]:
    """Count, stage by stage, what was ruled out and why."""
    atlas = arcs.atlas
    reasons = _scope_reasons(arcs.task, atlas)
    reasons |= {f"tube: {why}": count for why, count in atlas.deployments.refused.items()}
    outside = atlas.deployments.count - len(arcs.in_workspace)
    reasons["needle: deployments whose workspace does not hold the target"] = outside
    for name, count in sorted(blocked.items()):
        if name != "nothing":
            reasons[f"needle: arcs stopped by {name}"] = count
    return reasons


def _typically(task: Task, excess_mm: float) -> str:
    """Say how much an airway lacks in diameter, and whether its mask can tell so little."""
    voxel_mm = float(task.lung.grid.spacing_mm.max())
    unsure = f", less than a voxel of the masks, {voxel_mm:.2f} mm" if 2 * excess_mm < voxel_mm else ""
    return f"typically by {2 * excess_mm:.1f} mm{unsure}"


def _scope_reasons(task: Task, atlas: Atlas) -> dict[str, int]:
    """Count scope tips, airways that are too narrow or end far off, and the deployments looked at."""
    passable = atlas.motions.passages.passable
    away_mm = np.linalg.norm(task.lung.tree.points_lps - task.target.lps_mm, axis=1)
    nearest = f"the nearest {away_mm.min():.0f} mm from the target"
    passed = f"the nearest {away_mm[passable].min():.0f} mm" if passable.any() else "none"
    reasons = {
        f"masks: points of the airways, {nearest}": len(away_mm),
        f"scope: points of the airways that it passes, {passed} from the target": int(passable.sum()),
        "scope: tips with a proved motion": atlas.motions.count,
    }
    generation, excess = atlas.motions.passages.narrowest
    closed = int((~atlas.motions.passages.passable).sum())
    if closed:
        reasons[
            f"scope: tree points beyond airways too narrow (mostly at generation {generation}, "
            f"{_typically(task, excess)})"
        ] = closed
    return reasons | {"tube: deployments looked at": atlas.deployments.candidates}


def _advice(arcs: DirectArcs, direct: bool, changes: tuple[Counterfactual, ...]) -> str:
    """Say what would help, the smallest change first.

    Where no scope tip or no deployment is left, say which change brings one back, if that is known.
    """
    atlas = arcs.atlas
    if atlas.motions.count == 0:
        return _thinner_scope(arcs.task, atlas.motions.passages.widest_scope_mm)
    if atlas.deployments.count == 0:
        return ""
    if direct:
        return "The search was too short: a single arc from a deployment of the atlas reaches the target"
    said = []
    if changes:
        first, *others = (str(change) for change in changes)
        also = f"; so would {' or '.join(others)}" if others else ""
        said.append(f"{first[0].upper()}{first[1:]} would reach it{also}")
    if atlas.with_fissures and _reached(arcs, with_fissures=False):
        said.append(
            "Crossing a fissure would reach it (--allow-fissures), at the price of piercing the pleura twice"
        )
    if not said:
        return "No tighter or thinner needle and no thinner bronchoscope reaches it with a single arc"
    return ". ".join(said)


def _thinner_scope(task: Task, in_the_middle_mm: float) -> str:
    """Say how thin the scope must be for a motion to an exit, in tenths of a millimetre.

    `in_the_middle_mm` is the largest diameter that fits on the medial axis; beside it there may be more room.
    """
    scope = task.system.scope
    fits, fits_not = math.floor(10.0 * in_the_middle_mm), math.ceil(10.0 * scope.outer_diameter_mm)
    if fits == 0 or not _moves(task, fits):
        return ""
    while fits_not - fits > 1:
        middle = (fits + fits_not) // 2
        if _moves(task, middle):
            fits = middle
        else:
            fits_not = middle
    return f"A bronchoscope of {fits / 10:.1f} mm or less fits somewhere"


def _moves(task: Task, tenths: int) -> bool:
    """Tell whether a scope so thick, in tenths of a millimetre, gets anywhere."""
    scope = replace(task.system.scope, outer_diameter_mm=tenths / 10.0)
    return motions_of(task.lung, replace(task.system, scope=scope)).count > 0


def _reached(arcs: DirectArcs, *, with_fissures: bool = True) -> bool:
    """Tell whether a direct arc from the atlas reaches the target, if need be through fissures."""
    task = arcs.task
    environment = arcs.evaluator.environment
    if not with_fissures:
        needle, margins = task.system.require_needle("A direct arc"), task.system.margins
        environment = needle_environment(task.lung, needle, margins, with_fissures=False)
    return bool((arcs.blockers(arcs.in_workspace, environment)[0] == 0).any())


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
        advice=_phases_with_a_plan(search),
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


def _phases_with_a_plan(search: WindowSearch | WindowTubeSearch) -> str:
    """Say which of the phases that were asked for a plan was found for, the most that there are."""
    asked = search.window_evaluator.phases
    simplest = "" if search.task.system.needle is None else " by a single arc"
    if asked is None:
        return f"No phase of the breath has a plan{simplest}; plan without --objective window"
    middle = min(max(require_motion(search.task.lung).masks_phase, asked[0]), asked[1])
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

"""Why there is no plan: the reasons counted, and the smallest change of device that would help."""

from __future__ import annotations

import math

from lungaccess.coupled.counterfactuals import Remedy, remedies
from lungaccess.coupled.search import AtlasSearch
from lungaccess.plans.no_plan import NoPlan
from stages.needle import Needle, direct_arcs, needle_environment


def explain(search: AtlasSearch, iterations: int) -> NoPlan:
    """Return the `NoPlan` of a search that ended without a plan."""
    workable = search.atlas.deployments.count > 0 and not _reached_with(search, search.task.system.needle)
    found = remedies(search) if workable else ()
    return NoPlan(
        f"No plan to the target after {iterations} iterations: {_main_reason(search)}",
        reasons=_reasons(search),
        advice=_advice(search, found),
        plans_with_changes={str(remedy): remedy.plan for remedy in found},
    )


def _main_reason(search: AtlasSearch) -> str:
    atlas = search.atlas
    if atlas.sites.count == 0:
        scope = f"the scope ({search.task.system.scope.outer_diameter_mm:g} mm) has nowhere to stand"
        generation, excess = atlas.sites.narrowest
        if generation < 0:
            return f"{scope}; no airway lies in lung tissue"
        narrow = f"too narrow at generation {generation}, typically by {2 * excess:.1f} mm"
        return f"{scope}; the airway is {narrow}"
    if atlas.deployments.count == 0:
        return "the tubes cannot leave the airway safely from any site"
    if not len(search.in_workspace):
        return "the target lies outside the needle's workspace for every deployment"
    blocked = search.desk.blocked.copy()
    del blocked["nothing"], blocked["the needle's limits"]
    most = f", mostly by {blocked.most_common(1)[0][0]}" if blocked else ""
    return f"every path tried from a deployment that could reach the target is blocked{most}"


def _reasons(search: AtlasSearch) -> dict[str, int]:
    """Count, stage by stage, what was ruled out and why."""
    atlas = search.atlas
    reasons = {"scope: sites": atlas.sites.count}
    generation, excess = atlas.sites.narrowest
    closed = int((~atlas.sites.passable).sum())
    if closed:
        reasons[
            f"scope: tree points beyond airways too narrow (mostly at generation {generation}, "
            f"typically by {2 * excess:.1f} mm)"
        ] = closed
    reasons["tube: deployments looked at"] = atlas.deployments.candidates
    reasons |= {f"tube: {why}": count for why, count in atlas.deployments.refused.items()}
    outside = atlas.deployments.count - len(search.in_workspace)
    reasons["needle: deployments whose workspace does not hold the target"] = outside
    for name, count in sorted(search.desk.blocked.items()):
        if name != "nothing":
            reasons[f"needle: arcs stopped by {name}"] = count
    return reasons


def _advice(search: AtlasSearch, found: tuple[Remedy, ...]) -> str:
    """Say what would help, the smallest change first.

    Where no site or no deployment is left, say which change brings one back, if that is known.
    """
    atlas, system = search.atlas, search.task.system
    if atlas.sites.count == 0:
        return _thinner_scope(atlas.sites.widest_scope_mm)
    if atlas.deployments.count == 0:
        return ""
    if _reached_with(search, system.needle):
        return "The search was too short: a single arc from a deployment of the atlas reaches the target"
    said = []
    if found:
        first, *others = (str(remedy) for remedy in found)
        also = f"; so would {' or '.join(others)}" if others else ""
        said.append(f"{first[0].upper()}{first[1:]} would reach it{also}")
    if atlas.with_fissures and _reached_with(search, system.needle, with_fissures=False):
        said.append(
            "Crossing a fissure would reach it (--allow-fissures), at the price of piercing the pleura twice"
        )
    if not said:
        return "No tighter or thinner needle and no thinner bronchoscope reaches it with a single arc"
    return ". ".join(said)


def _thinner_scope(widest_mm: float) -> str:
    """Say how thin the scope must be to have a site, rounded down to a tenth."""
    tenths = math.floor(10.0 * widest_mm)
    return f"A bronchoscope of {tenths / 10:.1f} mm or less has a place to stand" if tenths else ""


def _reached_with(search: AtlasSearch, needle: Needle, *, with_fissures: bool | None = None) -> bool:
    """Tell whether a direct arc of another needle reaches the target from the same deployments."""
    atlas, task = search.atlas, search.task
    environment = needle_environment(
        task.lung,
        needle,
        task.system.margins,
        with_fissures=task.with_fissures if with_fissures is None else with_fissures,
    )
    entries, target = atlas.deployments, task.target.lps_mm
    near, _lengths = atlas.index.holding(environment, target)
    blockers, _lengths, _costs = direct_arcs(
        environment,
        entries.positions[near],
        entries.tangents[near],
        entries.branch[near],
        target,
    )
    return bool((blockers == 0).any())

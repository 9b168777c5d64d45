"""Run one search for the command line: keep the best plan and how its cost fell over time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from stages.needle import Objective

if TYPE_CHECKING:
    from anatomy.lung import Lung
    from lungaccess.coupled.atlas import Atlas
    from lungaccess.coupled.planner import ProgressEvent
    from lungaccess.plans.plan import Plan
    from lungaccess.problem.system import System
    from lungaccess.problem.target import Target
    from lungaccess.report import CostPoint

DEMO_SPACING_MM = 1.25


class Display(AbstractContextManager[Any], Protocol):
    """What a search is shown on."""

    def update(self, description: str, elapsed_s: float, iteration: int, best_cost: float | None) -> None:
        """Show the state of the search."""

    def better(self, elapsed_s: float, cost: float) -> None:
        """Show that a better plan was found."""

    def interrupted(self) -> None:
        """Show that the user ended the search."""


@dataclass(frozen=True, kw_only=True)
class SearchRequest:
    """What to search for, with what, and how long.

    Parameters
    ----------
    system : System
    target : str or None
        A point with its frame, ``ras:x,y,z`` or ``lps:x,y,z``; None for a nodule.
    nodule : int or None
        Number of a nodule, from 1.
    objective : Objective
    method : str
        One of `lungaccess.coupled.planner.METHODS`.
    seed : int
    time_s : float or None
        Planning time; None for as long as the iterations take.
    iterations : int or None
    cache : Path or None
        Folder where the deployment atlas is kept; None for the usual one.
    processes : int
        How many of them refine the plan at the same time.
    """

    system: System
    target: str | None = None
    nodule: int | None = None
    objective: Objective = Objective(inverse_clearance=1.0)
    method: str = "atlas"
    seed: int = 0
    time_s: float | None = None
    iterations: int | None = None
    cache: Path | None = None
    processes: int = 1


class CostHistory:
    """Collects how the best cost falls while a search runs; its clock is that of the planner."""

    def __init__(self, display: Display) -> None:
        from lungaccess.report import CostPoint

        self._point = CostPoint
        self._display = display
        self._iteration = 0
        self._best: float | None = None
        self.points: list[CostPoint] = []

    def on_progress(self, event: ProgressEvent) -> None:
        """Take over what the planner says about itself."""
        self._iteration = event.iteration
        self._append(event.elapsed_s)
        self._display.update(event.message or event.phase, event.elapsed_s, event.iteration, self._best)

    def on_plan(self, plan: Plan) -> None:
        """Take over a better plan."""
        self._best = plan.cost
        self._iteration = plan.iterations
        elapsed_s = float(plan.timing["planning_s"])
        self._append(elapsed_s)
        self._display.better(elapsed_s, self._best)

    def _append(self, elapsed_s: float) -> None:
        self.points.append(self._point(elapsed_s=elapsed_s, iteration=self._iteration, best_cost=self._best))


def run_search(
    lung: Lung, target: Target, request: SearchRequest, display: Display
) -> tuple[Plan, list[CostPoint]]:
    """Search until the budget is spent and return the best plan and the history of its cost.

    An interruption from the keyboard ends the search early; the best plan so far is kept.

    Raises
    ------
    lungaccess.plans.no_plan.NoPlan
        If no plan was found.
    """
    history = CostHistory(display)
    best: Plan | None = None
    with display:
        atlas = _atlas(lung, request, history)
        plans = _planner()(
            lung,
            request.system,
            target,
            objective=request.objective,
            method=request.method,
            seed=request.seed,
            iterations=request.iterations,
            time_s=request.time_s,
            atlas=atlas,
            processes=request.processes,
            on_progress=history.on_progress,
        )
        try:
            for best in plans:
                history.on_plan(best)
        except KeyboardInterrupt:
            if best is None:
                raise
            display.interrupted()
    if best is None:
        raise _ended_silently()
    return best, history.points


def _atlas(lung: Lung, request: SearchRequest, history: CostHistory) -> Atlas:
    from lungaccess.coupled.atlas_store import open_atlas
    from lungaccess.coupled.planner import atlas_event

    return open_atlas(
        lung,
        request.system,
        cache=request.cache,
        progress=lambda share: history.on_progress(atlas_event(share)),
    )


def _planner() -> Callable[..., Iterator[Plan]]:
    from lungaccess.coupled.planner import plan

    return plan


def _ended_silently() -> Exception:
    from lungaccess.plans.no_plan import NoPlan

    return NoPlan("The search ended without a plan", reasons={}, advice="Give it more time")


def demo_lung(seed: int, cache: Path | None, progress: Callable[[str], None]) -> Lung:
    """Make the synthetic patient of the demonstration; its prepared anatomy is cached.

    An adult, because the presets are: a child's airways hold no bronchoscope of 4 mm.
    """
    from anatomy.phantom import make_phantom
    from anatomy.store import open_lung

    images = make_phantom(seed=seed, size="adult", spacing_mm=DEMO_SPACING_MM).images
    return open_lung(dict(images.sources), lambda: images, cache=cache, progress=progress)

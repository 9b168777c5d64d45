"""From a request for one system to plans."""

from collections.abc import Callable, Iterator

from lungaccess.planning.coupled.atlas import Atlas, build_atlas, require_same
from lungaccess.planning.driver import ProgressEvent, atlas_event, drive, place_part
from lungaccess.planning.searches import CostFinder, require_method
from lungaccess.planning.success.finder import ContestFinder
from lungaccess.plans.plan import Plan
from lungaccess.problem.request import Request


def run(
    request: Request,
    *,
    atlas: Atlas | None = None,
    counterfactuals: bool = True,
    on_progress: Callable[[ProgressEvent], None] | None = None,
) -> Iterator[Plan]:
    """Answer a request for one system; yield each plan that is better than the one before.

    At the end comes the best one again, with fewer motions of the scope to the same tip where they are found.

    Args:
        atlas: Made with `build_atlas` beforehand; made here if None.
        counterfactuals: Whether a `NoPlan` looks for the change of device that would help, in some ten
            seconds.
        on_progress: Gets a `ProgressEvent` about ten times a second.

    Raises:
        NoPlan: If the search ends without a plan; counts the reasons.
        SettingsError: If there is no such method, it needs a needle that the system does not have, or the
            atlas belongs to another lung or system.
        TargetError: If the target lies outside the lung or inside an obstacle, or nothing of the atlas comes
            near the stated place.
    """
    require_method(request)
    task = request.task
    tell = on_progress or (lambda _event: None)
    if atlas is not None:
        require_same(atlas, request.lung, request.system)
    atlas = atlas or build_atlas(
        request.lung, request.system, progress=lambda share: tell(atlas_event(share))
    )
    made = ContestFinder if request.counts else CostFinder
    return drive(made(request, task, place_part(request, atlas), counterfactuals), request, tell)

"""The names of all planners of the needle: the one list that functions, studies and the command line read."""

from __future__ import annotations

from functools import cache

from anatomy.errors import MissingLibraryError, SettingsError
from anatomy.suggestion import did_you_mean

OUR_PLANNERS = ("rrt", "ao-rrt", "optimal", "resolution", "decide")
"""Searches of the needle stage; `stages.needle.search.planners.PLANNERS` makes them."""
OMPL_PLANNERS = ("control.RRT", "control.EST", "control.KPIECE1")
"""Planners of OMPL itself.  They steer by chance and look at no objective."""
NEEDLE_PLANNERS = (*OUR_PLANNERS, *OMPL_PLANNERS)
OMPL_TOLERANCE_MM = 1.0
"""Distance to the target that counts as reached by OMPL's planners alone: they hardly ever come nearer."""


@cache
def has_ompl() -> bool:
    """Tell whether OMPL can be imported; it has no wheels for some platforms."""
    try:
        import stages.needle.ompl  # noqa: F401
    except MissingLibraryError:
        return False
    return True


def require_planner(name: str) -> None:
    """Raise SettingsError unless a name is one of NEEDLE_PLANNERS, and OMPL is there for its own."""
    if name in OMPL_PLANNERS:
        import stages.needle.ompl  # noqa: F401  # Raises where OMPL is missing.
    if name not in NEEDLE_PLANNERS:
        raise SettingsError(
            f"There is no needle planner {name!r}",
            expected=f"one of {', '.join(NEEDLE_PLANNERS)}",
            remedy=did_you_mean(name, NEEDLE_PLANNERS) or "Choose one of them",
        )

"""The planners of the needle by name, and whether one can be chosen here: its library is there."""

from functools import cache

from anatomy.base.errors import MissingLibraryError, SettingsError
from anatomy.base.plugins import registered
from anatomy.base.words import did_you_mean

OUR_PLANNERS = ("rrt", "ao-rrt", "optimal", "resolution", "decide")
"""Searches of the needle stage; `stages.needle.search.planners.searches` makes them."""
OMPL_PLANNERS = ("control.RRT", "control.EST", "control.KPIECE1")
"""Planners of OMPL itself.  They steer by chance and look at no objective."""
NEEDLE_PLANNERS = (*OUR_PLANNERS, *OMPL_PLANNERS)
PLUGINS = "lungaccess.needle_planners"
"""The group of entry points by which packages add planners, whose names are known, too."""
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
    """Raise SettingsError unless a name is that of a planner, and OMPL is there for its own."""
    if name in OMPL_PLANNERS:
        import stages.needle.ompl  # noqa: F401  # Raises where OMPL is missing.
    known = (*NEEDLE_PLANNERS, *registered(PLUGINS))
    if name not in known:
        raise SettingsError(
            f"There is no needle planner {name!r}",
            expected=f"one of {', '.join(known)}",
            remedy=did_you_mean(name, known) or "Choose one of them",
        )

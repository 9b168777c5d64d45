"""Whether a planner of the needle can be chosen here: its name is known, and its library is there."""

from functools import cache

from anatomy.base.errors import MissingLibraryError, SettingsError
from anatomy.base.plugins import registered
from anatomy.base.words import did_you_mean
from stages.needle.planner_names import NEEDLE_PLANNERS, OMPL_PLANNERS, PLUGINS


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

"""Whether a planner of the needle can be chosen here: its name is known, and its library is there."""

from __future__ import annotations

from functools import cache

from anatomy.base.errors import MissingLibraryError, SettingsError
from anatomy.base.suggestion import did_you_mean
from stages.needle.planner_names import NEEDLE_PLANNERS, OMPL_PLANNERS


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

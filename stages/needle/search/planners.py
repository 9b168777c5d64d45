"""The searches of the needle stage by name."""

from collections.abc import Callable

from anatomy.base.plugins import registered
from stages.needle.environment import NeedleEnvironment
from stages.needle.objective import SHORTEST, Objective
from stages.needle.path import Query
from stages.needle.planner_names import PLUGINS
from stages.needle.search.base import RestartingRRT, Search
from stages.needle.search.decision import Decision
from stages.needle.search.optimal import OptimalSearch
from stages.needle.search.portfolio import PortfolioSearch
from stages.needle.search.resolution import ResolutionSearch

MakeSearch = Callable[..., Search]
"""Makes a search for cheap paths of an environment, a query, a seed that repeats it, and an `objective`."""


def _makes(
    cls: type[RestartingRRT] | type[PortfolioSearch] | type[ResolutionSearch] | type[Decision],
) -> MakeSearch:
    """Return what makes searches of a class; in the resolution search nothing is random."""

    def make(
        environment: NeedleEnvironment, query: Query, seed: int, objective: Objective = SHORTEST
    ) -> Search:
        if issubclass(cls, ResolutionSearch):
            return cls(environment, query, objective=objective)
        return cls(environment, query, seed=seed, objective=objective)

    return make


_OWN: dict[str, MakeSearch] = {
    "rrt": _makes(RestartingRRT),
    "ao-rrt": _makes(OptimalSearch),
    "optimal": _makes(PortfolioSearch),
    "resolution": _makes(ResolutionSearch),
    "decide": _makes(Decision),
}
"""See docs/explanation/needle.md; `stages.needle.planner_names` states the names for a quick start."""


def searches() -> dict[str, MakeSearch]:
    """Return searches by name; others add a `MakeSearch` by the entry point `lungaccess.needle_planners`."""
    return _OWN | registered(PLUGINS)

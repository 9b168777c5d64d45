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


def _resolution(
    environment: NeedleEnvironment, query: Query, seed: int = 1, objective: Objective = SHORTEST
) -> Search:
    """Make a resolution search: nothing in it is random."""
    return ResolutionSearch(environment, query, objective=objective)


_OWN: dict[str, MakeSearch] = {
    "rrt": RestartingRRT,
    "ao-rrt": OptimalSearch,
    "optimal": PortfolioSearch,
    "resolution": _resolution,
    "decide": Decision,
}
"""See docs/explanation/needle.md; `stages.needle.planner_names` states the names for a quick start."""


def searches() -> dict[str, MakeSearch]:
    """Return searches by name; others add a `MakeSearch` by the entry point `lungaccess.needle_planners`."""
    return _OWN | registered(PLUGINS)

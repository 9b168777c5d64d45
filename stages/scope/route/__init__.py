"""Routes for a curvature-limited device along any tree of tubes with radii [Li2021]."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from stages.scope.route.centreline import Centreline as Centreline
    from stages.scope.route.centreline import from_graph as from_graph
    from stages.scope.route.centreline import from_image as from_image
    from stages.scope.route.centreline import from_lung as from_lung
    from stages.scope.route.centreline import from_mask as from_mask
    from stages.scope.route.metrics import measure as measure
    from stages.scope.route.planner import Route as Route
    from stages.scope.route.planner import require_proved as require_proved
    from stages.scope.route.planner import try_route as try_route
    from stages.scope.route.search import NoRouteError as NoRouteError
    from stages.scope.route.settings import RouteLimits as RouteLimits

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""Routes for a curvature-limited device along any tree of tubes with radii [Li2021]."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from stages.scope.route.centreline import Centreline, from_graph, from_image, from_lung, from_mask
    from stages.scope.route.curve import Curve
    from stages.scope.route.genetic import GeneticSettings
    from stages.scope.route.guide_path import GuidePath, NoRouteError
    from stages.scope.route.planner import Replanner, Route, plan_route, require_proved
    from stages.scope.route.proof import Proof, RouteLimits, RouteMetrics, measure

__getattr__, __dir__ = lazy_exports(__name__, __file__)

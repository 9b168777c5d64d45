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
    from stages.scope.route.centreline import from_tree as from_tree
    from stages.scope.route.curve import Curve as Curve
    from stages.scope.route.curve import interpolate as interpolate
    from stages.scope.route.genetic import GeneticSettings as GeneticSettings
    from stages.scope.route.guide_path import GuidePath as GuidePath
    from stages.scope.route.metrics import RouteMetrics as RouteMetrics
    from stages.scope.route.metrics import measure as measure
    from stages.scope.route.planner import Replanner as Replanner
    from stages.scope.route.planner import Route as Route
    from stages.scope.route.planner import plan_route as plan_route
    from stages.scope.route.planner import require_proved as require_proved
    from stages.scope.route.planner import try_route as try_route
    from stages.scope.route.proof import Proof as Proof
    from stages.scope.route.proof import prove as prove
    from stages.scope.route.search import Links as Links
    from stages.scope.route.search import NoRouteError as NoRouteError
    from stages.scope.route.search import fewest_hops as fewest_hops
    from stages.scope.route.search import nearest_links as nearest_links
    from stages.scope.route.settings import RouteLimits as RouteLimits

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""Plan a route: search, spline, repair, proof; and plan it again when the anatomy has moved."""

from concurrent.futures import Executor
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Int
from anatomy.grid import read_only
from stages.scope.route.centreline import Centreline
from stages.scope.route.curve import Curve
from stages.scope.route.exact import Problem, repair_exact
from stages.scope.route.genetic import repair_genetic
from stages.scope.route.guide_path import (
    GuidePath,
    Links,
    NoRouteError,
    fewest_hops,
    guide_path_along,
    nearest_links,
)
from stages.scope.route.proof import Proof, RouteLimits

Repair = Literal["exact", "ga", "none"]


@frozen_record
class Route:
    """A route from start to goal.

    Args:
        nodes ((K,) int64): Nodes of the centreline that the search found.
        guide: These nodes, with start and goal.
        tentative: The spline through points of the guide path.
        curve: The route.
        proof: Of `curve`.
        repair: "exact", "ga" or "none".
        claimed: Whether the repair itself believes that the limits are kept: `ga` looks at path points alone.
    """

    nodes: Int
    guide: GuidePath
    tentative: Curve
    curve: Curve
    proof: Proof
    limits: RouteLimits
    repair: Repair
    claimed: bool

    @property
    def proved(self) -> bool:
        """Whether the whole curve is proved to keep its limits, and ends where it should."""
        return self.proof.holds and self.end_error_mm <= self.limits.end_tolerance_mm + 1e-9

    @property
    def end_error_mm(self) -> float:
        """How far the ends lie from the wanted start and goal, the larger of both."""
        off = self.curve.control_mm[[0, -1]] - self.guide.points_mm[[0, -1]]
        return float(np.linalg.norm(off, axis=1).max())


REPAIRS: tuple[Repair, ...] = get_args(Repair)


def plan_route(
    centreline: Centreline,
    start_mm: ArrayLike,
    goal_mm: ArrayLike,
    limits: RouteLimits,
    *,
    repair: Repair = "exact",
    links: Links | None = None,
    seed: int = 0,
    executor: Executor | None = None,
    require_proof: bool = True,
) -> Route:
    """Plan a route that is proved to keep its limits on the whole curve; all points are LPS mm.

    Breadth-first search over centreline nodes, a cubic B-spline through points of the guide path, and a
    repair of the segments that bend too much or come too near to the wall [Li2021].

    Args:
        repair: "exact": a nonlinear program; "ga": the genetic search of the paper, which has a seed; "none".
        links: Made with `nearest_links` beforehand, where many routes are planned on one centreline.
        executor: Repairs segments side by side.
        require_proof: Whether a curve that cannot be proved is refused; else `Route.proved` tells.

    Raises:
        NoRouteError: If start and goal are not joined, or no curve was found that can be proved.
        TargetError: If start or goal lies too near to the wall, or outside.
        SettingsError: If there is no such repair, or start and goal coincide.
    """
    start, goal = (np.array(point, dtype=np.float64).reshape(3) for point in (start_mm, goal_mm))
    if repair not in REPAIRS:
        raise SettingsError(f"There is no repair {repair!r}", expected=f"one of {', '.join(REPAIRS)}")
    centreline.require_inside(start, limits.needed_mm, "start")
    centreline.require_inside(goal, limits.needed_mm, "goal")
    links = nearest_links(centreline) if links is None else links
    nodes = fewest_hops(links, centreline.nearest_node(start), centreline.nearest_node(goal))
    guide = guide_path_along(centreline, nodes, start, goal)
    problem = Problem(guide=guide, centreline=centreline, limits=limits)
    route = _route(problem, nodes, repair, seed, executor)
    if require_proof:
        require_proved(route)
    return route


def require_proved(route: Route) -> None:
    """Raise `NoRouteError`, which says where and why, unless a route is proved."""
    if route.proved:
        return
    limits = route.limits
    if route.proof.holds:
        raise NoRouteError(
            f"The route ends {route.end_error_mm:.2f} mm from where it should",
            expected=f"at most {limits.end_tolerance_mm:g} mm",
            remedy="Allow a larger end tolerance, or use the exact repair",
        )
    failed = route.proof.failed_spans
    where = ", ".join(f"{x:.1f}" for x in route.proof.points_mm[failed[len(failed) // 2]])
    counts = "; ".join(f"{count} spans {why}" for why, count in route.proof.reasons().items())
    raise NoRouteError(
        f"No proved route was found with the repair {route.repair!r}: of {route.curve.n_spans} spans, "
        f"{counts}, as near LPS {where} mm",
        expected=f"at most {limits.max_curvature_per_mm:g} per mm, {limits.needed_mm:g} mm inside the lumen",
        remedy="Take a device that bends more or is thinner, or move start or goal",
    )


def _route(problem: Problem, nodes: Int, repair: Repair, seed: int, executor: Executor | None) -> Route:
    limits, tentative = problem.limits, problem.guide.curve()
    curve, claimed = tentative, True
    if repair == "exact":
        curve, proof = repair_exact(tentative, problem, executor)
        claimed = proof.holds
    else:
        if repair == "ga":
            curve, claimed = repair_genetic(
                tentative, problem.centreline, limits, seed=seed, executor=executor
            )
        proof = problem.prove(curve)
    return Route(
        nodes=read_only(nodes),
        guide=problem.guide,
        tentative=tentative,
        curve=curve,
        proof=proof,
        limits=limits,
        repair=repair,
        claimed=claimed,
    )


class Replanner:
    """Plans a route anew for each new state of the anatomy, at the rate of a tracker.

    What does not change while tubes move is kept: which nodes the old route passes, and which tubes are near.
    """

    def __init__(self, centreline: Centreline, route: Route) -> None:
        self._centreline, self._route = centreline, route
        self._kept, edges = _corridor(centreline, route.nodes)
        # All of these nodes are kept, and `_kept` is sorted: where one stands there is its new number.
        self._nodes, self._edges = (np.searchsorted(self._kept, nodes) for nodes in (route.nodes, edges))

    def replan(self, nodes_mm: ArrayLike) -> Route:
        """Return the route for the centreline with all its nodes `(N, 3)` at new places, LPS mm.

        Start and goal move along with the nodes nearest to them.

        Raises:
            NoRouteError, TargetError: As `plan_route`.
        """
        old = self._centreline
        moved = np.asarray(nodes_mm, dtype=np.float64)
        if moved.shape != old.nodes_mm.shape:
            raise SettingsError(
                f"{moved.shape[0]} nodes were given for a centreline of {old.n_nodes}", expected="all nodes"
            )
        kept, held, limits = self._kept, self._route.nodes[[0, -1]], self._route.limits
        here = Centreline(nodes_mm=moved[kept], radius_mm=old.radius_mm[kept], edges=self._edges)
        ends = self._route.guide.points_mm[[0, -1]] + moved[held] - old.nodes_mm[held]
        for point, name in zip(ends, ("start", "goal"), strict=True):
            here.require_inside(point, limits.needed_mm, name)
        guide = guide_path_along(here, self._nodes, *ends)
        problem = Problem(guide=guide, centreline=here, limits=limits)
        route = _route(problem, self._nodes, "exact", 0, None)
        require_proved(route)
        return route


def _corridor(centreline: Centreline, nodes: Int) -> tuple[Int, Int]:
    """Return the nodes near those of a route, and the edges among them."""
    from scipy.spatial import KDTree

    here, radius = centreline.nodes_mm, centreline.radius_mm
    distance, nearest = KDTree(here[nodes]).query(here)
    # A tube counts for replanning if it comes so near to one that the route runs through.
    near = distance <= radius + radius[nodes[nearest]] + 3.0
    near[nodes] = True
    return np.flatnonzero(near), centreline.edges[near[centreline.edges].all(axis=1)]

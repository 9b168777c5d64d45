"""Routes of limited curvature and tours to several lesions."""

from __future__ import annotations

import numpy as np

from benchmarks.fresh import FreshProcess
from experiments.support.tour_models import random_airway, random_lesions
from stages.scope.route.centreline import Centreline, from_tree
from stages.scope.route.guide_path import nearest_links
from stages.scope.route.planner import Replanner, plan_route
from stages.scope.route.proof import RouteLimits, prove
from stages.scope.tour.itinerary import shortest_tour
from stages.scope.tour.subtree import circuits, find_exits, subtree_to

COLD_RUN = """
from benchmarks.bench_route import Routes, Tours
Routes().setup()
tours = Tours()
tours.setup(5)
tours.time_circuits(5)
"""
LIMITS = RouteLimits(max_curvature_per_mm=0.08, device_radius_mm=0.5)


class Routes:
    """From the trachea to the deepest end of a random airway of eight orders."""

    def setup(self) -> None:
        """Make the airway, its links and one route, and compile."""
        tree = random_airway(1)
        self.line = from_tree(tree)
        self.links = nearest_links(self.line)
        self.ends = tree.points_lps[0], tree.points_lps[int(np.argmax(tree.distance_from_root_mm))]
        self.route = plan_route(self.line, *self.ends, LIMITS, links=self.links)
        self.replanner = Replanner(self.line, self.route)
        self.moved = self.line.nodes_mm + 4.0 * np.sin(self.line.nodes_mm / 60.0)
        self.replanner.replan(self.moved)

    def time_exact(self) -> None:
        """Search, spline, exact repair and proof."""
        plan_route(self.line, *self.ends, LIMITS, links=self.links)

    def time_genetic(self) -> None:
        """The same with the genetic repair."""
        plan_route(self.line, *self.ends, LIMITS, links=self.links, repair="ga", require_proof=False)

    def time_replan(self) -> None:
        """The route for a moved centreline; a tracker gives 40 a second."""
        self.replanner.replan(self.moved)

    def time_proof(self) -> None:
        """The proof alone."""
        prove(self.route.curve, self.line, max_curvature_per_mm=0.08, needed_mm=0.5)

    def time_links(self) -> None:
        """The neighbours of all nodes, once a centreline."""
        nearest_links(self.line)

    def time_cells(self) -> None:
        """The grid of cells, once a centreline."""
        fresh = Centreline(nodes_mm=self.line.nodes_mm, radius_mm=self.line.radius_mm, edges=self.line.edges)
        fresh.depth_mm(self.line.nodes_mm[:1])


class Tours:
    """The exact tour, and the circuits of least resistance."""

    params = (5, 9, 30)
    param_names = ("lesions",)

    def setup(self, lesions: int) -> None:
        """Make an airway with lesions."""
        tree = random_airway(2)
        self.subtree = subtree_to(tree, find_exits(tree, random_lesions(tree, lesions, 2)))
        shortest_tour(self.subtree)

    def time_shortest(self, lesions: int) -> None:
        """The shortest tour over all choices of exits."""
        shortest_tour(self.subtree)

    def time_circuits(self, lesions: int) -> None:
        """All circuits, up to nine lesions."""
        if lesions <= 9:
            circuits(self.subtree)


class Compile(FreshProcess):
    """All kernels of routes and tours in a new process, without and with cached ones."""

    code = COLD_RUN

    def time_routes_and_tours(self, cold: bool) -> None:
        """A route, a replan, a tour and its circuits."""
        self.run()

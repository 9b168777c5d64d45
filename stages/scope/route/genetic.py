"""Local repair of a route by a small genetic search, as [Li2021] prints it.

A chromosome has two genes: how many points of the segment count for nothing in the fit, and the largest sum
of squared displacements of a smoothing spline through the others.  Readings where the text leaves it open:
the points without weight are those in the middle of the segment; the ends of a segment keep a high weight
unless they are start or goal; the cost adds the means of distance to the centreline over radius and of
curvature over its limit, the length over that of the chord, and 10000 for each broken limit.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from functools import partial
from typing import TYPE_CHECKING, Annotated

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float
from stages.scope.route.centreline import Centreline
from stages.scope.route.curve import DEGREE, Curve, interpolate
from stages.scope.route.proof import RouteLimits

if TYPE_CHECKING:
    from scipy.spatial import KDTree

BROKEN = 1e4
"""Cost of a broken limit, the paper's 10000."""
FEASIBLE = 1e3
"""Costs below this break no limit: the other terms stay far below it."""


@settings
class GeneticSettings:
    """Settings of the genetic search; 8 chromosomes of which 4 mate are in the paper's figure.

    The limit of the rounds stands in place of the paper's time limit, so that runs repeat.  A segment is
    widened on both sides by a share of all points; the standard deviation of the noise is a share of the
    range of the genes.
    """

    population: Annotated[int, quantity("chromosomes", at_least=2, at_most=10_000)] = 8
    parents: Annotated[int, quantity("chromosomes that mate", at_least=2, at_most=10_000)] = 4
    generations: Annotated[int, quantity("rounds before the first look", at_least=1, at_most=100_000)] = 20
    most_generations: Annotated[int, quantity("rounds at most", at_least=1, at_most=100_000)] = 100
    margin_share: Annotated[float, quantity("widening of a segment", at_least=0.0, at_most=1.0)] = 0.05
    mutation_share: Annotated[float, quantity("noise on the genes", above=0.0, at_most=1.0)] = 0.15


@frozen_record
class Segment:
    """A part of the path that bends too much; n points.

    Args:
        points_mm: (n, 3) float64.
        begin: Index of its first point on the path.
        held ((bool, bool)): Whether its first and last point join other parts of the path.
        nodes_mm ((N, 3) float64): Nodes of the centreline around it; few, as it may be sent to a process.
        radius_mm: (N,) float64.
    """

    points_mm: Float
    begin: int
    held: tuple[bool, bool]
    nodes_mm: Float
    radius_mm: Float


def repair_genetic(
    tentative: Curve,
    centreline: Centreline,
    limits: RouteLimits,
    *,
    seed: int,
    executor: Executor | None = None,
) -> tuple[Curve, bool]:
    """Return a curve with its bends refitted, and whether each segment passed the paper's own tests.

    Those tests look at the path points alone; prove the curve to know.  The same seed gives the same curve,
    with or without an executor, which searches the segments side by side.
    """
    chosen = GeneticSettings()
    points, parts = cut_segments(tentative, centreline, limits, chosen.margin_share)
    if not parts:
        return tentative, True
    work = partial(search_segment, limits=limits, settings=chosen, seed=seed)
    done = map(work, parts) if executor is None or len(parts) < 2 else executor.map(work, parts)
    passed = True
    for part, (fitted, cost) in zip(parts, done, strict=True):
        points[part.begin : part.begin + len(part.points_mm)] = fitted
        passed &= cost < FEASIBLE
    return interpolate(points), passed


def cut_segments(
    tentative: Curve, centreline: Centreline, limits: RouteLimits, margin_share: float
) -> tuple[Float, list[Segment]]:
    """Return the path points `(P, 3)` of a curve, and their runs that bend too much, widened and merged."""
    # The path points that are fitted and tested are 1 mm apart, about a voxel of a CT.
    count = max(round(tentative.length_mm()), 2 * DEGREE)
    parameters = np.linspace(tentative.breaks[0], tentative.breaks[-1], count + 1)
    points = np.array(tentative.at(parameters)[0])
    bends = tentative.curvature_per_mm(parameters) > limits.max_curvature_per_mm
    margin = max(round(margin_share * len(points)), DEGREE)
    runs: list[tuple[int, int]] = []
    for at in np.flatnonzero(bends).tolist():
        low, high = max(at - margin, 0), min(at + margin + 1, len(points))
        if runs and low <= runs[-1][1]:
            runs[-1] = (runs[-1][0], high)
        else:
            runs.append((low, high))
    parts = []
    for low, high in runs:
        own = points[low:high].copy()
        # A segment keeps the nodes of the centreline this near: fits do not move farther.
        reach = 10.0 + 2.0 * float(centreline.radius_mm.max())
        nodes = centreline.nodes_mm
        around = ((nodes >= own.min(axis=0) - reach) & (nodes <= own.max(axis=0) + reach)).all(axis=1)
        parts.append(
            Segment(
                points_mm=own,
                begin=low,
                held=(low > 0, high < len(points)),
                nodes_mm=nodes[around],
                radius_mm=centreline.radius_mm[around],
            )
        )
    return points, parts


def search_segment(
    segment: Segment, *, limits: RouteLimits, settings: GeneticSettings, seed: int
) -> tuple[Float, float]:
    """Return the best points found for one segment, and their cost."""
    from scipy.spatial import KDTree

    rng = np.random.default_rng((seed, segment.begin))
    evaluator = _Evaluator(segment, limits, KDTree(segment.nodes_mm))
    genes = rng.uniform(size=(settings.population, 2))
    costs = np.array([evaluator.cost(gene) for gene in genes])
    for generation in range(settings.most_generations):
        if generation >= settings.generations and costs.min() < FEASIBLE:
            break
        best = np.argsort(costs, kind="stable")[: settings.parents]
        genes, costs = genes[best], costs[best]
        # Each gene is taken from one of two parents, and noise is added.
        size = (settings.population - len(genes), 2)
        pairs, which = rng.integers(len(genes), size=size), rng.integers(2, size=size)
        crossed = genes[np.take_along_axis(pairs, which, axis=1), np.arange(2)]
        children = np.clip(crossed + rng.normal(0.0, settings.mutation_share, size=size), 0.0, 1.0)
        genes = np.vstack((genes, children))
        costs = np.concatenate((costs, [evaluator.cost(gene) for gene in children]))
    winner = int(np.argmin(costs))
    return evaluator.fitted(genes[winner])[0], float(costs[winner])


class _Evaluator:
    """Fits a chromosome, whose genes lie in [0, 1], and finds its cost."""

    def __init__(self, segment: Segment, limits: RouteLimits, near: "KDTree") -> None:
        self._segment, self._limits, self._near = segment, limits, near
        self._u = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(segment.points_mm, axis=0), axis=1)))
        _distance, nodes = near.query(segment.points_mm)
        # So much displacement takes every point to the wall.
        self._most = float((segment.radius_mm[nodes] ** 2).sum())

    def fitted(self, genes: Sequence[float] | Float) -> tuple[Float, Float]:
        """Return the new points `(n, 3)` and their curvatures `(n,)`."""
        from scipy.interpolate import splev, splprep

        points = self._segment.points_mm
        n = len(points)
        ignored = round(float(genes[0]) * (n - 2))
        weight = np.ones(n)
        first = (n - ignored) // 2
        # Weight of points that count for nothing in the fit; 0 would make its equations singular.
        weight[first : first + ignored] = 1e-6
        for end, held in zip((0, -1), self._segment.held, strict=True):
            if held:
                # Weight of the ends of a segment that must stay where they are.
                weight[end] = 1e3
        smoothing = float(genes[1]) ** 2 * self._most
        spline, _u = splprep(points.T, w=weight, u=self._u, s=smoothing, k=DEGREE, quiet=1)
        c, d1, d2 = (np.stack(splev(self._u, spline, der=d), axis=1) for d in range(3))
        return c, np.linalg.norm(np.cross(d1, d2), axis=1) / np.maximum(np.linalg.norm(d1, axis=1), 1e-9) ** 3

    def cost(self, genes: Float) -> float:
        """Return the cost of a chromosome, as in the module's first lines."""
        points, curvature = self.fitted(genes)
        distance, nodes = self._near.query(points)
        radius = self._segment.radius_mm[nodes]
        limit = self._limits.max_curvature_per_mm
        length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
        chord = max(float(np.linalg.norm(points[-1] - points[0])), 1e-9)
        means = (distance / np.maximum(radius, 1e-3)).mean() + (curvature / limit).mean()
        cost = float(means) + length / chord
        cost += BROKEN * bool((curvature > limit).any())
        return cost + BROKEN * bool((distance > radius - self._limits.needed_mm).any())

"""Routes in real veins and airways."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from anatomy.io import read_mask
from anatomy.io.centerlines import read_centerlines
from stages.scope.route.centreline import Centreline, from_mask, from_tree
from stages.scope.route.guide_path import Links, NoRouteError, fewest_hops, nearest_links
from stages.scope.route.planner import Replanner, plan_route
from stages.scope.route.proof import RouteLimits

pytestmark = pytest.mark.data
LIMITS = RouteLimits(max_curvature_per_mm=0.1, end_tolerance_mm=1.0)


def trials(line: Centreline, links: Links, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Noisy ends, 20 mm apart or more, joined by a path that is nowhere thinner than 0.45 mm."""
    rng = np.random.default_rng(0)
    ends = np.flatnonzero(np.bincount(line.edges.ravel()) == 1)
    root = ends[int(np.argmax(line.radius_mm[ends]))]
    found = []
    while len(found) < count:
        try:
            path = fewest_hops(links, int(root), int(rng.integers(line.n_nodes)))
        except NoRouteError:
            continue
        points = line.nodes_mm[path[[0, -1]]] + rng.normal(0.0, 0.5, (2, 3))
        wide = line.radius_mm[path].min() > 0.45 and (line.depth_mm(points) > 0.2).all()
        if wide and np.linalg.norm(points[1] - points[0]) > 20.0:
            found.append((points[0], points[1]))
    return found


@pytest.mark.slow
def test_all_routes_of_an_airway_tree_are_proved_and_replanned(data_dir: Path) -> None:
    (file,) = (data_dir / "airway-tree").glob("*.vtu")
    line = from_tree(read_centerlines(file, frame="lps"))
    links = nearest_links(line)
    for start, goal in trials(line, links, 20):
        route = plan_route(line, start, goal, LIMITS, links=links, require_proof=False)
        assert route.proved
        u = route.curve.parameters(200)
        assert route.curve.curvature_per_mm(u).max() <= 0.1
        assert line.depth_mm(route.curve.at(u)[0]).min() >= 0.0
    moved = line.nodes_mm + 3.0 * np.sin(line.nodes_mm / 70.0)
    again = Replanner(line, route).replan(moved)
    assert replace(line, nodes_mm=moved).depth_mm(again.curve.sampled(100)).min() >= 0.0


@pytest.mark.slow
@pytest.mark.parametrize("vein", ["hepaticVein", "portalVein"])
def test_what_is_called_proved_in_a_vein_keeps_its_limits(data_dir: Path, vein: str) -> None:
    """Voxels 5 mm high; some ends cannot be reached with this curvature, most can."""
    line = from_mask(read_mask(data_dir / "med-rad-liver" / "Patient1" / f"{vein}.nii.gz"), rounded=True)
    links = nearest_links(line)
    proved = 0
    for start, goal in trials(line, links, 12):
        route = plan_route(line, start, goal, LIMITS, links=links, require_proof=False)
        if route.proved:
            proved += 1
            u = route.curve.parameters(200)
            assert route.curve.curvature_per_mm(u).max() <= 0.1
            assert line.depth_mm(route.curve.at(u)[0]).min() >= 0.0
            assert route.end_error_mm <= 1.0
    assert proved >= 6

"""The lumen of a centreline: round cones, masks and drawings."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from anatomy.base.errors import AnatomyError, TargetError
from anatomy.fields import SOLID
from anatomy.grid import Grid, Volume
from anatomy.lung import Lung
from anatomy.structures import LUMEN
from stages.scope.route import centreline
from stages.scope.route.centreline import Centreline, from_graph, from_image, from_lung, from_mask
from tests.stages.scope.route.tubes import fork, straight

coordinate = st.floats(-5.0, 5.0)


@given(st.tuples(*[coordinate] * 3), st.floats(0.0, 4.0), st.floats(0.0, 4.0), st.floats(0.0, 8.0))
@settings(max_examples=80, deadline=None)
def test_depth_in_a_cone_is_that_of_its_best_ball(
    point: tuple[float, float, float], r0: float, r1: float, length: float
) -> None:
    cone = Centreline(nodes_mm=[(0.0, 0.0, 0.0), (0.0, 0.0, length)], radius_mm=[r0, r1], edges=[(0, 1)])
    p = np.array(point)

    def negative(share: float) -> float:
        return -(r0 + share * (r1 - r0) - np.linalg.norm(p - (0.0, 0.0, share * length)))

    best = max(
        -negative(0.0), -negative(1.0), -minimize_scalar(negative, bounds=(0.0, 1.0), method="bounded").fun
    )
    found = float(cone.depth_mm(p)[0])
    assert found == pytest.approx(best, abs=1e-4)


def test_depth_in_a_straight_tube() -> None:
    tube = straight(radius=3.0)
    points = np.array([(0.0, 0.0, 30.0), (1.0, 0.0, 30.25), (0.0, 4.0, 30.0)])
    depth = tube.depth_mm(points)
    np.testing.assert_allclose(depth[:2], (3.0, 2.0), atol=1e-12)
    assert depth[2] == pytest.approx(-1.0)


def test_lookup_through_cells_equals_the_search_of_all_cones() -> None:
    tube = fork()
    rng = np.random.default_rng(3)
    points = rng.uniform(tube.nodes_mm.min(axis=0) - 2, tube.nodes_mm.max(axis=0) + 2, (3000, 3))
    found = tube.depth_mm(points)
    alone = np.max(
        [
            Centreline(nodes_mm=tube.nodes_mm, radius_mm=tube.radius_mm, edges=edge[None]).depth_mm(points)
            for edge in tube.edges
        ],
        axis=0,
    )
    np.testing.assert_array_equal(found, alone)
    assert (found >= 0).sum() > 100
    assert (found < 0).sum() > 100


def bent_tube() -> Volume:
    """A tube of radius 3 mm around a quarter circle, in voxels that are not cubes."""
    grid = Grid.from_spacing((60, 60, 20), (0.8, 0.8, 1.5), (-4.0, -4.0, -14.0))
    ijk = np.stack(np.meshgrid(*[np.arange(n) for n in grid.shape], indexing="ij"), axis=-1)
    p = grid.lps(ijk)
    rho = np.hypot(p[..., 0], p[..., 1])
    inside = (rho - 30.0) ** 2 + p[..., 2] ** 2 <= 9.0
    return Volume(grid=grid, array=inside & (p[..., 0] > 0) & (p[..., 1] > 0))


@pytest.mark.parametrize("rounded", [False, True])
def test_the_lumen_of_a_mask_lies_in_the_mask(rounded: bool) -> None:
    mask = bent_tube()
    tube = from_mask(mask, rounded=rounded)
    rng = np.random.default_rng(0)
    points = tube.nodes_mm[rng.integers(tube.n_nodes, size=20_000)] + rng.uniform(-4, 4, (20_000, 3))
    depth = tube.depth_mm(points)
    ijk = np.floor(mask.grid.ijk(points) + 0.5).astype(int)
    ijk = np.clip(ijk, 0, np.array(mask.grid.shape) - 1)
    in_mask = mask.array[tuple(ijk.T)]
    # Rounded walls cut the corners of voxels by less than half their diagonal less half an edge.
    allowance = 0.5 * np.linalg.norm(mask.grid.spacing_mm) - 0.4 if rounded else 0.0
    deep = depth > allowance
    assert deep.sum() > 2000
    assert in_mask[deep].all()
    assert tube.radius_mm.max() > 2.0
    rho = np.hypot(*tube.nodes_mm.T[:2])
    assert np.abs(rho - 30.0).max() < 1.0


def drawn_line(rng: np.random.Generator, count: int = 40) -> tuple[Volume, np.ndarray, np.ndarray]:
    """Return a tube in a grid of any rotation, and a line that touches its wall and leads out of it."""
    mask = bent_tube()
    turn = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    matrix = np.eye(4)
    matrix[:3] = turn @ mask.grid.lps_from_ijk[:3]
    angle = np.sort(rng.uniform(0.1, 1.4, count))
    rho, z = 30.0 + rng.uniform(-3.4, 3.4, count), rng.uniform(-2.5, 2.5, count)
    nodes = np.stack((rho * np.cos(angle), rho * np.sin(angle), z), axis=1) @ turn.T
    edges = np.stack((np.arange(count - 1), np.arange(1, count)), axis=1)
    grid = Grid(shape=mask.grid.shape, lps_from_ijk=matrix)
    return Volume(grid=grid, array=mask.array), *centreline._refined(nodes, edges)


def clamped(nodes: np.ndarray, edges: np.ndarray, walls: centreline._Walls) -> Centreline:
    """Give nodes radii lowered once, and then taken to be 0 where they would be less."""
    radius = walls.depth_mm(nodes)
    excess = np.zeros(len(edges))
    for share in np.linspace(0.0, 1.0, 17):
        balls = nodes[edges[:, 0]] * (1.0 - share) + nodes[edges[:, 1]] * share
        wanted = radius[edges[:, 0]] * (1.0 - share) + radius[edges[:, 1]] * share
        excess = np.maximum(excess, wanted - walls.depth_mm(balls))
    excess += np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1) / 16
    lowered = np.zeros(len(nodes))
    for side in range(2):
        np.maximum.at(lowered, edges[:, side], excess)
    return Centreline(nodes_mm=nodes, radius_mm=np.maximum(radius - lowered, 0.0), edges=edges)


def balls_outside(
    seed: int,
    count: int,
    radii: Callable[[np.ndarray, np.ndarray, centreline._Walls], Centreline] = centreline._proved,
) -> tuple[float, int]:
    """Draw lines of so many pieces; return by how much the worst of their balls leaves the mask, mm.

    The second number is that of nodes with a radius of more than 0.5 mm.
    """
    rng = np.random.default_rng(seed)
    worst, wide, drawn = 0.0, 0, 0
    while drawn < count:
        mask, nodes, edges = drawn_line(rng)
        drawn += len(edges)
        walls = centreline._Walls(mask.array, mask.grid, SOLID)
        tube = radii(nodes, edges, walls)
        first, last = tube.edges.T
        for share in np.linspace(0.0, 1.0, 49):
            balls = tube.nodes_mm[first] * (1.0 - share) + tube.nodes_mm[last] * share
            radius = tube.radius_mm[first] * (1.0 - share) + tube.radius_mm[last] * share
            over = radius - np.maximum(walls.depth_mm(balls), 0.0)
            worst = max(worst, float(over[radius > 0.0].max(initial=0.0)))
        wide += int((tube.radius_mm > 0.5).sum())
    return worst, wide


def test_no_ball_on_a_drawn_line_leaves_the_mask() -> None:
    worst, wide = balls_outside(0, 800)
    assert worst <= 1e-6
    assert wide > 100


def test_the_same_search_finds_radii_that_are_clamped() -> None:
    assert balls_outside(0, 800, clamped)[0] > 0.01


@pytest.mark.slow
def test_no_ball_on_a_hundred_thousand_pieces_leaves_the_mask() -> None:
    assert balls_outside(1, 100_000)[0] <= 1e-6


def test_a_drawing_becomes_a_flat_centreline() -> None:
    y, x = np.mgrid[:80, :100]
    drawing = (np.abs(y - 40) <= 5) & (x > 5) & (x < 95)
    tube = from_image(drawing, pixel_mm=0.5)
    assert np.ptp(tube.nodes_mm[:, 2]) == 0.0 == tube.nodes_mm[0, 2]
    middle = np.abs(tube.nodes_mm[:, 0] - 25.0) < 10.0
    np.testing.assert_allclose(tube.nodes_mm[middle, 1], 20.0, atol=0.26)
    # Eleven pixels are 5.5 mm wide.
    np.testing.assert_allclose(tube.radius_mm[middle], 2.75, atol=0.31)
    points = np.random.default_rng(1).uniform((0, 10, 0), (50, 30, 0), (5000, 3))
    inside = tube.depth_mm(points) > 0
    pixel = np.floor(points[inside] / 0.5 + 0.5).astype(int)
    assert inside.sum() > 500
    assert drawing[pixel[:, 1], pixel[:, 0]].all()


@pytest.mark.parametrize("picture", [np.zeros((5, 5), dtype=bool), np.ones(5, dtype=bool)])
def test_an_empty_drawing_is_refused(picture: np.ndarray) -> None:
    with pytest.raises(AnatomyError):
        from_image(picture, pixel_mm=1.0)


def test_copies_of_points_are_joined() -> None:
    """Two polylines of a file that share a point, each with its own copy."""
    points = [(0, 0, 0), (0, 0, 1), (0, 0, 1.0000001), (1, 0, 2), (1, 0, 2)]
    tube = from_graph(points, [1.0, 0.8, 0.9, 0.5, 0.5], [(0, 1), (2, 3), (3, 4)])
    assert tube.n_nodes == 3
    assert len(tube.edges) == 2
    assert tube.radius_mm[tube.nearest_node((0, 0, 1))] == 0.9


def test_wrong_arrays_are_refused() -> None:
    with pytest.raises(AnatomyError):
        Centreline(nodes_mm=np.zeros((2, 3)), radius_mm=[1.0], edges=[(0, 1)])
    with pytest.raises(AnatomyError):
        Centreline(nodes_mm=np.zeros((2, 3)), radius_mm=[1.0, 1.0], edges=[(0, 2)])


def test_a_point_outside_says_so() -> None:
    with pytest.raises(TargetError, match="outside"):
        straight().require_inside(np.array((50.0, 0.0, 0.0)), 0.5, "goal")
    with pytest.raises(TargetError, match="1.00 mm inside"):
        straight(radius=3.0).require_inside(np.array((2.0, 0.0, 30.0)), 1.5, "start")


def test_the_centreline_of_a_patient_lies_in_the_lumen_mask(small_lung: Lung) -> None:
    tube = from_lung(small_lung)
    rng = np.random.default_rng(2)
    points = tube.nodes_mm[rng.integers(tube.n_nodes, size=20_000)] + rng.uniform(-3, 3, (20_000, 3))
    inside = points[tube.depth_mm(points) > 0.0]
    assert len(inside) > 1000
    assert all(small_lung.label_at(p) & LUMEN for p in inside)
    length = np.linalg.norm(tube.nodes_mm[tube.edges[:, 0]] - tube.nodes_mm[tube.edges[:, 1]], axis=1)
    assert length.max() <= 0.75 + 1e-9

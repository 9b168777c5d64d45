"""The proof that there is no path: right about walls, holes and reach, never wrong where a path exists."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.fields import CENTRES, SOLID
from anatomy.grid import Grid
from anatomy.structures import VESSEL
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, environment_of_labels
from stages.needle.infeasibility.certificate import NoPathProof
from stages.needle.infeasibility.kernels import bitmaps
from stages.needle.path import Query
from stages.needle.search.base import RestartingRRT

SIDE = 64
ROW = np.arange(SIDE)
X, Y, Z = np.meshgrid(*[ROW - 31.5] * 3, indexing="ij")


def environment_of(blocked: np.ndarray, radius_mm: float = 60.0, **more: float) -> NeedleEnvironment:
    """Return a cube of 1 mm voxels about the origin with obstacles."""
    labels = np.asfortranarray(np.where(blocked, VESSEL, 0).astype(np.uint16))
    grid = Grid.from_spacing(labels.shape, (1.0, 1.0, 1.0), (-31.5, -31.5, -31.5))
    values = {"required_clearance_mm": 1.0, **more}
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=1 / radius_mm)
    return environment_of_labels(labels, grid, needle, **values)


def query(x: float = 0.0, z: float = 28.0, tilt: float = 0.0) -> Query:
    """Return a query from the bottom of the cube to a point at its top."""
    frame = np.eye(4)
    c, s = math.cos(tilt), math.sin(tilt)
    frame[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    frame[:3, 3] = 0.0, 0.0, -28.0
    return Query(lps_from_start=frame, target=np.array([x, 0.0, z]))


def outcome(environment: NeedleEnvironment, asked: Query, steps: int = 60) -> str:
    """Return how a proof ends, "running" if it takes more steps."""
    proof = NoPathProof(environment, asked)
    for _ in range(steps):
        if proof.advance():
            break
    return proof.outcome


def finds(environment: NeedleEnvironment, asked: Query, iterations: int = 20_000) -> bool:
    return RestartingRRT(environment, asked).advance(iterations)


def wall(hole_mm: float = 0.0, at: float = 0.0) -> np.ndarray:
    return (np.abs(Z) < 2.0) & (np.hypot(X - at, Y) >= hole_mm)


@pytest.mark.slow
def test_a_wall_is_proved_and_a_hole_is_not() -> None:
    assert outcome(environment_of(wall()), query()) == "no path"
    assert outcome(environment_of(wall(4.0)), query()) != "no path"
    assert finds(environment_of(wall(4.0)), query())


@pytest.mark.parametrize("at", [0.0, 2.0])
def test_the_passage_of_an_open_query_is_its_hole(at: float) -> None:
    """Of a hole of 4 mm radius 3 mm are left, less where voxels cut it; cells along the edge are added."""
    proof = NoPathProof(environment_of(wall(4.0, at)), query())
    assert proof.passage is None
    while proof.passage is None and not proof.advance():
        pass
    passage = proof.passage
    assert passage is not None and passage.cell_mm <= 0.5
    assert abs(passage.from_start_mm - 28.0) < 6.0
    assert 3.0 < passage.width_mm < 7.0
    assert np.linalg.norm(np.array(passage.point_lps) - (at, 0.0, passage.from_start_mm - 28.0)) < 1.5
    walled = NoPathProof(environment_of(wall()), query())
    assert walled.run() == "no path" and walled.passage is None


def test_a_hole_that_is_too_narrow() -> None:
    """A hole of one voxel's width leaves 0.5 mm about its middle."""
    narrow = (np.abs(Z) < 2.0) & ~((np.abs(X) < 1.0) & (np.abs(Y) < 1.0))
    assert outcome(environment_of(narrow, required_clearance_mm=1.2), query()) == "no path"
    assert finds(environment_of(narrow, required_clearance_mm=0.9), query())


@pytest.mark.slow
def test_a_hole_that_only_a_tighter_curve_passes() -> None:
    """Away, back and on to the target, a path comes about 257 mm^2 / radius aside half-way: 4, 6 or 9 mm."""
    aside = wall(3.0, 8.0)
    assert outcome(environment_of(aside, radius_mm=60.0), query()) == "no path"
    assert outcome(environment_of(aside, radius_mm=28.0), query()) != "no path"
    assert finds(environment_of(aside, radius_mm=28.0), query())


def test_two_holes_that_do_not_fit_one_path() -> None:
    """Each hole can be passed, and the slabs are no obstacle alone; one after the other they are too near."""
    first = (np.abs(Z + 6.0) < 2.0) & (np.hypot(X - 4.0, Y) >= 3.0)
    second = (np.abs(Z - 6.0) < 2.0) & (np.hypot(X + 4.0, Y) >= 3.0)
    for one in (first, second):
        assert finds(environment_of(one), query())
    assert outcome(environment_of(first | second, radius_mm=60.0), query(), 200) == "no path"
    assert not finds(environment_of(first | second, radius_mm=60.0), query())


def test_the_edge_of_the_workspace() -> None:
    free = environment_of(np.zeros((SIDE,) * 3, dtype=bool), radius_mm=60.0)
    edge = 60.0 - math.sqrt(60.0**2 - 40.0**2)
    assert outcome(free, query(x=edge + 0.1, z=12.0)) == "no path"
    assert outcome(free, query(x=edge - 0.1, z=12.0)) != "no path"
    near = environment_of(np.zeros((SIDE,) * 3, dtype=bool), radius_mm=60.0, goal_tolerance_mm=1.0)
    assert outcome(near, query(x=edge + 0.8, z=12.0)) != "no path"


def test_a_start_in_an_obstacle() -> None:
    assert outcome(environment_of(np.hypot(X, Y, Z + 28) < 3.0), query()) == "no path"


def test_odd_questions_are_undecided_or_proved_but_no_crash() -> None:
    free = environment_of(np.zeros((SIDE,) * 3, dtype=bool))
    assert outcome(free, query(z=-28.0)) == "undecided", "the target lies at the start"
    assert outcome(free, query(z=-30.0)) in ("no path", "undecided"), "behind"
    assert outcome(free, query(tilt=1.5), 10) in ("no path", "undecided", "running")
    assert outcome(free, query(z=400.0), 10) in ("no path", "undecided", "running"), "outside the grid"
    small = NoPathProof(free, query(), max_bytes=1000)
    assert small.run() == "undecided" and "memory" in small.reason


@pytest.mark.parametrize("obstacles_as", [SOLID, CENTRES])
@pytest.mark.parametrize("seed", [1, *(pytest.param(n, marks=pytest.mark.slow) for n in (0, *range(2, 12)))])
def test_where_there_is_a_path_there_is_no_proof(seed: int, obstacles_as: float) -> None:
    """Random balls, as tight as the search can still get through."""
    rng = np.random.default_rng(seed)
    blocked = np.zeros((SIDE,) * 3, dtype=bool)
    for centre, size in zip(rng.uniform(-28, 28, (140, 3)), rng.uniform(2.0, 6.0, 140), strict=True):
        blocked |= (X - centre[0]) ** 2 + (Y - centre[1]) ** 2 + (Z - centre[2]) ** 2 < size**2
    for end in (-28.0, 28.0):
        blocked &= np.hypot(np.hypot(X, Y), Z - end) > 4.0
    asked = query(x=float(rng.uniform(-3, 3)), tilt=float(rng.uniform(-0.1, 0.1)))
    required = 3.0
    while required > 0.4:
        environment = environment_of(
            blocked, required_clearance_mm=required, obstacles_as=obstacles_as, goal_tolerance_mm=0.5
        )
        if finds(environment, asked, 4000):
            assert outcome(environment, asked) != "no path", f"clearance {required:.2f} mm"
            return
        required *= 0.9


@pytest.mark.slow
def test_the_same_question_has_the_same_answer() -> None:
    def run() -> tuple[str, str, int]:
        proof = NoPathProof(environment_of(wall(3.0, 8.0), radius_mm=45.0), query())
        proof.run()
        return proof.outcome, proof.reason, proof.states

    assert run() == run()


def test_cubes_filled_a_few_at_a_time_prove_the_same() -> None:
    environment, found = environment_of(wall()), []
    for cubes in (5, 1 << 31):
        proof = NoPathProof(environment, query())
        steps = 1
        while not proof.advance(cubes):
            steps += 1
        found.append((proof.reason, steps > 100))
    assert found == [(found[0][0], True), (found[0][0], False)] and "cubes" in found[0][0]


def bits_of(cells: np.ndarray) -> np.ndarray:
    """Pack a bool array (Y, 64 W) as the kernels do."""
    out = np.zeros((cells.shape[0], cells.shape[1] // 64), dtype=np.uint64)
    for y, x in np.argwhere(cells):
        out[y, x // 64] |= np.uint64(1) << np.uint64(x % 64)
    return out


@pytest.mark.parametrize("dy, dx", [(0, 0), (3, 1), (-2, -1), (1, 64), (0, -65), (4, 100), (-30, 7)])
def test_bitmaps_move_by_whole_cells(dy: int, dx: int) -> None:
    rng = np.random.default_rng(0)
    cells = rng.random((20, 192)) < 0.2
    moved = np.zeros_like(cells)
    for y, x in np.argwhere(cells):
        if 0 <= y + dy < 20 and 0 <= x + dx < 192:
            moved[y + dy, x + dx] = True
    target = np.zeros((20, 3), dtype=np.uint64)
    bitmaps.or_shifted(target, bits_of(cells), dy, dx)
    assert np.array_equal(target, bits_of(moved))
    other = rng.random((20, 192)) < 0.5
    kept = bits_of(other)
    bitmaps.and_shifted(kept, bits_of(cells), dy, dx)
    assert np.array_equal(kept, bits_of(other & moved))

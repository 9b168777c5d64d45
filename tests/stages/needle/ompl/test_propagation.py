"""OMPL's own propagation: independent arithmetic, and proved."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from ompl import control
from scipy.spatial.transform import Rotation

from anatomy.kernels.field import exact_at
from anatomy.margins import Margins
from anatomy.structures import VESSEL
from stages.needle.device import Needle
from stages.needle.environment import NeedleEnvironment, needle_environment
from stages.needle.kernels.states import proved_step
from stages.needle.ompl import NeedleProblem, path_of, read_state, write_state
from stages.needle.path import ArcPath, Query, arc_transform
from tests.stages.needle.ompl.problems import (
    GOAL,
    arcs_of,
    ask,
    given,
    handed_over,
    query,
    require,
    start,
    with_needle,
)
from tests.stages.scenes import Canvas


def test_ompl_propagates_the_arcs_to_the_same_end(environment: NeedleEnvironment) -> None:
    """Quaternions in steps of a twentieth of each control, against the kernel's numbers."""
    problem = NeedleProblem(with_needle(environment, max_angle_from_start_deg=28.0))
    deepest = 0
    for seed in range(6):
        path = require(ask(problem, seed))
        solution = handed_over(problem)
        assert solution.check()
        state = problem.si.allocState()
        problem.si.copyState(state, solution.getState(0))
        for n in range(solution.getControlCount()):
            problem.si.propagate(state, solution.getControl(n), 20, state)
        assert np.linalg.norm(read_state(state)[:3, 3] - GOAL) < 1e-9
        assert np.linalg.norm(read_state(state)[:3, 2] - path.frames()[-1][:3, 2]) < 1e-9
        assert np.abs(path_of(solution).frames() - path.frames()).max() < 1e-9
        deepest = max(deepest, len(path.arcs))
    assert deepest >= 3


def test_no_step_of_a_handed_over_path_is_longer_than_a_millimetre(problem: NeedleProblem) -> None:
    require(ask(problem))
    solution = handed_over(problem)
    bound = problem.si.getControlSpace().getBounds().high[0]
    lengths = [solution.getControl(n)[0] for n in range(solution.getControlCount())]
    assert max(lengths) <= bound == 20.0
    assert problem.si.getPropagationStepSize() * bound <= 1.0
    assert set(solution.getControlDurations()) == {1.0}


def test_the_check_of_ompl_notices_a_path_that_is_not_the_arcs(problem: NeedleProblem) -> None:
    require(ask(problem))
    solution = handed_over(problem)
    solution.getControl(0)[0] *= 1.01
    assert not solution.check()


def test_a_step_is_the_arc(environment: NeedleEnvironment) -> None:
    rng = np.random.default_rng(0)
    for seed in range(50):
        frame = np.eye(4)
        frame[:3, :3] = Rotation.random(random_state=seed).as_matrix()
        frame[:3, 3] = 15.0, 15.0, 15.0
        length, roll, curvature = rng.uniform([0.0, -3.0, 0.0], [5.0, 3.0, 1 / 30])
        problem = NeedleProblem(environment)
        before, after = problem.si.allocState(), problem.si.allocState()
        write_state(before, frame)
        problem.pose(Query(lps_from_start=frame, target=GOAL))
        u = problem.si.allocControl()
        u[0], u[1], u[2] = length, roll, curvature
        problem.si.propagate(before, u, 20, after)
        expected = frame @ arc_transform(length, roll, curvature) @ arc_transform(0.0, -roll, 0.0)
        assert np.abs(read_state(after) - expected).max() < 1e-12


def test_states_and_frames_are_the_same_thing(problem: NeedleProblem) -> None:
    state = problem.si.allocState()
    half_turns = [Rotation.from_rotvec(np.pi * axis).as_matrix() for axis in np.eye(3)]
    randoms = [Rotation.random(random_state=seed).as_matrix() for seed in range(50)]
    for n, rotation in enumerate([np.eye(3), *half_turns, *randoms]):
        frame = np.eye(4)
        frame[:3, :3] = rotation
        frame[:3, 3] = np.random.default_rng(n).uniform(-30, 30, 3)
        write_state(state, frame)
        assert np.abs(read_state(state) - frame).max() < 1e-14


def test_the_bounds_hold_the_whole_lung(problem: NeedleProblem) -> None:
    bounds = problem.si.getStateSpace().getBounds()
    assert [float(bounds.low[n]) for n in range(3)] == pytest.approx([-32.0] * 3)
    assert [float(bounds.high[n]) for n in range(3)] == pytest.approx([32.0] * 3)


def thin_sheet() -> NeedleEnvironment:
    """A vessel 0.2 mm thick across the way at z = 0, and a needle of 0.1 mm."""
    canvas = Canvas.empty([-4, -4, -4], [4, 4, 4], 0.2)
    canvas.add(np.abs(canvas.points[..., 2] - 0.1) < 0.05, VESSEL)
    needle = Needle(diameter_mm=0.1, max_curvature_per_mm=0.05)
    return needle_environment(canvas.lung(), needle, Margins(segmentation_margin_mm=0.0), with_fissures=False)


def test_a_step_over_an_obstacle_between_two_valid_states_is_refused() -> None:
    problem = NeedleProblem(thin_sheet())
    frame = np.eye(4)
    frame[2, 3] = -0.3
    problem.pose(Query(lps_from_start=frame, target=np.array([0.0, 0.0, 2.0])))
    before, after = problem.si.allocState(), problem.si.allocState()
    write_state(before, frame)
    for height, clear in ((-0.3, True), (0.0, False), (0.2, False), (0.6, True)):
        frame[2, 3] = height
        write_state(after, frame)
        assert problem.si.isValid(after) is clear
    u = problem.si.allocControl()
    u[0], u[1], u[2] = 18.0, 0.0, 0.0
    assert problem.si.propagateWhileValid(before, u, 1, after) == 0
    problem.si.propagate(before, u, 1, after)
    assert math.isnan(after.getX()) and not problem.si.isValid(after)
    u[0] = 4.0
    assert problem.si.propagateWhileValid(before, u, 1, after) == 1


def test_a_step_backwards_is_refused(environment: NeedleEnvironment) -> None:
    moved = proved_step(
        environment.obstacles, environment.limits, (15.0, 15.0, 15.0, 0.0, 0.0, 0.0, 1.0), 0.0, 0.0, -1.0,
        (15.0, 15.0, 15.0, 0.0, 0.0, 1.0, 0.0), -1,
    )  # fmt: skip
    assert math.isnan(moved[0])


def test_what_is_proved_as_arcs_passes_in_steps(environment: NeedleEnvironment) -> None:
    """Short paths graze the obstacle, where steps meet points that the arcs' proof passed over."""
    problem = NeedleProblem(environment)
    rng = np.random.default_rng(0)
    _field, labels, geometry, bits = environment.obstacles
    grazing = 0
    for seed in range(25):
        target = np.append(rng.uniform(-4, 4, 2), rng.uniform(15, 28))
        path = require(problem.plan(query(target), seed=seed, iterations=3000, anytime=True))
        assert handed_over(problem).check()
        points, _lengths = path.sample(0.02)
        distances = np.zeros(len(points))
        exact_at(labels, geometry, points, bits, -1, 2.0, distances)
        grazing += float(distances.min()) < environment.required_clearance_mm + 0.03
    assert grazing >= 3


@pytest.mark.parametrize(
    ("gap_mm", "as_arc", "in_steps"),
    [(0.006, True, True), (0.004, False, True), (0.001, False, False), (-0.001, False, False)],
)
def test_a_step_needs_half_of_what_an_arc_needs_to_spare(gap_mm: float, as_arc: bool, in_steps: bool) -> None:
    """Along a wall, where the same gap is left all the way; beyond the required clearance nothing passes."""
    canvas = Canvas.empty([-8, -8, -8], [8, 8, 8], 1.0)
    canvas.add(canvas.points[..., 0] > 0, VESSEL)
    needle = Needle(diameter_mm=1.0, max_curvature_per_mm=0.05)
    problem = NeedleProblem(needle_environment(canvas.lung(), needle, Margins(), with_fissures=False))
    frame = np.eye(4)
    frame[0, 3] = -problem.environment.required_clearance_mm - gap_mm
    problem.pose(Query(lps_from_start=frame, target=frame[:3, 3] + [0.0, 0.0, 4.0]))
    assert (
        problem.violation(ArcPath(lps_from_start=frame, arcs=np.array([[4.0, 0.0, 0.0]]))) == ""
    ) is as_arc
    state, u = problem.si.allocState(), problem.si.allocControl()
    write_state(state, frame)
    u[0], u[1], u[2] = 4.0, 0.0, 0.0
    assert problem.si.isValid(state) is in_steps
    assert problem.si.propagateWhileValid(state, u, 20, state) == (20 if in_steps else 0)


def test_a_start_that_is_not_clear_is_refused_by_the_validity_checker(problem: NeedleProblem) -> None:
    """The checker returns a real bool: numpy's raises `std::bad_cast`."""
    problem.pose(query())
    state = problem.si.allocState()
    write_state(state, start())
    assert problem.si.isValid(state) is True
    near_pleura = start()
    near_pleura[0, 3] = -27.6
    for frame in (
        near_pleura,
        start() @ arc_transform(24.0, 0.0, 0.0),
        start() @ arc_transform(-30.0, 0.0, 0.0),
    ):
        write_state(state, frame)
        assert problem.si.isValid(state) is False
    assert problem.plan(replace(query(), lps_from_start=near_pleura), seed=0, iterations=100) is None
    assert problem.own().search is None


def test_no_state_is_valid_before_a_query(environment: NeedleEnvironment) -> None:
    problem = NeedleProblem(environment)
    state = problem.si.allocState()
    write_state(state, start())
    assert problem.si.isValid(state) is False


def test_a_state_is_valid_only_within_the_angle_and_length(environment: NeedleEnvironment) -> None:
    problem = NeedleProblem(with_needle(environment, max_angle_from_start_deg=30.0, max_length_mm=20.0))
    state = problem.si.allocState()

    def valid(turned_deg: float, ahead_mm: float, asked: Query) -> bool:
        frame = start() @ arc_transform(ahead_mm, 0.0, 0.0)
        frame[:3, :3] = Rotation.from_euler("x", turned_deg, degrees=True).as_matrix()
        write_state(state, frame)
        problem.pose(asked)
        return bool(problem.si.isValid(state))

    assert valid(29.9, 0.0, query()) and not valid(30.1, 0.0, query())
    assert valid(0.0, 19.9, query()) and not valid(0.0, 20.1, query())
    tilted = query(reference=np.array([0.0, -math.sin(math.radians(20)), math.cos(math.radians(20))]))
    assert valid(49.9, 0.0, tilted) and not valid(-10.1, 0.0, tilted)
    assert valid(0.0, 4.9, query(inserted_mm=15.0)) and not valid(0.0, 5.1, query(inserted_mm=15.0))


def test_what_ompl_takes_for_a_solution_is_refused_if_it_is_none(environment: NeedleEnvironment) -> None:
    through = arcs_of((40.0, 0.0, 0.0))
    problem = NeedleProblem(environment, {"given": given(through)})
    assert "no query" in problem.violation(through)
    problem.pose(query(through.frames()[-1][:3, 3]))
    assert problem.setup.solve(1.0).asString() == "Exact solution"
    assert problem.solution() is None
    assert "vessel" in problem.violation(path_of(problem.setup.getSolutionPath()))


def test_controls_that_bend_alike_become_one_arc(problem: NeedleProblem) -> None:
    solution = control.PathControl(problem.si)
    state = problem.si.allocState()
    write_state(state, start())
    for length, roll, curvature, duration in (
        (10.0, 3.0, 0.01, 0.5), (8.0, 3.0, 0.01, 0.25), (8.0, -3.0, 0.01, 1.0), (8.0, -3.0, 0.02, 1.0)
    ):  # fmt: skip
        u = problem.si.allocControl()
        u[0], u[1], u[2] = length, roll, curvature
        solution.append(state, u, duration)
    solution.append(state)
    expected = [[7.0, 3.0, 0.01], [8.0, 2 * math.pi - 6.0, 0.01], [8.0, 0.0, 0.02]]
    assert np.abs(path_of(solution).arcs - expected).max() < 1e-12

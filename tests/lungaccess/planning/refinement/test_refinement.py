"""Joint refinement: never worse, always proved, the same again; its derivatives against differences."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import islice

import casadi
import numpy as np
import pytest

import lungaccess as la
from anatomy.base.typed import Float
from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.structures import OBSTACLES
from lungaccess.planning.refinement import boxes, refine
from lungaccess.planning.refinement.geometry import Geometry
from lungaccess.planning.refinement.joint import Reconstruction
from lungaccess.planning.refinement.problem import (
    LocalAxis,
    Problem,
    aimed,
    path_of,
    program_weights,
    rows_of,
    split,
)
from lungaccess.planning.refinement.program import Program, program
from lungaccess.plans.assemble import assemble
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task
from stages.needle import SHORTEST, Objective
from stages.needle.environment import direct_arcs, needle_environment
from stages.needle.path import ArcPath, direct_path
from stages.scope import MotionProver, find_motions
from stages.tube import Deployment, DeploymentValidator, enumerate_deployments, longest_mm
from tests.lungaccess.cli.ahead import turned_candidates
from tests.lungaccess.resample import problems

SYSTEM = la.load_system("ultrathin")
ITERATIONS = 40


@dataclass(frozen=True)
class Case:
    """A task, and candidates by falling cost."""

    task: Task
    candidates: list[Candidate]


@pytest.fixture(scope="module")
def case(small_lung: Lung) -> Case:
    """Direct arcs to a point that many of them reach."""
    system, lung = SYSTEM, small_lung
    target = la.resolve_target(lung, "lps:-58.2,55.4,-47.4")
    task = Task(lung=lung, system=system, target=target)
    places = find_motions(lung, system.scope, reach_mm=longest_mm(system.tubes))
    fissures = {"with_fissures": task.with_fissures}
    found = enumerate_deployments(lung, system.tubes, system.margins, places.tips[::5], **fissures)
    environment = needle_environment(lung, system.needle, system.margins, **fissures)
    blockers, _lengths, costs = direct_arcs(
        environment, found.positions, found.tangents, found.branch, target.lps_mm
    )
    inside = found.outer_mm > 0.0
    clear = np.flatnonzero((blockers == 0) & inside)
    ranked = clear[np.argsort(-costs[clear], kind="stable")]
    validator = DeploymentValidator(lung, system.tubes, system.margins, **fissures)
    candidates = []
    for entry in ranked[np.linspace(0, len(ranked) - 1, 6).astype(int)]:
        tip = places.tip(5 * int(found.site[entry]))
        deployment = validator.choose(tip.lps_from_scope_tip, *found.choice(int(entry)))
        assert isinstance(deployment, Deployment)
        path = direct_path(deployment.lps_from_tip, target.lps_mm)
        candidates.append(Candidate(tip=tip, deployment=deployment, path=path))
    return Case(task, candidates)


@pytest.fixture(scope="module")
def refined(case: Case) -> list[Candidate | None]:
    return [refine(case.task, c, iterations=ITERATIONS) for c in case.candidates]


class TestRefine:
    """What comes back."""

    def test_every_result_is_cheaper_and_most_candidates_have_one(
        self, case: Case, refined: list[Candidate | None]
    ) -> None:
        evaluator = CandidateEvaluator(case.task)
        found = [
            (evaluator.cost(old), evaluator.cost(new))
            for old, new in zip(case.candidates, refined, strict=True)
            if new
        ]
        assert len(found) >= 4
        assert all(after < before for before, after in found)
        assert max(1.0 - after / before for before, after in found) > 0.05

    @pytest.mark.parametrize(
        "every", [pytest.param(1, marks=pytest.mark.slow, id="all"), pytest.param(9, id="one")]
    )
    def test_the_check_accepts_every_result(
        self, case: Case, refined: list[Candidate | None], every: int
    ) -> None:
        for new in [new for new in refined if new][::every]:
            plan = assemble(case.task, new, iteration=1, timing={})
            report = la.check(plan, case.task.lung, SYSTEM, target_lps=case.task.target.lps_mm)
            assert report.accepted, [f.name for f in report.findings if not f.ok]
            assert problems(plan, case.task.lung) == []

    def test_tubes_move_too(self, case: Case, refined: list[Candidate | None]) -> None:
        moved = [
            abs(new.deployment.inner_mm - old.deployment.inner_mm) + tip_moved_mm(old, new)
            for old, new in zip(case.candidates, refined, strict=True)
            if new
        ]
        assert max(moved) > 0.1

    def test_it_repeats_bit_for_bit(self, case: Case, refined: list[Candidate | None]) -> None:
        again = refine(case.task, case.candidates[0], iterations=ITERATIONS)
        assert again is not None and refined[0] is not None
        assert again.path.arcs.tobytes() == refined[0].path.arcs.tobytes()
        assert again.deployment.lps_from_tip.tobytes() == refined[0].deployment.lps_from_tip.tobytes()

    def test_length_is_reduced_under_its_own_objective(self, case: Case) -> None:
        task, old = replace(case.task, objective=SHORTEST), case.candidates[0]
        new = refine(task, old, iterations=ITERATIONS)
        assert new is not None and new.path.length_mm < old.path.length_mm - 0.5

    @pytest.mark.slow
    def test_a_cost_map_is_followed(self, case: Case) -> None:
        grid = case.task.lung.grid
        share = np.linspace(0.2, 1.0, grid.shape[1], dtype=np.float32)
        values = np.asfortranarray(np.broadcast_to(share[None, :, None], grid.shape))
        lung = replace(case.task.lung, cost=Volume(grid=grid, array=values))
        task, old = replace(case.task, lung=lung, objective=Objective(cost_map=1.0)), case.candidates[0]
        new = refine(task, old, iterations=ITERATIONS)
        assert new is not None
        cost = CandidateEvaluator(task).cost
        assert cost(new) < 0.99 * cost(old)

    def test_without_a_map_nothing_is_cheaper_than_free(self, case: Case) -> None:
        task = replace(case.task, objective=Objective(cost_map=1.0))
        assert refine(task, case.candidates[0], iterations=ITERATIONS) is None

    def test_too_many_arcs_are_left_alone(self, case: Case) -> None:
        old = case.candidates[0]
        many = path_of(old.path.lps_from_start, split(rows_of(old.path), 9, 1.0))
        assert refine(case.task, replace(old, path=many), iterations=ITERATIONS) is None


def tip_moved_mm(old: Candidate, new: Candidate) -> float:
    return float(np.linalg.norm((new.tip.lps_from_scope_tip - old.tip.lps_from_scope_tip)[:3, 3]))


def derivatives(
    solver: Program, x: np.ndarray, problem: Problem
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return gradient and Jacobian, and the Hessian of the objective and all constraints added up."""
    solver.evaluate(x, problem.numbers, problem.boxes)  # Fills the inputs.
    point, parameters = solver._inputs[:2]
    gradient = solver._functions["grad_f"](point, parameters)[1]
    jacobian = solver._functions["jac_g"](point, parameters)[1]
    upper = solver._functions["hess_lag"](point, parameters, 1.0, np.ones(solver.layout.n_constraints))
    whole = np.asarray(casadi.triu2symm(upper))
    return np.asarray(gradient).ravel(), np.asarray(casadi.densify(jacobian)), whole


def set_up(case: Case, which: int = 1, task: Task | None = None) -> tuple[Problem, Program]:
    task = task or case.task
    weights = program_weights(task)
    assert weights is not None
    problem = Problem(CandidateEvaluator(task), case.candidates[which], weights)
    return problem, program(problem.layout, ITERATIONS)


class TestProgram:
    """The program is what it says, and so are its derivatives."""

    def test_at_the_start_it_costs_as_much_as_the_candidate(self, case: Case) -> None:
        shares = []
        for which, candidate in enumerate(case.candidates):
            problem, solver = set_up(case, which)
            cost, values = solver.evaluate(problem.start, problem.numbers, problem.boxes)
            shares.append(cost / CandidateEvaluator(case.task).cost(candidate))
            assert np.abs(values[problem.layout.constraints["end"]]).max() < 1e-6
            length_mm = values[problem.layout.constraints["length"]][0]
            assert length_mm == pytest.approx(candidate.path.length_mm)
        # The first grazes an obstacle, where the smooth clearance of the program has no peak.
        np.testing.assert_allclose(shares[1:], 1.0, rtol=0.1)
        assert shares[0] < 1.0

    def test_the_tubes_cost_what_they_cost_the_candidate(self, case: Case) -> None:
        """The part of the tubes is what the cost has over that of the needle."""
        width = SYSTEM.require_needle("The test").diameter_mm
        task = replace(case.task, objective=Objective(tissue=1.0))
        needle = replace(case.task, objective=Objective(inverse_clearance=width))
        parts = []
        for which, candidate in enumerate(case.candidates):
            found = []
            for each in (task, needle):
                problem, solver = set_up(case, which, each)
                found.append(solver.evaluate(problem.start, problem.numbers, problem.boxes)[0])
            both, alone = (CandidateEvaluator(each).cost(candidate) for each in (task, needle))
            parts.append(both - alone)
            # The first grazes an obstacle, where the smooth clearance of the program has no peak.
            if which > 0:
                assert found[0] - found[1] == pytest.approx(parts[-1], rel=0.3, abs=0.5)
        assert max(parts) > 1.0

    def test_tissue_is_reduced_under_its_own_objective(self, case: Case) -> None:
        task = replace(case.task, objective=Objective(tissue=1.0))
        cost, saved = CandidateEvaluator(task).cost, []
        for old in case.candidates[:3]:
            new = refine(task, old, iterations=ITERATIONS)
            saved.append(0.0 if new is None else 1.0 - cost(new) / cost(old))
        assert max(saved) > 0.05

    @pytest.mark.slow
    def test_its_gradients_are_those_of_differences(self, case: Case) -> None:
        problem, solver = set_up(case)
        rng = np.random.default_rng(4)
        x = problem.start + 0.01 * rng.standard_normal(len(problem.start))
        gradient, jacobian, hessian = derivatives(solver, x, problem)
        weights = np.ones(len(jacobian))
        for n in range(len(x)):
            step = np.zeros(len(x))
            step[n] = 1e-5
            ends = [solver.evaluate(x + s * step, problem.numbers, problem.boxes) for s in (1.0, -1.0)]
            assert (ends[0][0] - ends[1][0]) / 2e-5 == pytest.approx(gradient[n], rel=1e-4, abs=1e-4)
            np.testing.assert_allclose((ends[0][1] - ends[1][1]) / 2e-5, jacobian[:, n], rtol=1e-4, atol=1e-4)
            slopes = []
            for s in (1.0, -1.0):
                g, j, _h = derivatives(solver, x + s * step, problem)
                slopes.append(g + weights @ j)
            np.testing.assert_allclose((slopes[0] - slopes[1]) / 2e-5, hessian[n], rtol=1e-3, atol=1e-2)

    def test_the_symbolic_tip_moves_as_that_of_the_planner(self, case: Case) -> None:
        problem, _solver = set_up(case)
        x, p = (
            casadi.SX.sym(n, size)
            for n, size in (("x", problem.layout.n_variables), ("p", problem.layout.n_parameters))
        )
        tip = Geometry(problem.layout, x, p).tip
        pose = casadi.vertcat(tip.point, tip.z, tip.x)
        function = casadi.Function("tip", [x, p], [pose, casadi.jacobian(pose, x)])
        value, jacobian = (np.asarray(out) for out in function(problem.start, problem.numbers.parameters))
        deployment = case.candidates[1].deployment
        np.testing.assert_allclose(value.ravel(), pose_numbers(deployment), atol=1e-9)
        # The polynomials of the insertions are fitted over millimetres, so their slopes are not exact.
        for name, tolerance in (("rotation", 1e-4), ("outer", 1e-3), ("inner", 1e-3)):
            n = problem.layout.variables[name]
            slope = planner_slope(case, name, 1e-4)
            np.testing.assert_allclose(jacobian[:, n], slope, atol=tolerance)

    def test_the_symbolic_tip_follows_the_site(self, case: Case) -> None:
        which = 5  # Its tubes are proved along the way of the tip, too.
        problem, _solver = set_up(case, which)
        x, p = (
            casadi.SX.sym(n, size)
            for n, size in (("x", problem.layout.n_variables), ("p", problem.layout.n_parameters))
        )
        function = casadi.Function("tip", [x, p], [Geometry(problem.layout, x, p).tip.point])
        far = max(problem.axis.low_mm, problem.axis.high_mm, key=abs)
        assert abs(far) > 0.4
        reconstruction = Reconstruction(CandidateEvaluator(case.task), problem)
        for shift in (0.3 * far, 0.6 * far):
            place = problem.start.copy()
            place[problem.layout.variables["site"]] = shift
            placement = reconstruction.placement(place, 1.0)
            assert placement is not None
            point = np.asarray(function(place, problem.numbers.parameters)).ravel()
            moved = np.linalg.norm(point - pose_numbers(case.candidates[which].deployment)[:3])
            assert np.linalg.norm(point - placement.deployment.lps_from_tip[:3, 3]) < 0.2 * moved


def pose_numbers(deployment: Deployment) -> Float:
    frame = deployment.lps_from_tip
    return np.concatenate([frame[:3, 3], frame[:3, 2], frame[:3, 0]])


def planner_slope(case: Case, name: str, step: float) -> Float:
    """Differentiate what the planner says of the second candidate, by central differences."""
    old = case.candidates[1]
    validator = DeploymentValidator(
        case.task.lung, SYSTEM.tubes, SYSTEM.margins, with_fissures=case.task.with_fissures
    )
    ends = []
    for sign in (1.0, -1.0):
        numbers = {
            "rotation": old.deployment.rotation_rad,
            "outer": old.deployment.outer_mm,
            "inner": old.deployment.inner_mm,
        }
        numbers[name] += sign * step
        rotation, *inserted = numbers.values()
        moved = validator.validate(old.tip.lps_from_scope_tip, rotation, inserted)
        assert isinstance(moved, Deployment), moved
        ends.append(pose_numbers(moved))
    return np.asarray((ends[0] - ends[1]) / (2.0 * step))


class TestAxis:
    """The way of a tip along its motion as a polynomial."""

    def test_it_is_exact_at_the_tip_and_close_around_it(self, case: Case) -> None:
        rows = CandidateEvaluator(case.task).tip_rows
        prover = MotionProver(case.task.lung, case.task.system.scope)
        for candidate in case.candidates:
            axis = LocalAxis(rows, candidate.tip)
            np.testing.assert_allclose(axis.points[:, 0], candidate.tip.lps_from_scope_tip[:3, 3])
            np.testing.assert_allclose(axis.tangents[:, 0], candidate.tip.lps_from_scope_tip[:3, 2])
            assert axis.low_mm <= 0.0 <= axis.high_mm
            for shift in np.linspace(axis.low_mm, axis.high_mm, 7):
                tip = axis.tip(float(shift))
                if tip is None:
                    continue
                assert isinstance(prover.prove(tip.motion), float)
                powers = (shift / 2.5) ** np.arange(6)
                assert np.linalg.norm(axis.points @ powers - tip.lps_from_scope_tip[:3, 3]) < 0.1


def winding_path(seed: int) -> ArcPath:
    rng = np.random.default_rng(seed)
    frame = np.eye(4)
    frame[:3, :3] = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    frame[:3, 2] *= np.sign(np.linalg.det(frame[:3, :3]))
    frame[:3, 3] = rng.uniform(-50.0, 50.0, 3)
    arcs = [(rng.uniform(5.0, 30.0), rng.uniform(-3.0, 3.0), k) for k in (0.0, 0.01, 0.005, 0.0, 0.008)]
    return ArcPath(lps_from_start=frame, arcs=np.array(arcs))


class TestCurve:
    """Paths as curvature vectors."""

    @pytest.mark.parametrize("seed", range(5))
    def test_there_and_back(self, seed: int) -> None:
        path = winding_path(seed)
        again = path_of(path.lps_from_start, rows_of(path))
        np.testing.assert_allclose(again.sample(1.0)[0], path.sample(1.0)[0], atol=1e-9)

    def test_splitting_changes_nothing(self) -> None:
        path = winding_path(7)
        rows = split(rows_of(path), 9, 3.0)
        assert len(rows) == 9 and rows[0, 0] > 3.0
        again = path_of(path.lps_from_start, rows)
        np.testing.assert_allclose(again.frames()[-1][:3, 3], path.frames()[-1][:3, 3], atol=1e-9)
        assert again.length_mm == pytest.approx(path.length_mm)

    def test_aiming_reaches_the_target_with_a_small_change(self) -> None:
        path = winding_path(9)
        target = path.frames()[-1][:3, 3] + np.array([0.3, -0.2, 0.1])
        rows = rows_of(path)
        found = aimed(path.lps_from_start, rows, target, 0.01)
        assert found is not None
        end = path_of(path.lps_from_start, found).frames()[-1][:3, 3]
        assert np.linalg.norm(end - target) < 1e-9
        assert np.abs(found - rows).max() < 0.5


class TestBoxes:
    """Lattice values lie where the box says."""

    def test_clearance(self, case: Case) -> None:
        lung, points = case.task.lung, case.candidates[0].path.sample(1.0)[0]
        box = boxes.clearance_box(lung, points, 5.0, with_fissures=False)
        places = places_of(box)
        exact = lung.exact_clearance_mm(places, OBSTACLES, cap_mm=30.0)
        near = exact < 29.0
        np.testing.assert_allclose(box.values[near], exact[near], atol=0.02)

    def test_clearance_without_the_pierced_branch(self, case: Case) -> None:
        lung, deployment = case.task.lung, case.candidates[0].deployment
        point = deployment.lps_from_tip[None, :3, 3]
        box = boxes.spared_box(lung, point, 8.0, bits=OBSTACLES, branch=deployment.branch)
        places = places_of(box)
        inner = np.linalg.norm(places - point, axis=1) < 4.0
        exact = lung.exact_clearance_mm(places[inner], OBSTACLES, cap_mm=4.0, exempt_branch=deployment.branch)
        np.testing.assert_allclose(np.minimum(box.values[inner], 4.0), exact, atol=0.02)

    def test_the_share_of_lumen_falls_across_the_wall(self, case: Case) -> None:
        tip = case.candidates[0].tip.lps_from_scope_tip
        box = boxes.lumen_box(case.task.lung, tip[None, :3, 3], 8.0)
        lattice = box.lattice_from_lps[:, :3] @ tip[:3, 3] + box.lattice_from_lps[:, 3]
        values = box.values.reshape(box.shape, order="F")
        middle = values[tuple(np.rint(lattice).astype(int))]
        assert middle > 0.5 and values.min() < 0.05

    def test_a_map_keeps_its_values_and_loses_its_walls(self, case: Case) -> None:
        grid = case.task.lung.grid
        values = np.full(grid.shape, 0.3, dtype=np.float32, order="F")
        values[::2] = math.inf
        points = case.candidates[0].path.sample(1.0)[0]
        box = boxes.map_box(Volume(grid=grid, array=values), points, 5.0)
        np.testing.assert_allclose(box.values, 0.3, rtol=1e-6)


def places_of(box: boxes.FieldBox) -> Float:
    """Return where the values of a box lie, `(V, 3)` LPS mm."""
    index = np.stack(np.unravel_index(np.arange(len(box.values)), box.shape, order="F"), axis=1)
    matrix, offset = box.lattice_from_lps[:, :3], box.lattice_from_lps[:, 3]
    return np.asarray((index - offset) @ np.linalg.inv(matrix).T)


@pytest.mark.slow
def test_candidates_at_turned_tips_are_refined(small_lung: Lung) -> None:
    atlas = la.build_atlas(small_lung, SYSTEM, rotations=12, stop_spacing_mm=4.0)
    better = 0
    for search, candidate in islice(turned_candidates(small_lung, atlas), 4):
        refined = refine(search.task, candidate, iterations=ITERATIONS)
        if refined is None:
            continue
        better += 1
        assert search.evaluator.evaluate(refined) < search.evaluator.cost(candidate)
        plan = assemble(search.task, refined, iteration=0, timing={})
        assert la.check(plan, small_lung).accepted
    assert better >= 2

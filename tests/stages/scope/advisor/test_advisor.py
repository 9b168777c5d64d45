"""Paths to goals in a forked airway, advice during a procedure, and instructions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anatomy.base.errors import AnatomyError, SettingsError
from anatomy.lung import Lung
from stages.scope.advisor.advisor import Advisor, PathSettings, start_state, why_stopped
from stages.scope.advisor.best_motion import Motion
from stages.scope.advisor.environment import ScopeEnvironment
from stages.scope.advisor.kinematics import ScopeModel, advanced, straight_state
from stages.scope.advisor.lumen import Lumen
from stages.scope.advisor.nf1 import goal_at
from stages.scope.advisor.path import ScopePath, camera_flight, instructions_along
from tests.stages.scope.airways import CARINA, LEFT, LINES, RIGHT, tube, wall_mm

MODEL = ScopeModel(radius_mm=1.5, twist_low_deg=-90.0, bend_low_deg=-120.0)
GOALS = [RIGHT, LINES[3][1], LINES[4][1]]


def path_to(
    forked: tuple[Lung, Lumen],
    target: np.ndarray,
    model: ScopeModel = MODEL,
    *,
    seed: int = 1,
    retreats: int = 60,
) -> tuple[Advisor, ScopePath]:
    lung, lumen = forked
    advisor = Advisor(lumen, model, goal_at(lumen, target, 2.0), PathSettings(retreats=retreats))
    return advisor, advisor.path(start_state(lumen, lung.tree, model), seed=seed)


@pytest.mark.parametrize(
    "target", [GOALS[0], *(pytest.param(goal, marks=pytest.mark.slow) for goal in GOALS[1:])]
)
def test_every_branch_is_reached_and_no_pose_touches_the_wall(
    forked: tuple[Lung, Lumen], target: np.ndarray
) -> None:
    _lung, lumen = forked
    advisor, path = path_to(forked, target)
    assert path.reached
    assert lumen.voxel_at(path.lps_from_tip[:3, 3]) == path.goal.voxel
    assert why_stopped(path, advisor.field, forked[0].tree) == ""
    for number in range(path.count):
        assert wall_mm(lumen, path.body(number), 4.0).min() >= MODEL.radius_mm
    between = [path.between(number, f) for number in range(1, path.count) for f in (0.25, 0.5, 0.75)]
    assert advisor.environment.fits(np.array(between)).all(), "not between the states either"


def test_states_follow_from_one_another(forked: tuple[Lung, Lumen]) -> None:
    _advisor, path = path_to(forked, GOALS[1])
    for n in range(1, path.count):
        twist, bend = path.states[n, 12:]
        moved = advanced(MODEL, path.state(n - 1), float(path.steps_mm[n]), float(twist), float(bend))
        np.testing.assert_allclose(moved.array, path.states[n], atol=1e-9)
        np.testing.assert_allclose(path.between(n, 1.0), path.states[n], atol=1e-9)
    assert (np.abs(np.diff(path.states[:, 13])) <= math.radians(27.5) + 1e-9).all()
    assert path.states[:, 12].min() >= math.radians(-90.0) - 1e-12
    assert path.states[:, 13].max() <= math.radians(120.0) + 1e-12
    assert path.length_mm == pytest.approx(path.steps_mm.sum())


def test_equal_seeds_give_equal_paths(forked: tuple[Lung, Lumen]) -> None:
    paths = [path_to(forked, GOALS[2], seed=seed)[1] for seed in (5, 5, 6)]
    assert paths[0].states.tobytes() == paths[1].states.tobytes()
    assert paths[0].states.tobytes() != paths[2].states.tobytes()


def test_retreats_only_come_nearer(forked: tuple[Lung, Lumen]) -> None:
    stuck = 0
    for seed in range(4):
        for target in GOALS:
            _, without = path_to(forked, target, seed=seed, retreats=0)
            advisor, retried = path_to(forked, target, seed=seed)
            assert retried.potentials[-1] <= without.potentials[-1]
            assert retried.nearest == retried.count - 1
            assert retried.potentials[-1] == retried.potentials.min()
            if not without.reached:
                stuck += 1
                assert retried.reached
                assert retried.retreats > 0
                assert "no motion found" in why_stopped(without, advisor.field, forked[0].tree)
            else:
                assert retried.states.tobytes() == without.states.tobytes()
    assert stuck > 0


def test_reproduction_obeys_equation_1_and_stops_where_the_paper_stops(forked: tuple[Lung, Lumen]) -> None:
    lung, lumen = forked
    model = ScopeModel()
    start = start_state(lumen, lung.tree, model)
    for seed in range(3):
        advisor = Advisor(lumen, model, goal_at(lumen, GOALS[0], 2.0), reproduction=True)
        path = advisor.path(start, seed=seed)
        assert path.reproduction
        assert path.retreats == 0
        assert advisor.environment.fits(path.states).all()
        assert (path.steps_mm[1:] == 1.0).all()
        assert path.potentials[path.nearest] == path.potentials.min()
        if not path.reached:
            assert advisor.advise(path.state(path.count - 1)).action == "pull back"


def test_too_narrow_is_said_with_the_place_and_thinner_scopes_are_tried(forked: tuple[Lung, Lumen]) -> None:
    lung, lumen = forked
    thick = ScopeModel(radius_mm=3.6, twist_low_deg=-90.0, bend_low_deg=-120.0)
    advisor, path = path_to(forked, GOALS[2], thick, retreats=10)
    assert not path.reached
    words = why_stopped(path, advisor.field, lung.tree)
    assert words.startswith("too narrow in generation")
    assert "7.2 mm thick" in words
    tried = advisor.thinner(start_state(lumen, lung.tree, thick), seed=1)
    assert tried[-1].reached
    assert not any(one.reached for one in tried[:-1])
    assert tried[-1].radius_mm < 3.0
    assert [one.radius_mm for one in tried] == sorted((one.radius_mm for one in tried), reverse=True)


def test_a_scope_that_does_not_fit_is_refused(forked: tuple[Lung, Lumen]) -> None:
    lung, lumen = forked
    with pytest.raises(AnatomyError, match="fits nowhere in the trachea"):
        start_state(lumen, lung.tree, ScopeModel(radius_mm=8.0))


def test_best_motions_lead_on_or_end_with_a_word(forked: tuple[Lung, Lumen]) -> None:
    advisor, path = path_to(forked, GOALS[0])
    for number in range(path.count - 1):
        advice = advisor.advise(path.state(number))
        if advice.action == "advance":
            assert advice.motion is not None
            assert advice.motion.advance_mm <= 5.0
            assert advice.cost == advice.candidates.cost.min()
            assert 0.0 <= advice.cost <= 1.0
        else:
            assert advice.action == "pull back"
            assert (advice.candidates.verdict != 3).all()
    done = advisor.advise(path.state(path.count - 1))
    assert (done.action, done.motion) == ("arrived", None)


def test_the_users_own_motion_is_evaluated(forked: tuple[Lung, Lumen]) -> None:
    advisor, path = path_to(forked, GOALS[1])
    state = path.state(10)
    advice = advisor.advise(state)
    assert advice.motion is not None
    own = advisor.advise(state, own=advice.motion).own
    assert own is not None
    assert (own.verdict, own.cost) == ("valid", advice.cost)
    bent = Motion(advance_mm=5.0, twist_rad=0.0, bend_rad=math.radians(115.0))
    wrong = advisor.advise(state, own=bent).own
    assert wrong is not None
    assert wrong.verdict in ("collides", "leads away")
    assert wrong.cost == math.inf


def test_a_tip_outside_the_lumen_gets_no_advice(forked: tuple[Lung, Lumen]) -> None:
    advisor, _path = path_to(forked, GOALS[0])
    with pytest.raises(AnatomyError, match="not in the lumen"):
        advisor.advise(straight_state(np.array([30.0, 0.0, 30.0]), np.array([0.0, 0.0, -1.0])))


def test_instructions_name_every_bifurcation(forked: tuple[Lung, Lumen]) -> None:
    lung, _lumen = forked
    _advisor, path = path_to(forked, GOALS[1])
    instructions = instructions_along(path, lung.tree)
    assert [one.branch for one in instructions] == [0, 1, 3]
    assert [one.generation for one in instructions] == [0, 1, 2]
    assert instructions[1].from_carina_mm == pytest.approx(0.0, abs=0.6)
    assert instructions[2].from_carina_mm == pytest.approx(np.linalg.norm(LEFT - CARINA), abs=1.0)
    assert sum(one.advance_mm for one in instructions) == pytest.approx(path.length_mm)
    assert instructions[1].heading == "to the patient's left"
    twists = np.cumsum([one.rotate_deg for one in instructions])
    np.testing.assert_allclose(twists, [one.twist_deg for one in instructions], atol=1e-9)
    assert "into generation 2" in instructions[2].text()
    assert "At the carina" in instructions[1].text()
    _advisor, right = path_to(forked, GOALS[0])
    assert instructions_along(right, lung.tree)[1].heading == "to the patient's right"


def test_the_camera_flies_in_small_steps_from_state_to_state(forked: tuple[Lung, Lumen]) -> None:
    _advisor, path = path_to(forked, GOALS[1])
    flight = camera_flight(path, spacing_mm=0.3, turn_rad=0.05)
    frames, tips = flight.lps_from_camera, path.tips()
    places = frames[:, :3, 3]
    assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() <= 0.3
    turned = np.einsum("nij,nij->n", frames[1:, :3, :3], frames[:-1, :3, :3])
    assert np.arccos(np.clip((turned - 1.0) / 2.0, -1.0, 1.0)).max() <= 0.05 + 1e-9
    for tip in tips:
        assert np.abs(frames - tip).max(axis=(1, 2)).min() < 1e-9, "every state is passed"
    assert flight.inserted_mm[-1] == pytest.approx(path.length_mm)
    assert (np.diff(flight.inserted_mm) > 0.0).all()
    curve = flight.markups()["markups"][0]
    assert curve["coordinateSystem"] == "LPS"
    assert len(curve["controlPoints"]) == len(frames)
    assert curve["controlPoints"][3]["position"] == places[3].tolist()
    with pytest.raises(SettingsError):
        camera_flight(path, spacing_mm=0.0)


def test_a_straight_tube_needs_no_bend() -> None:
    lumen, tree = tube(5.0, 60.0, [0.4, 0.9, 0.6])
    advisor = Advisor(lumen, MODEL, goal_at(lumen, [0.0, 0.0, -58.0]))
    path = advisor.path(start_state(lumen, tree, MODEL))
    assert path.reached
    assert path.length_mm < 60.0
    strict = ScopeEnvironment(model=MODEL, field=advisor.field)
    assert strict.fits(path.states).all()

"""The table of candidates against eqs. 3 to 9 written out, one candidate after the other."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from stages.scope.advisor.advisor import Advisor, PathSettings, start_state
from stages.scope.advisor.best_motion import CANDIDATES, VERDICTS, Motion, Weights, evaluate_motions, offsets
from stages.scope.advisor.environment import ScopeEnvironment
from stages.scope.advisor.kinematics import ScopeModel, ScopeState, advanced, tool_frames
from stages.scope.advisor.lumen import Lumen
from stages.scope.advisor.nf1 import goal_at, navigation_field
from tests.stages.scope.airways import LINES

WEIGHTS = Weights(nf1=0.5, clearance=0.3, twist=0.2)
OUT, AWAY, COLLIDES, VALID = range(4)


def environment_of(lumen: Lumen, *, reproduction: bool, model: ScopeModel | None = None) -> ScopeEnvironment:
    goal = goal_at(lumen, LINES[3][1])
    metric = "voxels" if reproduction else "mm"
    field = navigation_field(lumen, goal.voxel, metric=metric)
    return ScopeEnvironment(model=model or ScopeModel(), field=field, reproduction=reproduction)


def states_on_the_way(forked: tuple[Lung, Lumen]) -> list[ScopeState]:
    lung, lumen = forked
    model = ScopeModel(twist_low_deg=-90.0)
    advisor = Advisor(lumen, model, goal_at(lumen, LINES[3][1]))
    path = advisor.path(start_state(lumen, lung.tree, model), seed=2)
    bent = [replace(path.state(n), bend_rad=bend) for n, bend in ((0, -1.5), (0, 1.95), (20, -1.4))]
    return [*(path.state(n) for n in range(0, path.count, 12)), *bent]


@pytest.fixture(scope="module")
def states(forked: tuple[Lung, Lumen]) -> list[ScopeState]:
    return states_on_the_way(forked)


def by_the_paper(
    environment: ScopeEnvironment, state: ScopeState, dz: float, moved: np.ndarray
) -> dict[str, np.ndarray]:
    """Eqs. 3 to 9 as printed, with the readings of docs/explanation/deviations.md."""
    model, lumen, field = environment.model, environment.lumen, environment.field
    low, high = np.radians([model.twist_low_deg, model.twist_high_deg])
    least, most = np.radians([model.bend_low_deg, model.bend_high_deg])
    middle = 0.0 if environment.reproduction else 0.5 * (low + high)
    here = lumen.voxel_at(tool_frames(model, state.array)[0][:3, 3])
    gradient = np.zeros(3)
    for di in (-1, 0, 1):
        for dj in (-1, 0, 1):
            for dk in (-1, 0, 1):
                ijk = lumen.voxels[here] + (di, dj, dk)
                number = lumen.index[tuple(ijk)]
                clearance = field.clearance[number] if number >= 0 else 0.0
                offset = lumen.grid.lps(ijk) - lumen.centres(here)
                gradient += offset * (clearance - field.clearance[here])
    out = {name: np.zeros(CANDIDATES) for name in ("twist", "bend", "k_nf1", "k_clearance", "k_twist")}
    verdict, nf1, cg = np.zeros(CANDIDATES, dtype=int), np.full(CANDIDATES, np.inf), np.zeros(CANDIDATES)
    n = -1
    for i in range(-5, 6):
        for j in range(-5, 6):
            n += 1
            alpha = middle + i * (high - low) / 10
            beta = state.bend_rad + j * math.radians(model.bend_step_deg)
            if not least - 1e-9 <= beta <= most + 1e-9:
                out["twist"][n], out["bend"][n] = np.clip(alpha, low, high), np.clip(beta, least, most)
                verdict[n] = OUT
                continue
            if (i, j) != (0, 0):
                alpha += moved[n, 0] * (high - low) / 10
                beta += moved[n, 1] * math.radians(model.bend_step_deg)
            alpha, beta = float(np.clip(alpha, low, high)), float(np.clip(beta, least, most))
            out["twist"][n], out["bend"][n] = alpha, beta
            there = advanced(model, state, dz, alpha, beta)
            voxel = lumen.voxel_at(tool_frames(model, there.array)[0][:3, 3])
            if voxel < 0:
                verdict[n] = COLLIDES
                continue
            nf1[n] = field.potential[voxel]
            if nf1[n] >= field.potential[here]:
                verdict[n] = AWAY
            else:
                verdict[n] = VALID if environment.fits(there.array)[0] else COLLIDES
            if voxel != here:
                q = lumen.centres(voxel) - lumen.centres(here)
                cg[n] = max(float(q @ gradient) / np.linalg.norm(q), 0.0)
    valid = verdict == VALID
    if valid.any():
        a, b = nf1[valid], cg[valid]
        out["k_nf1"][valid] = (a - a.min()) / (a.max() - a.min()) if a.max() > a.min() else 0.0
        out["k_clearance"][valid] = 1 - (b - b.min()) / (b.max() - b.min()) if b.max() > b.min() else 0.0
        hat = out["twist"][valid] / max(-low, high)
        hat_now, bent = state.twist_rad / max(-low, high), np.abs(out["bend"][valid]) / max(-least, most)
        out["k_twist"][valid] = 0.5 * (1 - bent) * np.abs(hat) + 0.5 * np.abs((hat - hat_now) / 2)
    return {**out, "verdict": verdict}


@pytest.mark.parametrize("seed", [None, 4])
def test_the_table_is_that_of_the_paper(
    forked: tuple[Lung, Lumen], states: list[ScopeState], seed: int | None
) -> None:
    environment = environment_of(forked[1], reproduction=True)
    counted = np.zeros(4, dtype=int)
    for state in states:
        rng = None if seed is None else np.random.default_rng(seed)
        moved = offsets(None if seed is None else np.random.default_rng(seed))
        found, _ = evaluate_motions(environment, state, 5.0, WEIGHTS, rng=rng)
        expected = by_the_paper(environment, state, 5.0, moved)
        counted += np.bincount(expected["verdict"], minlength=4)
        np.testing.assert_array_equal(found.verdict, expected["verdict"])
        inside = found.verdict != OUT
        np.testing.assert_allclose(found.twist_rad[inside], expected["twist"][inside], atol=1e-12)
        np.testing.assert_allclose(found.bend_rad[inside], expected["bend"][inside], atol=1e-12)
        for name in ("k_nf1", "k_clearance", "k_twist"):
            np.testing.assert_allclose(getattr(found, name), expected[name], atol=1e-9)
        cost = WEIGHTS.array @ [found.k_nf1, found.k_clearance, found.k_twist]
        valid = found.verdict == VALID
        np.testing.assert_allclose(found.cost[valid], cost[valid], atol=1e-12)
        assert np.isinf(found.cost[~valid]).all()
        assert found.best == (int(np.argmin(found.cost)) if valid.any() else -1)
    assert (counted > 20).all(), counted


def test_the_true_radius_only_takes_candidates_away(
    forked: tuple[Lung, Lumen], states: list[ScopeState]
) -> None:
    """The twists cover their whole range; valid is what fits after the look-ahead, and whose shaft does."""
    environment = environment_of(forked[1], reproduction=False, model=ScopeModel(radius_mm=2.0))
    valid = 0
    for state in states:
        found, _ = evaluate_motions(environment, state, 5.0, WEIGHTS)
        expected = by_the_paper(environment, state, 5.0, offsets(None))
        assert ((found.verdict == VALID) <= (expected["verdict"] == VALID)).all()
        np.testing.assert_array_equal(found.verdict == AWAY, expected["verdict"] == AWAY)
        assert found.twist_rad[[0, -1]] == pytest.approx(np.radians([-60.0, 90.0]))
        valid += int((found.verdict == VALID).sum())
    assert valid > 20


def test_random_offsets_stay_within_their_spacing_and_their_range(
    forked: tuple[Lung, Lumen], states: list[ScopeState]
) -> None:
    environment = environment_of(forked[1], reproduction=False)
    plain, _ = evaluate_motions(environment, states[1], 5.0, WEIGHTS)
    moved, _ = evaluate_motions(environment, states[1], 5.0, WEIGHTS, rng=np.random.default_rng(1))
    again, _ = evaluate_motions(environment, states[1], 5.0, WEIGHTS, rng=np.random.default_rng(1))
    np.testing.assert_array_equal(moved.cost, again.cost)
    twist, bend = moved.twist_rad - plain.twist_rad, moved.bend_rad - plain.bend_rad
    assert np.abs(twist).max() <= math.radians(7.5) + 1e-12
    assert np.abs(bend).max() <= math.radians(2.5) + 1e-12
    assert np.abs(twist).max() > math.radians(5.0)
    middle = CANDIDATES // 2
    assert twist[middle] == bend[middle] == 0.0
    assert moved.twist_rad.min() >= math.radians(-60.0)
    assert moved.twist_rad.max() <= math.radians(90.0)


def test_ties_and_ranges_of_nothing_are_defined(forked: tuple[Lung, Lumen], states: list[ScopeState]) -> None:
    stiff = ScopeModel(twist_low_deg=0.0, twist_high_deg=0.0, bend_low_deg=0.0, bend_high_deg=0.0)
    environment = environment_of(forked[1], reproduction=False, model=stiff)
    found, _ = evaluate_motions(environment, replace(states[0], bend_rad=0.0, twist_rad=0.0), 5.0, WEIGHTS)
    valid = np.flatnonzero(found.verdict == VALID)
    assert len(valid) == 11, "bends other than 0 are out of range, the twists are all the same"
    assert (found.cost[valid] == 0.0).all(), "all equal in potential and clearance, no twist"
    assert found.best == valid[0]


def test_ones_own_motion_costs_what_the_candidate_costs(
    forked: tuple[Lung, Lumen], states: list[ScopeState]
) -> None:
    environment = environment_of(forked[1], reproduction=False)
    table, _ = evaluate_motions(environment, states[2], 5.0, WEIGHTS)
    verdicts = set()
    for row in range(CANDIDATES):
        if table.verdict[row] == OUT:
            continue
        again, own = evaluate_motions(environment, states[2], 5.0, WEIGHTS, own=table.motion(row))
        assert own is not None
        assert own.verdict == VERDICTS[table.verdict[row]]
        assert own.cost == table.cost[row]
        assert again.best == table.best
        verdicts.add(own.verdict)
    assert "valid" in verdicts
    _, beyond = evaluate_motions(
        environment, states[2], 5.0, WEIGHTS, own=Motion(advance_mm=5.0, twist_rad=2.0, bend_rad=0.0)
    )
    assert beyond is not None
    assert (beyond.verdict, beyond.cost) == ("out of range", math.inf)


def test_weights_add_up_to_one() -> None:
    with pytest.raises(SettingsError, match="add up"):
        Weights(nf1=0.5, clearance=0.5, twist=0.5)
    with pytest.raises(SettingsError):
        Weights(nf1=1.5, clearance=-0.5, twist=0.0)
    with pytest.raises(SettingsError, match="look_ahead_mm"):
        PathSettings(look_ahead_mm=1.0, sub_step_mm=2.0)

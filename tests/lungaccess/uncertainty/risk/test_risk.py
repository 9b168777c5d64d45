"""Deviated plans: the same geometry as by other means, known probabilities, tolerances that hold."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest, chi, norm

import lungaccess as la
from anatomy.base.errors import PlanFileError, SettingsError
from anatomy.base.settings import override
from anatomy.grid import read_only
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL
from lungaccess.cli.app import main
from lungaccess.cli.exit_code import ExitCode
from lungaccess.plans.parts import NeedleArc
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import (
    BREATHING,
    CURVATURE,
    UNITS,
    AngleError,
    CurvatureError,
    ErrorModel,
    Place,
    PositionError,
)
from lungaccess.uncertainty.risk.assessment import assess
from lungaccess.uncertainty.risk.assessor import RiskAssessor
from lungaccess.uncertainty.risk.deviations import (
    Deviations,
    Draws,
    deviated_pieces,
    deviated_starts,
    no_deviations,
)
from lungaccess.uncertainty.risk.kernels import deviation as kernel
from lungaccess.uncertainty.risk.kernels.chain import TUBE_PIECES
from lungaccess.uncertainty.risk.patient_errors import model_for
from lungaccess.uncertainty.risk.statistics import Share
from lungaccess.uncertainty.risk.tolerances import LARGEST, Tolerance, find_tolerances
from stages.needle.path import arc_transform
from tests.stages.scenes import brute_clearance
from tests.stages.tube.closed_form import centreline

SYSTEM = la.load_system("ultrathin")
SAMPLES_MM = 0.02
"""Between the points at which these tests look."""
UNSEEN_MM = 0.5 * kernel.STEP_MM
"""No point is farther from one that the kernel looks at, so no deeper in what the kernel does not see."""
NOTHING = ErrorModel()


@pytest.fixture(scope="module")
def plan(small_lung: Lung, small_atlas: la.Atlas) -> Plan:
    target = la.resolve_target(small_lung)
    *_, best = la.plan(small_lung, SYSTEM, target, atlas=small_atlas, iterations=100, goal="default")
    return best


@pytest.fixture(scope="module")
def assessor(plan: Plan, small_lung: Lung) -> RiskAssessor:
    return RiskAssessor(plan, small_lung, radius_mm=3.0)


def in_two(plan: Plan) -> Plan:
    """Return the plan with its first arc cut in two, rolled back and forth in between."""
    first, *rest = plan.needle.arcs
    half = replace(first, length_mm=0.4 * first.length_mm)
    other = NeedleArc(length_mm=0.6 * first.length_mm, roll_rad=0.7, curvature_per_mm=first.curvature_per_mm)
    if rest:
        rest[0] = replace(rest[0], roll_rad=rest[0].roll_rad - 0.7)
    return replace(plan, needle=replace(plan.needle, arcs=(half, other, *rest)))


def chain(plan: Plan, lung: Lung, deviations: Deviations, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points every SAMPLES_MM of one deviated plan and their arc lengths, by 4x4 matrices."""
    frame = np.array(plan.scope.lps_from_scope_tip)
    tilt = frame[:3, :2] @ deviations.tilt_rad[n]
    frame[:3, :3] = Rotation.from_rotvec(tilt).as_matrix() @ frame[:3, :3]
    frame[:3, 3] = deviated_starts(plan, lung, deviations)[n, :3]
    points, lengths, total = [], [], 0.0
    for length, roll, curvature, _radius in deviated_pieces(plan, deviations)[n]:
        steps = np.linspace(0.0, length, 1 + max(1, math.ceil(length / SAMPLES_MM)))
        points += [(frame @ arc_transform(s, roll, curvature))[:3, 3] for s in steps]
        lengths += (total + steps).tolist()
        frame = frame @ arc_transform(length, roll, curvature)
        total += length
    return np.array(points), np.array(lengths)


def test_without_errors_it_is_the_plan(assessor: RiskAssessor, plan: Plan, small_lung: Lung) -> None:
    outcomes = assessor.outcomes(Deviations(**no_deviations(3, assessor.n_arcs)))
    assert (outcomes.touched == 0).all()
    assert (outcomes.miss_mm < 1e-6).all()
    report = assess(plan, small_lung, model=NOTHING, samples=50)
    assert report.succeeds.value == report.reaches.value == 1.0
    assert all(share.count == 0 for share in report.touches.values())


def test_deviated_plans_end_where_matrices_say(plan: Plan, small_lung: Lung) -> None:
    bent = in_two(plan)
    there = RiskAssessor(bent, small_lung)
    deviations = Draws(30, there.n_arcs, 5).deviations(load_errors())
    outcomes = there.outcomes(deviations)
    for n in range(30):
        points, _lengths = chain(bent, small_lung, deviations, n)
        miss = np.linalg.norm(points[-1] - bent.target_lps - deviations.target_mm[n])
        assert outcomes.miss_mm[n] == pytest.approx(miss, abs=1e-6)


def test_the_tubes_have_the_shape_of_the_tube_stage(plan: Plan) -> None:
    """Also where the straight part of the inner tube leaves the scope, or even the outer tube."""
    # Rear ends in order: with a shorter outer tube the inner one may be that far ahead.
    shorter = {"tubes.outer.length_mm": SYSTEM.tubes.outer.length_mm - 60.0}
    ahead = override(SYSTEM, shorter)
    for outer, inner in ((3.0, 20.0), (10.0, 10.0), (15.0, 50.0), (4.0, 58.0), (0.0, 30.0)):
        tube = replace(plan.tube, outer_insertion_mm=outer, inner_insertion_mm=inner)
        moved = replace(plan, tube=tube, system=ahead)
        nothing = Deviations(**no_deviations(1, len(plan.needle.arcs)))
        pieces = deviated_pieces(moved, nothing)[0, :TUBE_PIECES]
        frame = np.array(plan.scope.lps_from_scope_tip)
        for length, roll, curvature, _radius in pieces:
            frame = frame @ arc_transform(length, roll, curvature)
        tip = centreline(
            SYSTEM.tubes, plan.scope.lps_from_scope_tip, plan.tube.rotation_rad, outer, inner, [inner]
        )
        assert np.allclose(frame[:3, 3], tip[0], atol=1e-9)
        assert pieces[:, kernel.LENGTH].sum() == pytest.approx(inner)


def test_what_is_touched_agrees_with_distances_to_all_voxels(plan: Plan, small_lung: Lung) -> None:
    there = RiskAssessor(plan, small_lung)
    wide = ErrorModel(
        scope_direction=AngleError(attempt_deg=15.0),
        tube_rotation=AngleError(attempt_deg=30.0),
        needle_insertion=PositionError(attempt_mm=8.0),
        needle_curvature=CurvatureError(attempt_ln=0.6),
    )
    deviations = Draws(60, there.n_arcs, 2).deviations(wide)
    outcomes = there.outcomes(deviations)
    pieces = deviated_pieces(plan, deviations)
    seen = 0
    for n in range(60):
        if outcomes.touched[n] & kernel.STAYS_INSIDE:
            continue
        points, lengths = chain(plan, small_lung, deviations, n)
        tube_mm = pieces[n, :TUBE_PIECES, kernel.LENGTH].sum()
        radius = np.where(lengths <= tube_mm, SYSTEM.tubes.inner.radius_mm, SYSTEM.needle.radius_mm)
        parts = {
            VESSEL: lengths > tube_mm, OUTSIDE: lengths > tube_mm, FISSURE: lengths > tube_mm,
            AIRWAY: lengths > tube_mm + plan.exemption.needle_length_mm,
        }  # fmt: skip
        for bit, part in parts.items():
            gap = brute_clearance(small_lung.labels, small_lung.grid, points[part], bit, 3.0) - radius[part]
            # A needle that comes out too short for a part has nothing there to touch with.
            nearest = gap.min(initial=np.inf)
            if nearest < -UNSEEN_MM:
                assert outcomes.touched[n] & bit
                seen += 1
            if nearest < 0.5 * SAMPLES_MM or bit == AIRWAY:
                continue
            tube = lengths <= tube_mm
            on_tube = brute_clearance(small_lung.labels, small_lung.grid, points[tube], bit, 3.0)
            if on_tube.min() > pieces[n, :TUBE_PIECES, kernel.RADIUS].max() + 0.5 * SAMPLES_MM:
                assert not outcomes.touched[n] & bit
    assert seen > 10


def test_vessels_reach_out_of_their_voxels_as_far_as_their_border(plan: Plan, small_lung: Lung) -> None:
    """A chain touches the voxels that lie nearer than its radius and the border; other structures stay."""
    there, wide = RiskAssessor(plan, small_lung), ErrorModel(scope_direction=AngleError(attempt_deg=12.0))
    border = replace(wide, vessel_border=PositionError(patient_mm=1.0, bias_mm=(0.5,)))
    plain, moved = (Draws(80, there.n_arcs, 2).deviations(model) for model in (wide, border))
    assert moved.border_mm.min() < -0.5 and moved.border_mm.max() > 1.5
    before, after = there.outcomes(plain), there.outcomes(moved)
    assert (before.touched & ~VESSEL == after.touched & ~VESSEL).all()
    pieces, seen = deviated_pieces(plan, moved), {True: 0, False: 0}
    for n in range(80):
        points, lengths = chain(plan, small_lung, moved, n)
        of_needle = lengths > pieces[n, :TUBE_PIECES, kernel.LENGTH].sum()
        if after.touched[n] & kernel.STAYS_INSIDE or not of_needle.any():
            continue
        near = brute_clearance(small_lung.labels, small_lung.grid, points, VESSEL, 6.0)
        reach = SYSTEM.needle.radius_mm + moved.border_mm[n]
        hits = near[of_needle].min() < max(reach - UNSEEN_MM, 1e-9)
        thick = pieces[n, :TUBE_PIECES, kernel.RADIUS].max() + max(moved.border_mm[n], 0.0)
        misses = near[of_needle].min() > max(reach, 0.0) + SAMPLES_MM
        misses &= near[~of_needle].min(initial=np.inf) > thick + SAMPLES_MM
        if hits or misses:
            assert bool(after.touched[n] & VESSEL) == hits
            seen[bool(hits)] += 1
    assert min(seen.values()) > 5
    assert (before.touched & VESSEL != after.touched & VESSEL).any()


def test_the_border_of_a_patients_vessels_is_drawn_unless_the_model_states_one(
    plan: Plan, small_lung: Lung
) -> None:
    stated = ErrorModel(vessel_border=PositionError(patient_mm=0.2))
    assert model_for(NOTHING, plan, small_lung).vessel_border == PositionError()
    known = replace(small_lung, vessel_border_mm=(0.4, 0.6))
    own = model_for(NOTHING, plan, known).vessel_border
    assert (own.bias, own.patient, own.attempt) == ((0.4,), 0.6, 0.0)
    assert model_for(stated, plan, known).vessel_border == stated.vessel_border
    chances = [assess(plan, each, samples=2000, each_kind=False).succeeds for each in (small_lung, known)]
    assert chances[1].count < chances[0].count


def test_a_scope_goes_as_far_as_the_lumen_lets_it(plan: Plan, small_lung: Lung) -> None:
    """Its tip keeps the planned depth or its radius, on the way, too, and could not go farther."""
    errors = no_deviations(400, 1)
    errors["scope_mm"] = np.random.default_rng(4).normal(0.0, 3.0, (400, 3))
    planned = np.array(plan.scope.lps_from_scope_tip)[:3, 3]
    depth = small_lung.lumen_depth.lower_bound_mm
    least = min(SYSTEM.scope.radius_mm, depth(planned)[0]) - 1e-6
    made = deviated_starts(plan, small_lung, Deviations(**errors))[:, :3] - planned
    shares = np.linalg.norm(made, axis=1) / np.linalg.norm(errors["scope_mm"], axis=1)
    assert np.allclose(made, shares[:, None] * errors["scope_mm"], atol=1e-9)
    assert (shares < 1.0 - 1e-9).sum() > 20 and (shares > 1.0 - 1e-9).sum() > 5
    for share, moved, shift in zip(shares, made, errors["scope_mm"], strict=True):
        way = planned + np.linspace(0.0, 1.0, 50)[:, None] * moved
        # Between two looks, STEP_MM apart, the depth may be less by half of that.
        assert depth(way).min() >= least - UNSEEN_MM
        if share < 1.0 - 1e-9:
            beyond = np.linspace(0.0, 2.0 * kernel.STEP_MM, 50)[:, None] * shift / np.linalg.norm(shift)
            assert depth(planned + moved + beyond).min() < least + 1e-6


def test_no_device_goes_farther_than_it_can(plan: Plan) -> None:
    errors = no_deviations(2, len(plan.needle.arcs))
    errors["insertion_mm"] = np.array([[400.0, 400.0], [-400.0, 400.0]])
    errors["stop_mm"][:] = 1000.0
    tubes = SYSTEM.tubes
    pieces = deviated_pieces(plan, Deviations(**errors))
    lengths = pieces[:, :TUBE_PIECES, kernel.LENGTH].sum(axis=1)
    assert lengths[0] == pytest.approx(tubes.max_extension_mm)
    assert lengths[1] == pytest.approx(min(tubes.max_extension_mm, tubes.max_inner_protrusion_mm))
    assert pieces[:, TUBE_PIECES:, kernel.LENGTH].sum(axis=1) == pytest.approx(SYSTEM.needle.max_length_mm)


def test_leaving_a_main_bronchus_pierces_the_pleura(plan: Plan, small_lung: Lung) -> None:
    tree = replace(small_lung.tree)
    vars(tree)["mediastinal"] = read_only(np.arange(tree.n_branches) == plan.tube.exit.branch)
    there = RiskAssessor(plan, replace(small_lung, tree=tree))
    outcomes = there.outcomes(Deviations(**no_deviations(1, there.n_arcs)))
    assert outcomes.touched[0] == OUTSIDE
    assert not there.succeeded(outcomes)[0]


def test_tubes_that_stay_in_the_airway(assessor: RiskAssessor, plan: Plan) -> None:
    errors = no_deviations(1, assessor.n_arcs)
    errors["insertion_mm"] = np.array([[-100.0, -100.0]])
    assert assessor.outcomes(Deviations(**errors)).touched[0] == kernel.STAYS_INSIDE


def test_an_error_of_the_target_alone_has_a_known_probability(assessor: RiskAssessor) -> None:
    draws = Draws(20_000, assessor.n_arcs, 1)
    share = assessor.success(draws, NOTHING.only("target_position", 2.0))
    truth = chi.cdf(assessor.radius_mm / 2.0, 3)
    assert abs(share.value - truth) < 4.0 * math.sqrt(truth * (1.0 - truth) / 20_000)


def test_an_error_of_the_last_insertion_alone_has_a_known_probability(plan: Plan, small_lung: Lung) -> None:
    there = RiskAssessor(plan, small_lung, radius_mm=0.5)
    draws = Draws(20_000, there.n_arcs, 1)
    if there.n_arcs == 1:
        truth = 2.0 * norm.cdf(0.5 / 0.4) - 1.0
        share = there.success(draws, NOTHING.only("needle_insertion", 0.4))
        assert abs(share.value - truth) < 4.0 * math.sqrt(truth * (1.0 - truth) / 20_000)
    miss = there.outcomes(draws.deviations(NOTHING.only("needle_insertion", 0.01))).miss_mm
    assert 0.0 < miss.max() < 0.2


def test_rotation_of_the_tubes_leaves_the_needles_roll(plan: Plan) -> None:
    errors = no_deviations(1, len(plan.needle.arcs))
    errors["rotation_rad"] = np.array([0.3])
    pieces = deviated_pieces(plan, Deviations(**errors))[0]
    assert pieces[0, kernel.ROLL] == pytest.approx(plan.tube.rotation_rad + 0.3)
    assert pieces[TUBE_PIECES, kernel.ROLL] == pytest.approx(plan.needle.arcs[0].roll_rad - 0.3)


def test_nothing_goes_backwards(plan: Plan, small_lung: Lung) -> None:
    bent = in_two(plan)
    draws = Draws(500, len(bent.needle.arcs), 3)
    far = PositionError(attempt_mm=20.0)
    deviations = draws.deviations(ErrorModel(tube_insertion=far, needle_insertion=far))
    assert (deviated_pieces(bent, deviations)[..., kernel.LENGTH] >= 0.0).all()
    starts = deviated_starts(bent, small_lung, draws.deviations(NOTHING.only("scope_direction", 40.0)))
    assert np.allclose(np.linalg.norm(starts[:, 3:6], axis=1), 1.0)
    assert np.allclose((starts[:, 3:6] * starts[:, 6:]).sum(axis=1), 0.0)


def test_the_same_seed_gives_the_same_report(plan: Plan, small_lung: Lung) -> None:
    first, again, other = (assess(plan, small_lung, samples=400, seed=seed) for seed in (3, 3, 4))
    assert first == again
    assert first.miss_mm != other.miss_mm
    assert first.model == load_errors("breath-hold")


def test_larger_errors_are_riskier(assessor: RiskAssessor) -> None:
    draws = Draws(2000, assessor.n_arcs, 0)
    model = load_errors()
    shares = [assessor.success(draws, model.scaled(scale)).value for scale in (0.0, 0.2, 1.0, 5.0)]
    assert shares[0] == 1.0
    assert shares == sorted(shares, reverse=True)
    assert shares[3] < 0.2


@pytest.mark.parametrize("radius_mm", [0.5, 3.0, 30.0])
@pytest.mark.parametrize("scale", [0.1, 1.0, 5.0])
def test_successes_are_those_of_the_outcomes(
    plan: Plan, small_lung: Lung, radius_mm: float, scale: float
) -> None:
    """Whoever asks for successes alone is told the same, though less is looked at."""
    there = RiskAssessor(plan, small_lung, radius_mm=radius_mm)
    deviations = Draws(400, there.n_arcs, 3).deviations(load_errors().scaled(scale))
    expected = there.succeeded(there.outcomes(deviations))
    np.testing.assert_array_equal(there.successes(deviations), expected)


def test_interval_of_wilson_1927() -> None:
    for count, samples in ((0, 10), (10, 10), (3, 10), (500, 1000), (1, 10_000)):
        truth = binomtest(count, samples).proportion_ci(method="wilson")
        low, high = Share(count=count, samples=samples).interval
        assert (low, high) == pytest.approx((truth.low, truth.high), abs=1e-12)
    assert Share(count=8, samples=10).interval == pytest.approx((0.4902, 0.9433), abs=1e-4)


@pytest.fixture(scope="module")
def found(plan: Plan, small_lung: Lung) -> dict[str, Tolerance]:
    kept = find_tolerances(plan, small_lung, samples=500, radius_mm=3.0)
    return {each.kind: each for each in kept}


def test_a_bias_acts_along_the_axes_of_the_scopes_tip(
    assessor: RiskAssessor, plan: Plan, small_lung: Lung
) -> None:
    """A known bias of the tip back along its axis and about its x moves and tilts every draw alike."""
    model = ErrorModel(
        scope_position=PositionError(bias_mm=(0.0, 0.0, -0.2)),
        scope_direction=AngleError(bias_deg=(6.0, 0.0)),
    )
    planned = np.asarray(plan.scope.lps_from_scope_tip)
    starts = deviated_starts(plan, small_lung, assessor.draws(3, 0).deviations(model))
    assert np.allclose(starts[:, :3], planned[:3, 3] - 0.2 * planned[:3, 2])
    turned = planned[:3, :3] @ Rotation.from_euler("x", 6.0, degrees=True).as_matrix()
    assert np.allclose(starts[:, 3:6], turned[:, 2]) and np.allclose(starts[:, 6:], turned[:, 0])


def test_a_model_has_the_errors_of_the_scopes_place(plan: Plan, small_lung: Lung) -> None:
    tree, tip = small_lung.tree, np.asarray(plan.scope.lps_from_scope_tip)[:3, 3]
    generation = int(tree.generation[tree.branch_of_point[tree.nearest_point(tip)]])
    worse = AngleError(attempt_deg=30.0)
    model = replace(load_errors("gated-ct"), name="")
    here = replace(model, place=(Place(generation_from=generation, scope_direction=worse),))
    elsewhere = replace(model, place=(Place(generation_from=generation + 1, scope_direction=worse),))
    found = [
        assess(plan, small_lung, model=each, samples=500, each_kind=False)
        for each in (model, here, elsewhere)
    ]
    assert found[0].succeeds == found[2].succeeds and found[1].succeeds.count < found[0].succeeds.count
    assert found[1].model.scope_direction == worse and not found[1].model.place
    lobar = replace(model, place=(Place(lobe="right upper", scope_direction=worse),))
    with pytest.raises(SettingsError, match="lobe"):
        assess(plan, replace(small_lung, lobes=None), model=lobar, samples=10, each_kind=False)


def test_tolerances_hold_and_more_does_not(found: dict[str, Tolerance], assessor: RiskAssessor) -> None:
    assert list(found) == [kind for kind in UNITS if kind != BREATHING]
    draws = Draws(500, assessor.n_arcs, 0)
    for name, each in found.items():

        def share(size: float, name: str = name) -> float:
            return assessor.success(draws, NOTHING.only(name, size)).value

        assert share(each.largest) >= 0.95
        if each.largest < LARGEST[each.unit]:
            assert share(each.largest + LARGEST[each.unit] / 500) < 0.95


def test_the_margin_of_the_target_is_the_radius(found: dict[str, Tolerance]) -> None:
    assert found["target_position"].margin == pytest.approx((3.0, 3.0), abs=0.02)
    truth = 3.0 / chi.ppf(0.95, 3)
    assert found["target_position"].largest == pytest.approx(truth, rel=0.1)


def test_errors_within_the_margins_never_fail(found: dict[str, Tolerance], assessor: RiskAssessor) -> None:
    for sign, size in zip((-1.0, 1.0), found["tube_rotation"].margin, strict=True):
        errors = no_deviations(50, assessor.n_arcs)
        errors["rotation_rad"] = sign * np.radians(np.linspace(0.0, size, 50))
        assert assessor.succeeded(assessor.outcomes(Deviations(**errors))).all()
    low, high = found[CURVATURE].margin
    assert low <= 1.0 <= high
    errors = no_deviations(50, assessor.n_arcs)
    errors["factor"] = np.linspace(low, high, 50)
    assert assessor.succeeded(assessor.outcomes(Deviations(**errors))).all()


def test_the_radius_of_a_nodule(plan: Plan, small_lung: Lung) -> None:
    radius = RiskAssessor(plan, small_lung).radius_mm
    assert small_lung.nodules is not None
    total = small_lung.nodules.array.sum() * small_lung.grid.voxel_volume_mm3
    assert 0.0 < 4.0 / 3.0 * math.pi * radius**3 <= total * (1.0 + 1e-9)
    bare = RiskAssessor(plan, replace(small_lung, nodules=None))
    assert (bare.radius_mm, bare.radius_origin[:7]) == (5.0, "assumed")


def test_allowed_fissures_do_not_fail(plan: Plan, small_lung: Lung) -> None:
    assert small_lung.has_fissures
    assert "fissure" in RiskAssessor(plan, small_lung).forbidden
    allowed = RiskAssessor(replace(plan, fissures_are_obstacles=False), small_lung)
    assert "fissure" not in allowed.forbidden and "fissure" in allowed.structures


def test_bad_input_is_refused(plan: Plan, small_lung: Lung, tmp_path: Path) -> None:
    with pytest.raises(PlanFileError, match="was made for"):
        RiskAssessor(replace(plan, lung_key="another"), small_lung)
    for radius in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(SettingsError, match="radius"):
            RiskAssessor(plan, small_lung, radius_mm=radius)
    with pytest.raises(SettingsError, match="samples"):
        assess(plan, small_lung, samples=0)
    for probability in (0.0, 1.0, math.nan):
        with pytest.raises(SettingsError, match="probability"):
            find_tolerances(plan, small_lung, probability=probability)


@pytest.mark.slow
def test_the_command(
    plan: Plan, small_lung: Lung, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr("lungaccess.problem.patients.load_patient", lambda *_args, **_options: small_lung)
    plan.save(tmp_path / "plan.json")
    (tmp_path / "errors.toml").write_text("[scope_position]\nattempt_mm = 0.25\n")
    command = ["risk", str(tmp_path / "plan.json"), "patient", "--samples", "200"]
    assert main([*command, "--errors", str(tmp_path / "errors.toml"), "--json"]) == ExitCode.OK
    written = json.loads(capsys.readouterr().out)
    assert written["errors"]["scope_position"]["attempt_mm"] == 0.25
    assert written["errors"]["tube_rotation"]["attempt_deg"] == load_errors().tube_rotation.attempt_deg
    stated = load_errors(tmp_path / "errors.toml")
    report = assess(plan, small_lung, model=stated, samples=200)
    assert written["succeeds"]["probability"] == report.succeeds.value
    assert [each["kind"] for each in written["tolerances"]] == [kind for kind in UNITS if kind != BREATHING]
    rested = {each["name"]: each for each in written["resting_scope"]}
    assert rested["tip turned"]["value"] > 0.0
    assert rested["force on 10 mm of wall"]["limit"] == 1.0
    assert main(command) == ExitCode.OK
    said = capsys.readouterr().out
    assert "succeeds" in said
    assert "rests on the wall" in said
    assert main([*command, "--radius", "-1"]) == ExitCode.BAD_INPUT

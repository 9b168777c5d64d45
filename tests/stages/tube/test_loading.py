"""Tubes with a needle in them: closed forms, limits, and the way of the needle."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from anatomy.base.errors import SettingsError
from anatomy.shafts import SlottedSegment
from experiments.support.needle_load.arrivals import bending_section, needle_arrivals
from stages.tube import (
    BEND_RAD,
    Neighbourhood,
    ShapeGrid,
    ShapeLimits,
    TubeMechanics,
    deploy,
    deployed,
    design_arrays,
    together,
    tube_shapes,
)
from stages.tube.casadi_shape import derive_arrival, derive_inserted, derive_loaded, derive_shape
from stages.tube.device import Tube
from stages.tube.kernels.shapes import TIP
from tests.stages.tube.pairs import WIDE

INNER, OUTER = WIDE.inner, WIDE.outer
SLOTS = SlottedSegment(length_mm=380.0, stiffness_factor=0.04, strain_factor=0.75)
SOFT_END = SlottedSegment(length_mm=30.0, stiffness_factor=0.1, strain_factor=0.6)
NEEDLE = Tube(outer_diameter_mm=1.0, inner_diameter_mm=0.0, length_mm=830.0)
TWISTED = (
    Tube(
        outer_diameter_mm=1.0, inner_diameter_mm=0.8, length_mm=700.0, curved_length_mm=40.0,
        precurvature_per_mm=0.02,
    ),
    Tube(
        outer_diameter_mm=1.3, inner_diameter_mm=1.1, length_mm=640.0, curved_length_mm=30.0,
        precurvature_per_mm=0.01,
    ),
)  # fmt: skip
THIN = Tube(outer_diameter_mm=0.5, inner_diameter_mm=0.3, length_mm=900.0)


def arcs(pieces: list[tuple[float, float]]) -> Any:
    """Return the tip of arcs of length and curvature that bend towards -y."""
    turn, at = 0.0, np.zeros(3)
    for length, curvature in pieces:
        steps = 4000
        angles = turn + curvature * length * (np.arange(steps) + 0.5) / steps
        at += length * np.array([0.0, -np.sin(angles).mean(), np.cos(angles).mean()])
        turn += curvature * length
    return at, turn


def tip_of(mechanics: TubeMechanics, out: tuple[float, ...], needle_mm: float) -> Any:
    beta = np.array(out) - mechanics.lengths_mm
    found = mechanics.given_base_angles(np.zeros(len(out)), beta, needle_mm=needle_mm)
    assert found.stable
    return found.base_from_tip


def test_a_needle_takes_its_share_of_the_bend_as_far_as_it_has_come() -> None:
    stiff, outer, needle = (tube.bending_stiffness_n_mm2 for tube in (INNER, OUTER, NEEDLE))
    found = tip_of(TubeMechanics([INNER, OUTER], needle=NEEDLE), (38.0, 10.0), 25.0)
    kappa = INNER.precurvature_per_mm * stiff
    point, turn = arcs(
        [(10.0, kappa / (stiff + outer + needle)), (15.0, kappa / (stiff + needle)), (13.0, kappa / stiff)]
    )
    assert found[:3, 3] == pytest.approx(point, abs=1e-5)
    assert np.arctan2(-found[1, 2], found[2, 2]) == pytest.approx(turn, abs=1e-12)


def test_flexible_segments_lie_where_the_needle_has_brought_them() -> None:
    needle = replace(NEEDLE, slotted_segments=(SOFT_END,))
    stiff, plain = INNER.bending_stiffness_n_mm2, NEEDLE.bending_stiffness_n_mm2
    mechanics, kappa = TubeMechanics([INNER], needle=needle), INNER.precurvature_per_mm * stiff
    for beyond in (0.0, 12.0, 40.0):
        soft = max(min(30.0 - beyond, 40.0), 0.0)
        point, turn = arcs([(40.0 - soft, kappa / (stiff + plain)), (soft, kappa / (stiff + 0.1 * plain))])
        found = tip_of(mechanics, (40.0,), 40.0 + beyond)
        assert found[:3, 3] == pytest.approx(point, abs=1e-5)
        assert np.arctan2(-found[1, 2], found[2, 2]) == pytest.approx(turn, abs=1e-12)


def test_a_needle_that_has_not_come_or_is_soft_changes_nothing_and_a_rigid_one_makes_tubes_straight() -> None:
    alone = tip_of(TubeMechanics([INNER, OUTER]), (40.0, 10.0), 0.0)
    assert np.array_equal(tip_of(TubeMechanics([INNER, OUTER], needle=NEEDLE), (40.0, 10.0), 0.0), alone)
    soft = replace(NEEDLE, youngs_modulus_gpa=1e-12)
    assert tip_of(TubeMechanics([INNER, OUTER], needle=soft), (40.0, 10.0), 99.0) == pytest.approx(
        alone, abs=1e-9
    )
    plastic = [replace(tube, youngs_modulus_gpa=1e-9) for tube in (INNER, OUTER)]
    straight = tip_of(TubeMechanics(plastic, needle=NEEDLE), (40.0, 10.0), 99.0)
    assert straight[:3, 3] == pytest.approx([0.0, 0.0, 40.0], abs=1e-6)


def test_slots_of_one_tube_alone_change_how_tubes_share_their_bend() -> None:
    slotted = replace(INNER, slotted_segments=(SLOTS,))
    stiff, outer = 0.04 * INNER.bending_stiffness_n_mm2, OUTER.bending_stiffness_n_mm2
    point, _turn = arcs([(20.0, INNER.precurvature_per_mm * stiff / (stiff + outer))])
    assert tip_of(TubeMechanics([slotted, OUTER]), (20.0, 20.0), 0.0)[:3, 3] == pytest.approx(point, abs=1e-6)


def test_section_tubes_and_needle_are_one_equilibrium() -> None:
    section = bending_section(4.0, 2.0, 10.0, 1000.0, 0.1)
    assert section.bending_stiffness_n_mm2 == pytest.approx(1000.0)
    slotted = [replace(tube, slotted_segments=(SLOTS,)) for tube in (INNER, OUTER)]
    mechanics = TubeMechanics([*slotted, section], needle=NEEDLE)
    inside = 0.04 * (INNER.bending_stiffness_n_mm2 + OUTER.bending_stiffness_n_mm2)
    for needle_mm, needle in ((0.0, 0.0), (50.0, NEEDLE.bending_stiffness_n_mm2)):
        found = tip_of(mechanics, (50.0, 50.0, 10.0), needle_mm)
        stiff = 0.04 * INNER.bending_stiffness_n_mm2
        bent = INNER.precurvature_per_mm * stiff / (inside + needle)
        point, turn = arcs([(10.0, 100.0 / (1000.0 + inside + needle)), (40.0, bent)])
        assert found[:3, 3] == pytest.approx(point, abs=1e-5)
        assert np.arctan2(-found[1, 2], found[2, 2]) == pytest.approx(turn, abs=1e-12)


def deployments(tubes: tuple[Tube, ...], count: int) -> tuple[Any, Any]:
    rng = np.random.default_rng(3)
    inner = rng.uniform(20.0, 60.0, count)
    out = np.column_stack([inner, inner * rng.uniform(0.3, 1.0, count)])
    angles = np.column_stack([rng.uniform(-3.0, 3.0, count), np.zeros(count)])
    angles[:, 1] = angles[:, 0] + rng.uniform(-1.5, 1.5, count)
    return angles, out - [tube.length_mm for tube in tubes]


def test_all_deployments_under_a_needle_are_the_single_equilibria() -> None:
    mechanics = TubeMechanics(TWISTED, needle=THIN)
    base, beta = deployments(TWISTED, 6)
    found = needle_arrivals(mechanics, base, beta, 100.0)
    assert (found.least_determinant > 0.0).all()
    fine = needle_arrivals(mechanics, base, beta, 100.0, stop_mm=0.5)
    assert (found.sweep_mm >= fine.sweep_mm - 0.01).all()
    for m in range(len(beta)):
        tip = float(beta[m, 0] + TWISTED[0].length_mm)
        for at, frames in ((0.0, found.before), (tip, found.arrived), (tip + 100.0, found.after)):
            one = mechanics.given_base_angles(base[m], beta[m], needle_mm=at)
            carried = one.base_from_tip[:3, :3] @ Rotation.from_euler("z", -one.tip_angles_rad[0]).as_matrix()
            assert frames[m, :3, 3] == pytest.approx(one.base_from_tip[:3, 3], abs=1e-6)
            assert frames[m, :3, :3] == pytest.approx(carried, abs=1e-7)
        places = np.linspace(0.0, tip, 40)
        arrived = mechanics.given_base_angles(base[m], beta[m], needle_mm=tip).backbone(places)
        swept = max(
            float(np.linalg.norm(each.backbone(places) - arrived, axis=1).max())
            for each in (
                mechanics.given_base_angles(base[m], beta[m], needle_mm=at) for at in np.linspace(0, tip, 9)
            )
        )
        assert swept <= found.sweep_mm[m] <= 1.3 * swept + 0.1
    assert found.shift_mm == pytest.approx(np.linalg.norm((found.arrived - found.before)[:, :3, 3], axis=1))
    assert found.sweep_after_mm == pytest.approx(0.0, abs=1e-6)  # The whole needle is alike.


def test_a_soft_end_that_leaves_the_tubes_moves_them_after_the_arrival() -> None:
    needle = replace(NEEDLE, slotted_segments=(SOFT_END,))
    beta = np.array([[40.0 - INNER.length_mm]])
    found = needle_arrivals(TubeMechanics([INNER], needle=needle), [[0.0]], beta, 100.0)
    moved = np.linalg.norm((found.after - found.arrived)[:, :3, 3], axis=1)
    assert found.sweep_after_mm >= moved
    assert moved[0] > 1.0
    most = 0.5 * INNER.outer_diameter_mm * INNER.precurvature_per_mm
    assert 0.0 < found.strain[0] < most
    assert 0.0 < found.needle_strain[0] < 0.5 * INNER.precurvature_per_mm


@pytest.mark.parametrize(
    ("needle", "words"),
    [
        (replace(NEEDLE, outer_diameter_mm=1.4), "outer diameter of 1.4"),
        (replace(NEEDLE, length_mm=600.0), "600 mm long"),
        (replace(INNER, outer_diameter_mm=1.0, inner_diameter_mm=0.8, length_mm=800.0), "bent at 1 places"),
    ],
)
def test_needles_that_do_not_fit_are_refused(needle: Tube, words: str) -> None:
    with pytest.raises(SettingsError, match=words):
        TubeMechanics([INNER, OUTER], needle=needle)


def test_needles_that_are_not_there_or_too_short_are_refused() -> None:
    beta = [[40.0 - INNER.length_mm, 10.0 - OUTER.length_mm]]
    with pytest.raises(SettingsError, match="no needle"):
        needle_arrivals(TubeMechanics([INNER, OUTER]), [[0.0, 0.0]], beta, 10.0)
    mechanics = TubeMechanics([INNER, OUTER], needle=NEEDLE)
    with pytest.raises(SettingsError, match="830 mm long"):
        needle_arrivals(mechanics, [[0.0, 0.0]], beta, 800.0)
    with pytest.raises(SettingsError, match="at most 830"):
        mechanics.given_base_angles([0.0, 0.0], beta[0], needle_mm=831.0)


SHAFT = replace(NEEDLE, slotted_segments=(replace(SLOTS, length_mm=250.0),))


@pytest.mark.parametrize(("outer_mm", "inner_mm"), [(0.0, 30.0), (10.0, 38.0), (25.0, 25.0)])
def test_planar_tubes_are_deployed_with_their_needle_as_stiffness_shares_the_bend(
    outer_mm: float, inner_mm: float
) -> None:
    stiff, outer = (float(tube.parts.stiffness_n_mm2[0]) for tube in (INNER, OUTER))
    soft = 0.04 * NEEDLE.bending_stiffness_n_mm2
    tubes, moment = WIDE.with_needle(SHAFT), INNER.precurvature_per_mm * stiff
    assert tubes.overlap_curvature_per_mm == pytest.approx(moment / (stiff + outer + soft), rel=1e-12)
    assert tubes.free_curvature_per_mm == pytest.approx(moment / (stiff + soft), rel=1e-12)
    made = deployed(design_arrays(tubes), [inner_mm, outer_mm], [0.0, 0.0])
    assert made is not None
    expected = [
        (length, kappa)
        for length, kappa in (
            (outer_mm, moment / (stiff + outer + soft)), (inner_mm - outer_mm, moment / (stiff + soft)),
        )
        if length > 0.0
    ]  # fmt: skip
    assert made.arcs[: made.number[0], [0, 2]] == pytest.approx(np.array(expected), rel=1e-12)
    derived = derive_shape(tubes.nested, [0.0, 0.0], [inner_mm, outer_mm], needle=SHAFT)
    assert derived.base_from_tip[:3, 3] == pytest.approx(made.result[TIP + 9 :], abs=2e-6)


def test_twisted_tubes_are_followed_with_their_needle_by_every_road() -> None:
    turned, inserted = np.array([0.0, 1.1]), np.array([40.0, 24.0])
    limits = ShapeLimits(max_lateral_sweep_mm=20.0, max_extension_mm=40.0)
    shapes = tube_shapes(TWISTED, limits, ShapeGrid(stop_mm=8.0, rotations=6), needle=THIN)
    alone = tube_shapes(TWISTED, limits, ShapeGrid(stop_mm=8.0, rotations=6))
    rows = np.flatnonzero((shapes.insertions_mm == [40.0, 24.0]).all(axis=1))
    assert len(rows)
    for m in rows.tolist():
        derived = derive_shape(TWISTED, shapes.rotations_rad[m], shapes.insertions_mm[m], needle=THIN)
        assert derived.base_from_tip[:3, 3] == pytest.approx(shapes.scope_from_tip[m, :3, 3], abs=1e-5)
        assert derived.relative_rad.shape[1] == 1
    assert np.abs(shapes.scope_from_tip[:, :3, 3] - alone.scope_from_tip[:, :3, 3]).max() > 0.1
    around = Neighbourhood.of(TWISTED, inserted, turned, needle=THIN).at(inserted, turned)
    way = deploy(TubeMechanics(TWISTED, needle=THIN), together(TWISTED, turned + BEND_RAD, inserted)).final
    assert around is not None
    assert around.scope_from_tip[:3, 3] == pytest.approx(way.base_from_tip[:3, 3], abs=1e-9)
    derived = derive_shape(TWISTED, turned, inserted, needle=THIN)
    assert derived.base_from_tip[:3, 3] == pytest.approx(way.base_from_tip[:3, 3], abs=1e-5)


def test_a_needle_that_is_inserted_leaves_opposed_tubes_in_the_shape_that_they_came_to() -> None:
    """They have another one, to which the tubes alone lead."""
    tubes = (
        Tube(
            outer_diameter_mm=0.95, inner_diameter_mm=0.8, length_mm=690.0, curved_length_mm=40.0,
            precurvature_per_mm=0.025,
        ),
        Tube(
            outer_diameter_mm=1.2, inner_diameter_mm=1.05, length_mm=640.0, curved_length_mm=25.0,
            precurvature_per_mm=1.0 / 60.0,
        ),
    )  # fmt: skip
    shaft = Tube(outer_diameter_mm=0.6, inner_diameter_mm=0.4, length_mm=840.0, slotted_segments=(SLOTS,))
    turned, out = np.array([0.0, 4.182]), np.array([24.0, 24.0])
    come_to = derive_shape(tubes, turned, out, needle=shaft).base_from_tip[:3, 3]
    for needle_mm in (5.0, 60.0):
        inserted = derive_inserted(tubes, shaft, turned, out, needle_mm)[:3, 3]
        assert inserted == pytest.approx(come_to, abs=1e-4)
    before, arrived = (tip[:3, 3] for tip in derive_arrival(tubes, shaft, turned, out))
    assert before == pytest.approx(derive_shape(tubes, turned, out).base_from_tip[:3, 3], abs=1e-9)
    assert arrived == pytest.approx(come_to, abs=1e-9)
    beta = out - [tube.length_mm for tube in tubes]
    other = derive_loaded(tubes, shaft, turned + BEND_RAD, beta, 84.0).base_from_tip[:3, 3]
    assert np.linalg.norm(other - come_to) > 1.0

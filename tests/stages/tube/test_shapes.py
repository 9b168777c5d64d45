"""Shapes of any design: today's closed form, single deployments by other means, snaps, limits, the cache."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from anatomy.kernels.arcs import normal_on_arc, pose_on_arc
from anatomy.margins import Margins
from anatomy.shafts import SlottedSegment
from stages.tube import (
    BentPiece,
    ConcentricTubes,
    Neighbourhood,
    ShapeGrid,
    ShapeLimits,
    SnapError,
    Tube,
    TubeMechanics,
    deploy,
    deployed,
    design_arrays,
    kernels,
    open_shapes,
    shape_of_arrays,
    together,
    tube_constants,
    tube_shapes,
)
from stages.tube import shapes as shapes_module
from stages.tube.sequences import BEND_RAD
from stages.tube.shapes import SNAPS, STRAINS, SWEEPS, TubeShapes
from tests.stages.tube.closed_form import pieces
from tests.stages.tube.pairs import WIDE

ANY = ShapeLimits(max_lateral_sweep_mm=20.0, max_strain=0.1)
ROUNDING = 1e-9


def tube(number: int, precurvature: float, curved_mm: float = 40.0) -> Tube:
    outer, inner, length = ((1.1, 0.95, 720.0), (1.5, 1.3, 680.0), (1.9, 1.65, 640.0))[number]
    return Tube(
        outer_diameter_mm=outer,
        inner_diameter_mm=inner,
        length_mm=length,
        curved_length_mm=curved_mm if precurvature else 0.0,
        precurvature_per_mm=precurvature,
    )


PAIR = (tube(1, 0.012), tube(2, 0.008))
TRIPLE = (tube(0, 0.02), tube(1, 0.008), tube(2, 0.005))
COARSE = ShapeGrid(stop_mm=5.0, rotations=6)


@pytest.fixture(scope="module")
def planar() -> TubeShapes:
    return tube_shapes((WIDE.inner, WIDE.outer), ANY)


@pytest.fixture(scope="module", params=[PAIR, TRIPLE], ids=["two", "three"])
def curved(request: pytest.FixtureRequest) -> TubeShapes:
    return tube_shapes(request.param, ANY, COARSE)


def tip_of(arcs: np.ndarray) -> np.ndarray:
    """Return the end of a chain of arcs, and the direction there, laid with rotation matrices."""
    frame = np.eye(4)
    for length, direction, curvature, _radius in arcs:
        bend = np.array([math.cos(direction), math.sin(direction), 0.0])
        axis = np.cross([0.0, 0.0, 1.0], bend)
        cross = np.cross(np.eye(3), axis)
        angle = curvature * length
        turn = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
        aside = (1 - math.cos(angle)) / curvature if curvature else 0.0
        ahead = math.sin(angle) / curvature if curvature else length
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = turn, aside * bend + [0.0, 0.0, ahead]
        frame = frame @ step
    return frame


class TestTodaysDesign:
    def test_arcs_are_those_of_the_closed_form(self, planar: TubeShapes) -> None:
        for shape, (inner, outer) in enumerate(planar.insertions_mm):
            wanted = [
                (end - begin, kappa, radius)
                for begin, end, kappa, radius in pieces(WIDE, outer, inner)
                if end > begin + ROUNDING
            ]
            found = planar.arcs_of(shape)
            assert found[:, [0, 2, 3]] == pytest.approx(np.array(wanted), abs=ROUNDING)
            assert found[:, 1] == pytest.approx(0.0, abs=ROUNDING)
        assert planar.arc_error_mm.max() < ROUNDING

    def test_sweep_is_that_of_the_closed_form_and_never_less(self, planar: TubeShapes) -> None:
        constants = tube_constants(WIDE, Margins())
        exact = np.array(
            [kernels.lateral_sweep(constants, outer, inner) for inner, outer in planar.insertions_mm]
        )
        over = planar.lateral_sweep_mm - exact
        assert (over >= -ROUNDING).all() and over.max() < 0.05 * exact.max()
        assert planar.lateral_sweep_mm[exact == 0.0].max() == 0.0
        assert (planar.follow_the_leader_error_mm <= planar.lateral_sweep_mm + ROUNDING).all()

    def test_all_insertions_within_the_limits_are_there(self) -> None:
        found = tube_shapes((WIDE.inner, WIDE.outer), ShapeLimits(max_extension_mm=40.0))
        assert found.count == found.candidates == 21 * 22 // 2 - 1 and not found.refused
        assert found.strain == pytest.approx(WIDE.inner.rest_strain)
        assert found.least_determinant == pytest.approx(1.0)


class TestCurvedTubes:
    def test_deployments_one_by_one(self, curved: TubeShapes) -> None:
        mechanics = TubeMechanics(curved.tubes)
        for shape in np.random.default_rng(1).integers(0, curved.count, 5):
            turned = curved.rotations_rad[shape] + BEND_RAD
            sequence = together(curved.tubes, turned, curved.insertions_mm[shape])
            done = deploy(mechanics, sequence)
            tip = curved.scope_from_tip[shape]
            assert tip[:3, 2:] == pytest.approx(done.final.base_from_tip[:3, 2:], abs=1e-9)
            assert curved.lateral_sweep_mm[shape] >= done.lateral_sweep_mm - 1e-3
            assert curved.lateral_sweep_mm[shape] <= 1.3 * done.lateral_sweep_mm + 0.2
            assert curved.least_determinant[shape] == pytest.approx(done.least_determinant, abs=0.02)

    def test_arcs_stay_within_their_stated_error(self, curved: TubeShapes) -> None:
        assert 1e-4 < curved.arc_error_mm.max() < 0.05
        mechanics = TubeMechanics(curved.tubes)
        for shape in np.argsort(curved.arc_error_mm)[-3:]:
            turned = curved.rotations_rad[shape] + BEND_RAD
            there = deploy(mechanics, together(curved.tubes, turned, curved.insertions_mm[shape])).final
            arcs = curved.arcs_of(shape)
            at = np.linspace(0.0, arcs[:, 0].sum(), 200)
            strayed = np.linalg.norm(there.backbone(at) - [point_at(arcs, s) for s in at], axis=1)
            assert 0.1 * curved.arc_error_mm[shape] < strayed.max() <= curved.arc_error_mm[shape]

    def test_strain_is_at_least_that_of_straight_tubes_in_the_scope(self, curved: TubeShapes) -> None:
        assert (curved.strain >= max(each.rest_strain for each in curved.tubes)).all()


def point_at(arcs: np.ndarray, at_mm: float) -> np.ndarray:
    """Return the point of a chain of arcs at an arc length."""
    before = np.concatenate([[0.0], np.cumsum(arcs[:, 0])])
    cut = arcs.copy()
    cut[:, 0] = np.clip(at_mm - before[:-1], 0.0, arcs[:, 0])
    return tip_of(cut)[:3, 3]


def near(shapes: TubeShapes, shape: int) -> Neighbourhood:
    return Neighbourhood(
        TubeMechanics(shapes.tubes), shapes.insertions_mm[shape], shapes.rotations_rad[shape],
        shapes.tip_angles_rad[shape],
    )  # fmt: skip


class TestBetween:
    def test_joint_values_between_stops(self, curved: TubeShapes) -> None:
        mechanics = TubeMechanics(curved.tubes)
        rng = np.random.default_rng(2)
        long = np.flatnonzero(curved.insertions_mm.min(axis=1) > 5.0)
        for shape in rng.choice(long, 4, replace=False):
            step = np.sort(rng.uniform(-2.0, 2.0, len(curved.tubes)))[::-1]
            out = curved.insertions_mm[shape] + step
            turned = curved.rotations_rad[shape] + rng.uniform(-0.3, 0.3, len(curved.tubes))
            found = near(curved, shape).at(out, turned)
            done = deploy(mechanics, together(curved.tubes, turned + BEND_RAD, out)).final
            assert found is not None
            assert found.scope_from_tip[:3, 2:] == pytest.approx(done.base_from_tip[:3, 2:], abs=1e-8)
            assert found.arcs[:, 0].sum() == pytest.approx(out[0])
            off = np.linalg.norm(tip_of(found.arcs)[:3, 3] - found.scope_from_tip[:3, 3])
            assert off <= found.arc_error_mm < 0.05

    def test_the_same_joint_values_are_the_shape(self, curved: TubeShapes) -> None:
        found = near(curved, 40).at(curved.insertions_mm[40], curved.rotations_rad[40])
        assert found is not None and found.arcs == pytest.approx(curved.arcs_of(40), abs=1e-9)

    @pytest.mark.slow
    def test_the_whole_way_is_that_of_the_grid(self) -> None:
        made = tube_shapes(PAIR, ShapeLimits(max_extension_mm=20.0), ShapeGrid(stop_mm=2.0, rotations=6))
        limits = made.limits
        design = design_arrays(
            ConcentricTubes(
                inner=PAIR[0], outer=PAIR[1], max_extension_mm=limits.max_extension_mm,
                max_lateral_sweep_mm=limits.max_lateral_sweep_mm, max_strain=limits.max_strain,
            )
        )  # fmt: skip
        for member in range(3, made.count, 17):
            found = deployed(design, made.insertions_mm[member], made.rotations_rad[member])
            assert found is not None
            one, other = shape_of_arrays(found), made.member(member)
            assert one.arcs == pytest.approx(other.arcs, abs=1e-9)
            assert one.lateral_sweep_mm == pytest.approx(other.lateral_sweep_mm, abs=1e-9)
            assert one.least_determinant == pytest.approx(other.least_determinant, abs=1e-9)
        assert deployed(design, np.array([20.0, 21.0]), np.zeros(2)) is None
        tight = design._replace(limits=design.limits * np.where(np.arange(6) == 4, 1e-6, 1.0))
        assert deployed(tight, np.array([18.0, 7.0]), np.array([0.0, 1.0])) is None

    def test_impossible_joint_values(self, curved: TubeShapes) -> None:
        n = len(curved.tubes)
        with pytest.raises(SettingsError, match="ahead of one in it"):
            near(curved, 0).at(np.arange(1.0, n + 1.0), np.zeros(n))
        with pytest.raises(SettingsError, match="rotations"):
            near(curved, 0).at(np.ones(n), np.full(n, np.nan))


def test_single_tube_bends_towards_x() -> None:
    found = tube_shapes((tube(1, 0.02),), ANY, COARSE)
    assert found.count == 12 and (found.rotations_rad == 0.0).all()
    pose, normal = (0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0)
    assert found.insertions_mm[7, 0] == 40.0
    pose = pose_on_arc(pose, (0.02, *normal), 40.0)
    assert found.scope_from_tip[7, :3, 3] == pytest.approx(pose[:3])
    assert found.scope_from_tip[7, :3, 0] == pytest.approx(
        normal_on_arc((0, 0, 0, 0, 0, 1.0), (0.02, *normal), 40.0)
    )


def test_rotations_of_two_bent_tubes_are_mirror_images() -> None:
    found = tube_shapes(PAIR, ANY, COARSE)
    of = {
        (*ins, round(math.degrees(rot[1])) % 360): n
        for n, (ins, rot) in enumerate(zip(found.insertions_mm, found.rotations_rad, strict=True))
    }
    one, other = of[(40.0, 20.0, 60)], of[(40.0, 20.0, 300)]
    mirrored = found.scope_from_tip[one, :3, 3] * [1.0, -1.0, 1.0]
    assert found.scope_from_tip[other, :3, 3] == pytest.approx(mirrored, abs=1e-9)
    assert abs(mirrored[1]) > 0.5


def test_snapping_deployments_are_refused_as_single_ones_are() -> None:
    """A tube of two bends snaps where the second leaves the scope."""
    pieces = (
        BentPiece(length_mm=34.0, precurvature_per_mm=0.041),
        BentPiece(length_mm=24.0, precurvature_per_mm=0.018, direction_deg=195.0),
    )
    inner = Tube(outer_diameter_mm=1.5, inner_diameter_mm=1.3, length_mm=680.0, bent_pieces=pieces)
    tubes = (inner, tube(2, 0.022, curved_mm=39.0))
    grid = ShapeGrid(stop_mm=5.0, rotations=24)
    found = tube_shapes(tubes, ANY, grid)
    degrees = np.round(np.degrees(found.rotations_rad[:, 1])).astype(int)
    kept = {(*out, turn) for out, turn in zip(found.insertions_mm, degrees, strict=True)}
    mechanics, verdicts = TubeMechanics(tubes), []
    for turn, out in ((0, 10.0), (75, 20.0), (75, 60.0), (180, 20.0)):
        try:
            deploy(mechanics, together(tubes, (BEND_RAD, BEND_RAD + math.radians(turn)), (out, out)))
        except SnapError:
            verdicts.append(False)
        else:
            verdicts.append(True)
        assert ((out, out, turn) in kept) == verdicts[-1]
    assert len(set(verdicts)) == 2


def test_where_two_ways_are_as_good_the_deployment_is_refused() -> None:
    tubes = (tube(1, 0.02), tube(2, 0.02))
    found = tube_shapes(tubes, ANY, ShapeGrid(stop_mm=5.0, rotations=2))
    opposed = found.rotations_rad[:, 1] > 0.0
    assert (found.insertions_mm[opposed, 1] == 0.0).all() and found.refused[SNAPS] > 5
    assert found.insertions_mm[~opposed, 1].max() == 60.0


def test_limits_count_what_they_refuse() -> None:
    tight = tube_shapes(PAIR, ShapeLimits(max_lateral_sweep_mm=0.5, max_strain=0.0095), COARSE)
    every = tube_shapes(PAIR, ANY, COARSE)
    assert tight.lateral_sweep_mm.max() <= 0.5 and tight.strain.max() <= 0.0095
    assert tight.refused[SWEEPS] > 0 and tight.refused[STRAINS] > 0
    assert tight.count + sum(tight.refused.values()) == tight.candidates == every.candidates


def test_bad_designs_are_explained() -> None:
    with pytest.raises(SettingsError, match="4 tubes"):
        tube_shapes((tube(0, 0.0), tube(1, 0.0), tube(2, 0.0), tube(2, 0.0)))
    with pytest.raises(SettingsError, match="outer diameter"):
        tube_shapes((tube(2, 0.0), tube(1, 0.0)))


def test_equal_slots_change_strain_alone_and_twisted_slots_are_refused() -> None:
    slots = (SlottedSegment(length_mm=200.0, stiffness_factor=0.04, strain_factor=0.75),)
    plain = (WIDE.inner, WIDE.outer)
    slotted = tuple(dataclasses.replace(each, slotted_segments=slots) for each in plain)
    one, other = (tube_shapes(tubes, ANY, COARSE) for tubes in (plain, slotted))
    np.testing.assert_allclose(one.arcs, other.arcs, atol=1e-12)
    assert other.strain == pytest.approx(0.75 * one.strain)
    for tubes in (
        (slotted[0], plain[1]),
        tuple(dataclasses.replace(each, slotted_segments=slots) for each in PAIR),
    ):
        with pytest.raises(SettingsError, match="have slots"):
            tube_shapes(tubes, ANY, COARSE)


def test_shapes_are_kept_by_design(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = open_shapes(PAIR, ANY, COARSE, cache=tmp_path)
    (path,) = tmp_path.iterdir()
    other = open_shapes(PAIR, ANY, ShapeGrid(stop_mm=10.0, rotations=6), cache=tmp_path)
    assert other.count < made.count and len(list(tmp_path.iterdir())) == 2

    def refuse(*_: object) -> None:
        raise AssertionError("made anew")

    with monkeypatch.context() as patch:
        patch.setattr(shapes_module, "_follow", refuse)
        again = open_shapes(PAIR, ANY, COARSE, cache=tmp_path)
    assert np.array_equal(again.arcs, made.arcs) and again.refused == made.refused
    assert again.tubes == made.tubes and again.grid == COARSE
    path.write_bytes(b"damaged")
    assert np.array_equal(open_shapes(PAIR, ANY, COARSE, cache=tmp_path).arcs, made.arcs)

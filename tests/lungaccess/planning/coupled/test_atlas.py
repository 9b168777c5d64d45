"""The deployment atlas of a small synthetic patient."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from anatomy.lung import Lung
from anatomy.structures import FISSURE, LUMEN, OBSTACLES, OUTSIDE, VESSEL
from stages.tube import DEFAULT_ROTATIONS, REASONS, coarser_shapes, enumerate_deployments, kernels, shapes_of
from tests.lungaccess.planning.coupled.planning import SYSTEM
from tests.stages.scenes import brute_clearance
from tests.stages.tube.closed_form import centreline

COARSE: dict[str, Any] = {"rotations": 9, "stop_spacing_mm": 4.0, "site_spacing_mm": 3.0}


@pytest.fixture(scope="module")
def coarse(small_lung: Lung) -> la.Atlas:
    return la.build_atlas(small_lung, SYSTEM, **COARSE)


def test_counts_add_up(atlas: la.Atlas) -> None:
    shapes = shapes_of(SYSTEM.tubes)
    found = atlas.deployments
    turned = int(atlas.motions.turned.sum())
    fewer = coarser_shapes(shapes, 4.0)[1].count
    even = (atlas.motions.count - turned) * DEFAULT_ROTATIONS * shapes.count
    even += turned * (DEFAULT_ROTATIONS // 2) * fewer
    assert even < found.candidates < 2 * even
    assert found.count + sum(found.refused.values()) == found.candidates
    assert found.count > 5000 and atlas.motions.count > 50
    assert atlas.build_s > 0.0


def test_deployments_index_the_tips(atlas: la.Atlas, small_lung: Lung) -> None:
    motions, tree = atlas.motions, small_lung.tree
    assert found_sites(atlas) <= set(range(motions.count))
    for site in (0, motions.count - 1):
        away = np.linalg.norm(tree.points_lps - motions.tips[site, :3], axis=1)
        assert away[motions.tree_point[site]] == away.min()
        tip = motions.tip(site)
        assert np.allclose(tip.motion.lps_from_tip, tip.lps_from_scope_tip, atol=1e-9)
    assert (np.diff(atlas.deployments.site) >= 0).all()


def test_the_body_keeps_the_curvature_of_the_channel(atlas: la.Atlas) -> None:
    for site in range(0, atlas.motions.count, 40):
        body = atlas.motions.motion(site).max_curvature_per_mm
        assert body == pytest.approx(float(atlas.motions.max_curvature_per_mm[site]), abs=1e-9)


def found_sites(atlas: la.Atlas) -> set[int]:
    return set(atlas.deployments.site.tolist())


def test_tubes_are_clear_behind_the_exit(atlas: la.Atlas, small_lung: Lung) -> None:
    """Against distances to every voxel, for deployments drawn from all of them."""
    from anatomy.poses import pose

    found, tubes, margin = atlas.deployments, SYSTEM.tubes, SYSTEM.margins.total_mm
    for n in np.random.default_rng(0).choice(found.count, 60, replace=False):
        site = atlas.motions.tips[found.site[n]]
        outer, inner = float(found.outer_mm[n]), float(found.inner_mm[n])
        s = np.linspace(0.0, inner, round(inner / 0.05) + 1)
        points = centreline(
            tubes, pose(site[:3], site[3:6], site[6:]), float(found.rotation_rad[n]), outer, inner, s
        )
        assert np.allclose(points[-1], found.positions[n], atol=1e-9)
        behind = s > found.exit_mm[n]
        radius = np.where(s[behind] < outer, tubes.outer.radius_mm, tubes.inner.radius_mm)
        gap = brute_clearance(
            small_lung.labels, small_lung.grid, points[behind], OBSTACLES | FISSURE, 2.5, int(found.branch[n])
        )
        assert (gap >= radius + margin - 1e-9).all()
        labels = small_lung.labels[tuple(np.rint(small_lung.grid.ijk(points)).astype(int).T)]
        dry = (labels & LUMEN) == 0
        # Of three samples in a row, 0.1 mm, one is in the lumen before the exit: corners of voxels at most.
        assert not (dry[2:] & dry[1:-1] & dry[:-2])[s[2:] < found.exit_mm[n]].any()
        assert dry[s > found.exit_mm[n] + 0.02].all()


@pytest.mark.slow
def test_no_tube_leaves_trachea_or_main_bronchi(atlas: la.Atlas, small_lung: Lung) -> None:
    """They lie in the mediastinum, whatever the masks hold beside them; nothing else is lost by that."""
    tree, free = small_lung.tree, replace(small_lung.tree)
    assert tree.mediastinal.tolist() == (tree.generation <= 1).tolist()
    vars(free)["mediastinal"] = np.zeros(tree.n_branches, dtype=bool)

    def enumerated(lung: Lung) -> tuple[set[tuple[float, ...]], set[tuple[float, ...]]]:
        """Return the deployments from the first sites at whole steps, those through the mediastinum apart."""
        tips = atlas.motions.tips[:150]
        found = enumerate_deployments(
            lung, SYSTEM.tubes, SYSTEM.margins, tips, with_fissures=True, rotations=8
        )
        columns = (found.branch, found.site, found.rotation_rad, found.outer_mm, found.inner_mm)
        rows = np.stack(columns, axis=1)[np.isclose(found.rotation_rad % (np.pi / 4), 0.0)]
        central = tree.mediastinal[rows[:, 0].astype(int)]
        return {tuple(row) for row in rows[central]}, {tuple(row) for row in rows[~central]}

    central, peripheral = enumerated(replace(small_lung, tree=free))
    assert len(central) > 20 and len(peripheral) > 20
    assert enumerated(small_lung) == (set(), peripheral)
    assert atlas.deployments.refused[REASONS[kernels.LEAVES_MEDIASTINAL]] > 0


def test_the_same_atlas_twice(coarse: la.Atlas, small_lung: Lung) -> None:
    again = la.build_atlas(small_lung, SYSTEM, **COARSE)
    assert np.array_equal(again.deployments.positions, coarse.deployments.positions)
    assert again.deployments.refused == coarse.deployments.refused


@pytest.mark.slow
def test_fissures(coarse: la.Atlas, small_lung: Lung) -> None:
    assert small_lung.has_fissures and coarse.with_fissures
    allowed = la.build_atlas(small_lung, replace(SYSTEM, fissures_allowed=True), **COARSE)
    assert not allowed.with_fissures
    assert allowed.deployments.count > coarse.deployments.count
    fields = {name: field for name, field in small_lung.fields.items() if "fissure" not in name}
    assert not la.build_atlas(replace(small_lung, fields=fields), SYSTEM, **COARSE).with_fissures


def test_finer_is_more(atlas: la.Atlas, coarse: la.Atlas) -> None:
    assert 0 < coarse.deployments.count < 0.2 * atlas.deployments.count
    assert coarse.motions.count < 0.7 * atlas.motions.count


def test_a_scope_too_thick(small_lung: Lung) -> None:
    atlas = la.build_atlas(
        small_lung,
        replace(
            SYSTEM,
            scope=replace(
                SYSTEM.scope, outer_diameter_mm=15.0, min_bending_radius_mm=20.0, min_shaft_radius_mm=20.0
            ),
        ),
    )
    assert atlas.motions.count == atlas.deployments.count == atlas.deployments.candidates == 0
    assert not atlas.motions.passages.passable.any()


@pytest.mark.slow
def test_progress(small_lung: Lung) -> None:
    told: list[float] = []
    la.build_atlas(small_lung, SYSTEM, **COARSE, progress=told.append)
    assert told and all(0.0 < share <= 1.0 for share in told)


def test_further_rotations_lie_between_unlike_ones_and_only_there(atlas: la.Atlas, small_lung: Lung) -> None:
    """Against an enumeration at all of them."""
    tips = atlas.motions.tips[~atlas.motions.turned][:40]
    tubes, margins, turn = SYSTEM.tubes, SYSTEM.margins, 2 * np.pi

    def enumerated(rotations: int) -> dict[tuple[int, float], set[tuple[float, float]]]:
        found = enumerate_deployments(
            small_lung, tubes, margins, tips, with_fissures=True, rotations=rotations
        )
        sets: dict[tuple[int, float], set[tuple[float, float]]] = {}
        for n in range(found.count):
            key = int(found.site[n]), round(float(found.rotation_rad[n]), 9)
            sets.setdefault(key, set()).add((float(found.outer_mm[n]), float(found.inner_mm[n])))
        return sets

    coarse, fine = enumerated(12), enumerated(24)
    added = 0
    for site in range(len(tips)):
        for step in range(12):
            here, next_one = ((site, round(k % 12 * turn / 12, 9)) for k in (step, step + 1))
            between = site, round((step + 0.5) * turn / 12, 9)
            unlike = coarse.get(here, set()) != coarse.get(next_one, set())
            assert coarse.get(here, set()) == fine.get(here, set())
            assert coarse.get(between, set()) == (fine.get(between, set()) if unlike else set())
            added += between in coarse
    assert added > 10


def test_exits_are_clear_by_every_voxel(atlas: la.Atlas, small_lung: Lung) -> None:
    tips = atlas.deployments.positions
    bits = FISSURE | VESSEL | OUTSIDE if atlas.with_fissures else VESSEL | OUTSIDE
    some = np.random.default_rng(0).choice(len(tips), 60, replace=False)
    required = SYSTEM.tubes.inner.radius_mm + SYSTEM.margins.total_mm
    for entry in some:
        assert required <= float(
            brute_clearance(small_lung.labels, small_lung.grid, tips[[entry]], bits, 12.0)[0]
        )

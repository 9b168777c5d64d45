"""The deployment atlas of a small synthetic patient."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import lungaccess as la
from anatomy.lung import Lung
from anatomy.structures import FISSURE, LUMEN, OBSTACLES
from stages.tube.deployments import LEAVES_TRACHEA, TRACHEA, _without_trachea, insertion_stops
from stages.tube.shape import centreline
from tests.stages.scenes import brute_clearance

SYSTEM = la.load_system("ultrathin")


@pytest.fixture(scope="module")
def atlas(small_lung: Lung) -> la.Atlas:
    return la.build_atlas(small_lung, SYSTEM)


def test_counts_add_up(atlas: la.Atlas) -> None:
    stops = len(insertion_stops(SYSTEM.tubes))
    found = atlas.deployments
    turned = int(atlas.sites.turned.sum())
    fewer = len(insertion_stops(SYSTEM.tubes, 4.0))
    assert found.candidates == (
        (atlas.sites.count - turned) * 36 * (stops * (stops + 1) // 2 - 1)
        + turned * 18 * (fewer * (fewer + 1) // 2 - 1)
    )
    assert found.count + sum(found.refused.values()) == found.candidates
    assert found.count > 5000 and atlas.sites.count > 50
    assert atlas.build_s > 0.0


def test_sites_index_the_tree(atlas: la.Atlas, small_lung: Lung) -> None:
    assert found_sites(atlas) <= set(range(atlas.sites.count))
    for site in (0, atlas.sites.count - 1):
        assert np.array_equal(
            atlas.site_pose(site)[:3], small_lung.tree.points_lps[atlas.sites.tree_point[site]]
        )
    assert (np.diff(atlas.deployments.site) >= 0).all()


def found_sites(atlas: la.Atlas) -> set[int]:
    return set(atlas.deployments.site.tolist())


def test_tubes_are_clear_behind_the_exit(atlas: la.Atlas, small_lung: Lung) -> None:
    """Against distances to every voxel, for deployments drawn from all of them."""
    from anatomy.poses import pose

    found, tubes, margin = atlas.deployments, SYSTEM.tubes, SYSTEM.margins.total_mm
    for n in np.random.default_rng(0).choice(found.count, 60, replace=False):
        site = atlas.site_pose(int(found.site[n]))
        outer, inner = float(found.outer_mm[n]), float(found.inner_mm[n])
        s = np.linspace(0.0, inner, round(inner / 0.05) + 1)
        points = centreline(tubes, pose(site[:3], site[3:]), float(found.rotation_rad[n]), outer, inner, s)
        assert np.allclose(points[-1], found.positions[n], atol=1e-9)
        behind = s > found.exit_mm[n]
        radius = np.where(s[behind] < outer, tubes.outer.radius_mm, tubes.inner.radius_mm)
        gap = brute_clearance(
            small_lung.labels, small_lung.grid, points[behind], OBSTACLES | FISSURE, 2.5, int(found.branch[n])
        )
        assert (gap >= radius + margin - 1e-9).all()
        labels = small_lung.labels[tuple(np.rint(small_lung.grid.ijk(points)).astype(int).T)]
        assert (labels[s < found.exit_mm[n] - 0.2] & LUMEN).all()
        assert not (labels[s > found.exit_mm[n] + 1.0] & LUMEN).any()


def test_no_tube_leaves_the_trachea(atlas: la.Atlas) -> None:
    """It lies in the mediastinum, whatever the masks hold beside it."""
    entries = atlas.deployments
    through = np.arange(entries.count) % 3 == 0
    some = replace(entries, branch=np.where(through, TRACHEA, entries.branch))
    kept = _without_trachea(some)
    assert (atlas.deployments.branch != TRACHEA).all()
    assert np.array_equal(kept.positions, entries.positions[~through])
    assert kept.refused[LEAVES_TRACHEA] == through.sum()


def test_the_same_atlas_twice(atlas: la.Atlas, small_lung: Lung) -> None:
    again = la.build_atlas(small_lung, SYSTEM)
    assert np.array_equal(again.deployments.positions, atlas.deployments.positions)
    assert again.deployments.refused == atlas.deployments.refused


def test_fissures(atlas: la.Atlas, small_lung: Lung) -> None:
    assert small_lung.has_fissures and atlas.with_fissures
    allowed = la.build_atlas(small_lung, replace(SYSTEM, fissures_allowed=True))
    assert not allowed.with_fissures
    assert allowed.deployments.count > atlas.deployments.count
    fields = {name: field for name, field in small_lung.fields.items() if "fissure" not in name}
    assert not la.build_atlas(replace(small_lung, fields=fields), SYSTEM, rotations=2).with_fissures


def test_finer_is_more(atlas: la.Atlas, small_lung: Lung) -> None:
    coarse = la.build_atlas(small_lung, SYSTEM, rotations=9, stop_spacing_mm=4.0, site_spacing_mm=3.0)
    assert 0 < coarse.deployments.count < 0.2 * atlas.deployments.count
    assert coarse.sites.count < 0.6 * atlas.sites.count


def test_a_scope_too_thick(small_lung: Lung) -> None:
    atlas = la.build_atlas(small_lung, replace(SYSTEM, scope=replace(SYSTEM.scope, outer_diameter_mm=15.0)))
    assert atlas.sites.count == atlas.deployments.count == atlas.deployments.candidates == 0
    assert not atlas.sites.passable.any()


def test_progress(small_lung: Lung) -> None:
    told: list[float] = []
    la.build_atlas(small_lung, SYSTEM, rotations=1, progress=told.append)
    assert told and all(0.0 < share <= 1.0 for share in told)

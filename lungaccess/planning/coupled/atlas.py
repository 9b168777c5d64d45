"""The deployment atlas: everything scope and tubes can do, enumerated once per patient and system."""

import os
import time
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, TypedDict, Unpack

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.settings import to_mapping
from anatomy.base.typed import Bool, Int
from anatomy.kept_records import kept_record, record_path
from anatomy.lung import Lung
from anatomy.machine_code.sources import kernel_digest
from anatomy.morphology import bounds
from anatomy.structures import FISSURE, VESSEL
from lungaccess.problem.channel import bends_with_tubes_rad
from lungaccess.problem.system import System
from lungaccess.problem.task import fissures_are_obstacles
from stages.needle import StartIndex
from stages.scope import ScopeMotions, find_motions, prover_of
from stages.tube import (
    DEFAULT_ROTATIONS,
    DEFAULT_STOP_MM,
    Deployments,
    enumerate_deployments,
    join_deployments,
    longest_mm,
    shapes_at_hand,
    shapes_digest,
)

TIP_SPACING_MM = 1.0
"""A free choice: local search and local sampling cover with the tubes what lies between two tips."""
TURNED_COARSER = 2
"""By this factor deployments from turned tips have fewer rotations and stops: their directions are many."""


@frozen_record
class Atlas:
    """All accepted deployments of a system in a lung; independent of any target and of the needle.

    The `site` of a deployment is a tip of `motions`, each of which has a proved motion; `index`, made from
    the deployments, finds those with a target in the needle's workspace, for any needle.
    """

    lung: Lung
    system: System
    with_fissures: bool
    motions: ScopeMotions
    deployments: Deployments
    index: StartIndex
    build_s: float


def require_same(atlas: Atlas, lung: Lung, system: System) -> None:
    """Raise SettingsError unless an atlas holds for a lung and a system, whatever the needle does."""
    if atlas.lung.key != lung.key or not _is_of_devices(atlas, lung, system):
        raise SettingsError(
            f"The atlas was made for {atlas.lung.name} and {atlas.system.name}",
            expected=f"one for {lung.name} and {system.name}, with the same masks, scope, tubes and margins",
            remedy="Make it with build_atlas(lung, system)",
        )


def _is_of_devices(atlas: Atlas, lung: Lung, system: System) -> bool:
    """Tell whether an atlas was made for the devices of a system, and what is an obstacle for them."""
    made = atlas.system
    same = (made.scope, made.tubes, made.margins) == (system.scope, system.tubes, system.margins)
    return same and atlas.with_fissures == fissures_are_obstacles(lung, system)


def atlas_part(atlas: Atlas, entries: Int) -> Atlas:
    """Return an atlas with some of the deployments of another, by their numbers `(N,)`.

    A search over it begins from these alone: a plan from a chosen exit, or from a chosen tip of the scope.
    """
    found = atlas.deployments.only(np.asarray(entries, dtype=np.int64))
    return replace(atlas, deployments=found, index=StartIndex(found.positions, found.tangents))


def motions_of(lung: Lung, system: System, spacing_mm: float = TIP_SPACING_MM) -> ScopeMotions:
    """Return the motions of the scope to tips at which the tubes of a system can leave the airway.

    `spacing_mm` is that of the tips along the airway.
    """
    return find_motions(
        lung,
        system.scope,
        reach_mm=longest_mm(system.tubes),
        max_curvature_per_mm=system.tubes.channel_curvature_per_mm,
        tip_bends_rad=bends_with_tubes_rad(system),
        spacing_mm=spacing_mm,
    )


class AtlasGrid(TypedDict, total=False):
    """How densely deployments are enumerated; see `build_atlas`."""

    rotations: int
    stop_spacing_mm: float
    site_spacing_mm: float


def build_atlas(
    lung: Lung,
    system: System,
    *,
    rotations: int = DEFAULT_ROTATIONS,
    stop_spacing_mm: float = DEFAULT_STOP_MM,
    site_spacing_mm: float = TIP_SPACING_MM,
    progress: Callable[[float], None] | None = None,
    before: Atlas | None = None,
) -> Atlas:
    """Find the motions of the scope, enumerate rotations and insertions at their tips, and keep what is safe.

    Rotations are spaced evenly, with further ones where tube or exit is near a limit; `site_spacing_mm` is
    the spacing of scope tips along the airway.  `before` is an atlas with the same
    settings in the same patient, of which a person has corrected the masks since: what lies beyond the reach
    of the change is taken from it.
    """
    began = time.perf_counter()
    with_fissures = fissures_are_obstacles(lung, system)
    same = before is not None and _has_same_airway(before, lung, system)
    motions = before.motions if before is not None and same else motions_of(lung, system, site_spacing_mm)
    straight = int((~motions.turned).sum())
    anew: Int = np.arange(motions.count)
    if before is not None and same:
        anew = np.flatnonzero(_within_reach_of_change(before, lung, motions))
    first = int(np.count_nonzero(anew < straight))
    share = first / max(len(anew), 1)
    tell = progress or (lambda _share: None)

    def enumerated(sites: Int, rotations: int, spacing_mm: float, begin: float, end: float) -> Deployments:
        return enumerate_deployments(
            lung,
            system.tubes,
            system.margins,
            motions.tips[sites],
            with_fissures=with_fissures,
            rotations=rotations,
            stop_spacing_mm=spacing_mm,
            progress=lambda done: tell(begin + done * (end - begin)),
        )

    found = enumerated(anew[:first], rotations, stop_spacing_mm, 0.0, share)
    if first < len(anew):
        # Tips turned aside look in so many directions that each of them needs fewer rotations and stops.
        coarse = max(1, rotations // TURNED_COARSER), stop_spacing_mm * TURNED_COARSER
        found = join_deployments(found, enumerated(anew[first:], *coarse, share, 1.0), first)
    if before is not None and same:
        found = before.deployments.with_sites(anew, found)
    return Atlas(
        lung=lung,
        system=system,
        with_fissures=with_fissures,
        motions=motions,
        deployments=found,
        index=StartIndex(found.positions, found.tangents),
        build_s=time.perf_counter() - began,
    )


FORMAT = 12
"""Raise it when the enumeration changes: stored atlases of another format are made anew."""


@frozen_record
class _StoredAtlas:
    """The fields of an `Atlas` that are kept: the others are at hand, or follow from them."""

    with_fissures: bool
    motions: ScopeMotions
    deployments: Deployments
    build_s: float


def atlas_format() -> str:
    """Return what tells atlases of this version and these kernels from all others."""
    return (
        f"{FORMAT}-{kernel_digest('anatomy', 'stages.scope', 'stages.tube', 'lungaccess.planning.coupled')}"
    )


def open_atlas(
    lung: Lung,
    system: System,
    *,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[float], None] | None = None,
    before: Atlas | None = None,
    **grid: Unpack[AtlasGrid],
) -> Atlas:
    """Return the atlas from the cache, or make and keep it.

    A system with another needle finds the same file, unless another shaft lies in the tubes.  Parameters and
    errors are those of `lungaccess.planning.coupled.atlas.build_atlas` and, for the cache, of
    `anatomy.kept_records.kept_record`.
    """
    prover_of(lung, system.scope)  # Here: the first plan does not wait for it.
    depends_on = _depends_on(lung, system, **grid)

    def make() -> _StoredAtlas:
        made = build_atlas(lung, system, progress=progress, before=before, **grid)
        return _StoredAtlas(**{each.name: getattr(made, each.name) for each in fields(_StoredAtlas)})

    what = "atlas", atlas_format(), depends_on, _StoredAtlas
    in_use = () if lung.folder is None else (lung.folder,)
    stored = kept_record(*what, make=make, cache=cache, name=lung.name, in_use=in_use)
    index = StartIndex(stored.deployments.positions, stored.deployments.tangents)
    return Atlas(lung=lung, system=system, index=index, **vars(stored))


def atlas_is_kept(
    lung: Lung, system: System, *, cache: str | os.PathLike[str] | None = None, **grid: Unpack[AtlasGrid]
) -> bool:
    """Tell whether `open_atlas` finds an atlas in the cache; the file is not read, so it may be damaged.

    Where the shapes of its tubes are not at hand it counts as not kept: its file is named by them.
    """
    if not shapes_at_hand(system.tubes):
        return False
    return record_path("atlas", atlas_format(), _depends_on(lung, system, **grid), cache).is_file()


def _depends_on(lung: Lung, system: System, **grid: Unpack[AtlasGrid]) -> dict[str, Any]:
    return {
        "lung": lung.key,
        "scope": to_mapping(system.scope),
        "tubes": to_mapping(system.tubes),
        "needle": None if system.tubes.needle_shaft is None else to_mapping(system.tubes.needle_shaft),
        "margins": to_mapping(system.margins),
        "shapes": shapes_digest(system.tubes),
        "with_fissures": fissures_are_obstacles(lung, system),
        "rotations": grid.get("rotations", DEFAULT_ROTATIONS),
        "stop_mm": grid.get("stop_spacing_mm", DEFAULT_STOP_MM),
        "site_mm": grid.get("site_spacing_mm", TIP_SPACING_MM),
    }


def _has_same_airway(before: Atlas, lung: Lung, system: System) -> bool:
    """Tell whether airways and pleura are those of an atlas that was made for the same devices."""
    old, airway = before.lung, ~np.uint16(VESSEL | FISSURE)
    return (
        _is_of_devices(before, lung, system)
        and np.array_equal(old.grid.lps_from_ijk, lung.grid.lps_from_ijk)
        and np.array_equal(old.labels & airway, lung.labels & airway)
        and np.array_equal(old.lumen_depth.corners, lung.lumen_depth.corners)
        and np.array_equal(old.lumen_depth.geometry, lung.lumen_depth.geometry)
    )


def _within_reach_of_change(before: Atlas, lung: Lung, motions: ScopeMotions) -> Bool:
    """Return from which scope tips `(S,)` tubes come to places where labels or clearance have changed."""
    fields = (each.obstacle_field(with_fissures=before.with_fissures).corners for each in (before.lung, lung))
    boxes = [bounds(np.not_equal(*fields)), bounds(before.lung.labels != lung.labels)]
    boxes = [(low, high) for low, high in boxes if (low < high).all()]
    if not boxes:
        return np.zeros(motions.count, dtype=np.bool_)
    low = np.min([each for each, _ in boxes], axis=0)
    high = np.max([each for _, each in boxes], axis=0)
    tips = lung.grid.ijk(motions.tips[:, :3])
    spacing = lung.grid.spacing_mm
    # Beyond a tube no more than the corners of the voxel around a point are looked at.
    reach_mm = longest_mm(before.system.tubes) + 2.0 * float(np.linalg.norm(spacing))
    away = np.maximum(np.maximum(low - 0.5 - tips, tips - high + 0.5), 0.0) * spacing
    return np.asarray(np.linalg.norm(away, axis=1) <= reach_mm)

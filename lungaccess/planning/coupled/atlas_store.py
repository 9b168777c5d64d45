"""Deployment atlases on disk: one file per lung, scope, tubes and margins, whatever the needle."""

import os
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from anatomy.base.records import frozen_record
from anatomy.base.settings import to_mapping
from anatomy.kept_records import kept_record, record_path
from anatomy.lung import Lung
from anatomy.machine_code.sources import kernel_digest
from lungaccess.planning.coupled.atlas import TIP_SPACING_MM, Atlas, build_atlas
from lungaccess.problem.system import System
from lungaccess.problem.task import fissures_are_obstacles
from stages.needle import StartIndex
from stages.scope import ScopeMotions, prover_of
from stages.tube import DEFAULT_ROTATIONS, DEFAULT_STOP_MM, Deployments, shapes_at_hand, shapes_digest

FORMAT = 11
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
    rotations: int = DEFAULT_ROTATIONS,
    stop_spacing_mm: float = DEFAULT_STOP_MM,
    site_spacing_mm: float = TIP_SPACING_MM,
    cache: str | os.PathLike[str] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Atlas:
    """Return the atlas from the cache, or make and keep it.

    A system with another needle finds the same file, unless another shaft lies in the tubes.  Parameters and
    errors are those of `lungaccess.planning.coupled.atlas.build_atlas` and, for the cache, of
    `anatomy.kept_records.kept_record`.
    """
    prover_of(lung, system.scope)  # Here: the first plan does not wait for it.
    depends_on = _depends_on(lung, system, rotations, stop_spacing_mm, site_spacing_mm)

    def make() -> _StoredAtlas:
        made = build_atlas(
            lung,
            system,
            rotations=rotations,
            stop_spacing_mm=stop_spacing_mm,
            site_spacing_mm=site_spacing_mm,
            progress=progress,
        )
        return _StoredAtlas(**{each.name: getattr(made, each.name) for each in fields(_StoredAtlas)})

    in_use = () if lung.folder is None else (lung.folder,)
    stored = kept_record(
        "atlas",
        atlas_format(),
        depends_on,
        _StoredAtlas,
        make=make,
        cache=cache,
        name=lung.name,
        in_use=in_use,
    )
    index = StartIndex(stored.deployments.positions, stored.deployments.tangents)
    return Atlas(lung=lung, system=system, index=index, **vars(stored))


def atlas_is_kept(
    lung: Lung,
    system: System,
    *,
    rotations: int = DEFAULT_ROTATIONS,
    stop_spacing_mm: float = DEFAULT_STOP_MM,
    site_spacing_mm: float = TIP_SPACING_MM,
    cache: str | os.PathLike[str] | None = None,
) -> bool:
    """Tell whether `open_atlas` finds an atlas in the cache; the file is not read, so it may be damaged.

    Where the shapes of its tubes are not at hand it counts as not kept: its file is named by them.
    """
    if not shapes_at_hand(system.tubes):
        return False
    depends_on = _depends_on(lung, system, rotations, stop_spacing_mm, site_spacing_mm)
    return record_path("atlas", atlas_format(), depends_on, cache).is_file()


def _depends_on(
    lung: Lung, system: System, rotations: int, stop_spacing_mm: float, site_spacing_mm: float
) -> dict[str, Any]:
    return {
        "lung": lung.key,
        "scope": to_mapping(system.scope),
        "tubes": to_mapping(system.tubes),
        "needle": None if system.tubes.needle_shaft is None else to_mapping(system.tubes.needle_shaft),
        "margins": to_mapping(system.margins),
        "shapes": shapes_digest(system.tubes),
        "with_fissures": fissures_are_obstacles(lung, system),
        "rotations": rotations,
        "stop_mm": stop_spacing_mm,
        "site_mm": site_spacing_mm,
    }

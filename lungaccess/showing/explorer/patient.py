"""What the page needs of the patient: its facts, surfaces, voxels, and the target that a text names."""

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import LungaccessError
from anatomy.base.typed import Float32
from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.segmentation.folder import STATE
from lungaccess.problem import System, Target, load_system, preset_names, resolve_target
from lungaccess.problem.nodules import nodules_of
from lungaccess.showing.explorer.worker import PatientSource
from lungaccess.showing.report.html.meshes import structure_meshes
from lungaccess.showing.report.html.volumes import CtFile, fine_image, page_image

MOST_NODULES = 50
NODULE = "nodule"
"""The target `nodule 2` is the nodule with this number, see `lungaccess.problem.nodules`."""


def target_of(lung: Lung, text: str) -> Target:
    """Return the target that a text names: `nodule N`, a point with its frame, or a published name.

    Raises LungaccessError as `lungaccess.problem.resolve_target`.
    """
    kind, _, number = text.partition(" ")
    if kind == NODULE and number.isdecimal():
        return resolve_target(lung, nodule=int(number))
    return resolve_target(lung, text=text)


def patient_facts(lung: Lung, source: PatientSource) -> dict[str, Any]:
    """Return name, warnings, targets and systems of a patient as plain values."""
    own = {system.name: system for _path, system in source.own}
    systems = own | {name: load_system(name) for name in preset_names()}
    return {
        "patient": lung.name, "folder": str(source.patient), "warnings": list(lung.warnings),
        "has_ct": source.ct is not None,
        "may_outline": source.ct is not None and (source.patient / STATE).is_file(),
        "carina_lps": np.asarray(lung.tree.carina_lps).tolist(), "targets": _targets(lung),
        "first_system": source.system, "systems": [_system(system) for system in systems.values()],
    }  # fmt: skip


def _targets(lung: Lung) -> list[dict[str, Any]]:
    """Return nodules with their sizes, then the targets that came with the patient, and where they lie."""
    sizes = {f"{NODULE} {each.number}": each.diameter_mm for each in nodules_of(lung)[:MOST_NODULES]}
    found = []
    for text in (*sizes, *lung.target_names):
        try:
            point = target_of(lung, text).lps_mm
        except LungaccessError:
            continue
        place = lung.region_at(point)
        words = [f"{sizes[text]:.0f} mm"] if text in sizes else []
        label = ", ".join([text, *([place] if place else []), *words])
        found.append({"text": text, "lps_mm": point.tolist(), "label": label})
    return found


def _system(system: System) -> dict[str, Any]:
    """Return what the page shows and changes of a system."""
    needle = system.needle
    return {
        "name": system.name,
        "scope_diameter_mm": system.scope.outer_diameter_mm,
        "needle_radius_mm": None if needle is None else needle.min_radius_of_curvature_mm,
        "needle_length_mm": None if needle is None else needle.max_length_mm,
        "margin_mm": system.margins.segmentation_margin_mm,
        "fissures_allowed": system.fissures_allowed,
    }


def scene_parts(lung: Lung, source: PatientSource) -> Iterator[dict[str, Any]]:
    """Yield the voxels of the whole lung, then its surfaces."""
    around = np.asarray(lung.tree.carina_lps)
    image = page_image(lung, around[None], patient_ct(source.ct))
    ct = image["ct"]
    yield {"image": {**image, "labels": image["labels"][:1], "ct": None if ct is None else ct[:1]}}
    yield {"structures": structure_meshes(lung)}


def image_parts(lung: Lung, source: PatientSource, around_lps: ArrayLike) -> dict[str, Any]:
    """Return the fine voxels around a point; within the images, where the point lies beyond them."""
    corners = lung.grid.corners_lps
    around = np.clip(np.asarray(around_lps, dtype=np.float64), corners.min(axis=0), corners.max(axis=0))
    return {"image": fine_image(lung, around[None], patient_ct(source.ct))}


@lru_cache(maxsize=1)
def patient_ct(ct: CtFile | None) -> Volume | None:
    """Return the CT that the explorer was started with, read once; None without one."""
    return None if ct is None else ct.read()


def ct_slice(
    ct: Volume, origin: ArrayLike, across: ArrayLike, down: ArrayLike, columns: int, rows: int
) -> Float32:
    """Return the values in HU at the pixels of a plane, between the eight voxels around each.

    Args:
        origin, across, down ((3,) array_like, LPS mm): The place of the first pixel's centre, and the steps
            to the next column and row.

    Returns:
        values ((rows, columns) float32): nan beyond the centres of the outermost voxels.
    """
    from scipy.ndimage import map_coordinates

    row, column = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    steps = column[..., None] * np.asarray(across) + row[..., None] * np.asarray(down)
    ijk = ct.grid.ijk((np.asarray(origin) + steps).reshape(-1, 3))
    # Only the voxels around the plane are read: a CT is larger than what a slice of it needs.
    low = np.clip(np.floor(ijk.min(axis=0)), 0, np.array(ct.grid.shape) - 1).astype(np.int64)
    high = np.clip(np.ceil(ijk.max(axis=0)) + 1, low + 1, ct.grid.shape).astype(np.int64)
    part = ct.array[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    values = map_coordinates(
        part, (ijk - low).T, output=np.float32, order=1, mode="constant", cval=np.nan, prefilter=False
    )
    beyond = ((ijk < 0) | (ijk > np.array(ct.grid.shape) - 1)).any(axis=1)
    values[beyond] = np.nan
    return np.asarray(values).reshape(rows, columns)

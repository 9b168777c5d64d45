"""Deployment atlases on disk: one file per lung, scope, tubes and margins, whatever the needle."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from anatomy.cache import cache_limit_bytes, default_cache
from anatomy.cache_entries import make_room, note_use
from anatomy.errors import FileError
from anatomy.grid import read_only
from anatomy.io.files import atomic_write
from anatomy.lung import Lung
from anatomy.settings import to_mapping
from lungaccess.coupled.atlas import TIP_SPACING_MM, Atlas, build_atlas
from lungaccess.problem.system import System
from lungaccess.problem.task import fissures_are_obstacles
from stages.needle import StartIndex
from stages.scope import ScopeMotions, prover_of
from stages.tube import DEFAULT_ROTATIONS, DEFAULT_STOP_MM, Deployments

FORMAT = 7
"""Raise it when the enumeration changes: stored atlases of another format are made anew."""
DAMAGE = (OSError, EOFError, ValueError, KeyError, TypeError, zipfile.BadZipFile)
"""What reading a damaged or foreign file raises; the atlas is then made anew."""


def open_atlas(
    lung: Lung,
    system: System,
    *,
    rotations: int = DEFAULT_ROTATIONS,
    stop_spacing_mm: float = DEFAULT_STOP_MM,
    site_spacing_mm: float = TIP_SPACING_MM,
    cache: Path | None = None,
    progress: Callable[[float], None] | None = None,
) -> Atlas:
    """Return the atlas from the cache, or make and keep it.

    A system that differs in its needle alone finds the same file.  Parameters as those of
    `lungaccess.coupled.atlas.build_atlas`.

    Parameters
    ----------
    cache : Path, optional
        Folder of the cache; `anatomy.cache.default_cache()` if None.

    Raises
    ------
    FileError
        If the file cannot be written.
    """
    resolution = {"rotations": rotations, "stop_mm": stop_spacing_mm, "site_mm": site_spacing_mm}
    path = (cache or default_cache()) / f"atlas-{_key(lung, system, resolution)}.npz"
    stored = _load(path, lung, system)
    prover_of(lung, system.scope)  # Here: the first plan does not wait for it.
    if stored is not None:
        note_use(path)
        return stored
    most_bytes = cache_limit_bytes()
    atlas = build_atlas(
        lung,
        system,
        rotations=rotations,
        stop_spacing_mm=stop_spacing_mm,
        site_spacing_mm=site_spacing_mm,
        progress=progress,
    )
    _save(atlas, path)
    keep = (path,) if lung.folder is None else (path, lung.folder)
    make_room(path.parent, most_bytes, {"atlas": FORMAT}, keep=keep)
    return atlas


def _key(lung: Lung, system: System, resolution: dict[str, float]) -> str:
    """Return a hash of all that an atlas depends on."""
    parts = {
        "format": FORMAT,
        "lung": lung.key,
        "scope": to_mapping(system.scope),
        "tubes": to_mapping(system.tubes),
        "margins": to_mapping(system.margins),
        "with_fissures": fissures_are_obstacles(lung, system),
        **resolution,
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=list).encode()).hexdigest()


def _save(atlas: Atlas, path: Path) -> None:
    arrays: dict[str, Any] = {}
    rest: dict[str, Any] = {"with_fissures": atlas.with_fissures, "build_s": atlas.build_s}
    rest |= {"format": FORMAT, "name": atlas.lung.name}
    for name, part in (("motions", atlas.motions), ("deployments", atlas.deployments)):
        _flatten(part, name, arrays, rest)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_write(path) as temporary, open(temporary, "wb") as stream:
            np.savez(stream, rest=np.array(json.dumps(rest)), **arrays)
    except OSError as error:
        raise FileError(
            f"The atlas cannot be stored in {path.parent}: {error}",
            remedy="Choose another folder with --cache or LUNGACCESS_CACHE",
            expected="a folder that may be written to, with room on the disk",
        ) from error


def _flatten(record: Any, name: str, arrays: dict[str, Any], rest: dict[str, Any]) -> None:
    """Add the fields of a record by dotted names: arrays to one mapping, what is plain to the other."""
    for field in fields(record):
        value, key = getattr(record, field.name), f"{name}.{field.name}"
        if is_dataclass(value):
            _flatten(value, key, arrays, rest)
        elif isinstance(value, np.ndarray):
            arrays[key] = value
        else:
            rest[key] = value


def _rebuilt(cls: Any, name: str, values: dict[str, Any]) -> Any:
    """Return the record that `_flatten` wrote."""
    hints = get_type_hints(cls)
    parts: dict[str, Any] = {}
    for field in fields(cls):
        key = f"{name}.{field.name}"
        value = _rebuilt(hints[field.name], key, values) if is_dataclass(hints[field.name]) else values[key]
        parts[field.name] = tuple(value) if isinstance(value, list) else value
    return cls(**parts)


def _load(path: Path, lung: Lung, system: System) -> Atlas | None:
    """Read an atlas; None if there is none or it is damaged."""
    try:
        with np.load(path) as stored:
            arrays = {name: read_only(stored[name]) for name in stored.files if name != "rest"}
            rest = json.loads(str(stored["rest"]))
        values = arrays | rest
        deployments = _rebuilt(Deployments, "deployments", values)
        return Atlas(
            lung=lung,
            system=system,
            with_fissures=rest["with_fissures"],
            motions=_rebuilt(ScopeMotions, "motions", values),
            deployments=deployments,
            index=StartIndex(deployments.positions, deployments.tangents),
            build_s=rest["build_s"],
        )
    except DAMAGE:
        return None

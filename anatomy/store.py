"""Lungs on disk: a folder of memory-mapped arrays, named by the hash of what it was made from."""

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.cache import LUNG_FILE, cache_limit_bytes, default_cache
from anatomy.base.cache_entries import make_room, note_use, remove_abandoned
from anatomy.base.checksums import are_unchanged, file_states, values_checksum, warn_of_damage
from anatomy.base.errors import FileError, LungaccessError
from anatomy.base.files import DAMAGE
from anatomy.base.records import plain_values, record_from
from anatomy.base.typed import Array
from anatomy.base.unfinished import clear_place, filled_folder
from anatomy.build import FORMAT, Reused, build_lung, lung_key
from anatomy.grid import read_only
from anatomy.lung import Lung
from anatomy.machine_code.sources import kernel_digest
from anatomy.patient import PatientImages
from anatomy.plausibility import require_plausible, with_accepted

META = LUNG_FILE
LAYOUT = 4
"""Raise it when the files of a stored lung change, and the lung itself does not."""


def open_lung(
    sources: dict[str, str],
    read: Callable[[], PatientImages],
    *,
    cache: Path | None = None,
    progress: Callable[[str], None] | None = None,
    accept: Collection[str] | None = None,
    reused: Reused | None = None,
) -> Lung:
    """Return the lung made from inputs with these hashes, from the cache or newly built.

    What its masks fail of `anatomy.plausibility.CHECKS` is among its warnings.  `read` reads the images, only
    if the cache does not hold the lung.  A check that fails is refused unless `accept` has its name; None
    refuses nothing.  `reused` is that of `anatomy.build.build_lung`.  Raises AnatomyError if a check of the
    masks fails that is not accepted, and FileError if the cache cannot be written.
    """
    key = lung_key(sources)
    folder = (cache or default_cache()) / folder_name(key)
    lung = _load(folder, warn=True)
    if lung is not None:
        note_use(folder / META)
    else:
        most_bytes = cache_limit_bytes()
        if progress:
            progress("reading images")
        lung = _build_into(folder, key, read(), progress, reused)
        make_room(folder.parent, most_bytes, {"anatomy": stored_format()}, keep=(folder,))
    findings = with_accepted(lung.findings, accept or ())
    if accept is not None:
        require_plausible(findings, accept)
    said = {old.warning: new.warning for old, new in zip(lung.findings, findings, strict=True)}
    object.__setattr__(lung, "findings", findings)
    object.__setattr__(lung, "warnings", tuple(said.get(each, each) for each in lung.warnings))
    return lung


def stored_format() -> str:
    """Return what tells stored lungs of this version and these kernels from all others."""
    return f"{FORMAT}-{LAYOUT}-{kernel_digest('anatomy')}"


def folder_name(key: str) -> str:
    """Return the name of the folder of a lung with this key, as these kernels make it."""
    return hashlib.sha256(f"{key} {stored_format()}".encode()).hexdigest()[:24]


def _build_into(
    folder: Path,
    key: str,
    images: PatientImages,
    progress: Callable[[str], None] | None,
    reused: Reused | None,
) -> Lung:
    """Build a lung with its arrays in a new folder that gets its name when it is complete."""
    with _new_folder(folder) as work:
        linked: dict[str, list[int]] = {}

        def keep(name: str, array: Array) -> Array:
            file = work / f"{name}.npy"
            state = _linked(array, file)
            if state is not None:
                linked[file.name] = state
                return array
            np.save(file, array)
            return _mapped(work, name)

        # Nothing stays mapped: Windows renames no folder in which a file is open.
        _save_rest(build_lung(images, key=key, keep=keep, progress=progress, reused=reused), work, linked)
    lung = _load(folder)
    if lung is None and not folder.exists():
        return build_lung(images, key=key)  # Another process made room; this lung is in memory alone.
    if lung is None:
        raise FileError(
            f"The cached lung in {folder} cannot be read back",
            remedy="Delete that folder",
            expected="files as lungaccess wrote them",
        )
    if reused is not None:
        reused.take(images, lung)
    return lung


def _linked(array: Array, file: Path) -> list[int] | None:
    """Link a file to that of a stored array, and return its state; None where the array has to be written.

    A lung that differs little from a stored one so takes little room.  Where the other one is removed, this
    one counts as damaged, and is made anew.
    """
    mapped: Any = array
    while mapped is not None and not isinstance(mapped, np.memmap):
        mapped = getattr(mapped, "base", None)
    if mapped is None or mapped.filename is None or mapped.shape != array.shape:
        return None
    source = Path(mapped.filename)
    try:
        state = json.loads((source.parent / META).read_text(encoding="utf-8"))["files"][source.name]
        if source.stem == file.stem and are_unchanged(source.parent, {source.name: state}):
            file.symlink_to(source.resolve())
            return list(state)
    except (*DAMAGE, KeyError):
        pass
    return None


@contextlib.contextmanager
def _new_folder(folder: Path) -> Iterator[Path]:
    """Yield a folder of this process's own beside `folder`, and give it that name when it is complete.

    What killed processes left behind is removed first.  Where another process was first, its lung stays.
    """
    with contextlib.ExitStack() as stack:
        try:
            folder.parent.mkdir(parents=True, exist_ok=True)
            remove_abandoned(folder.parent)
            work = stack.enter_context(filled_folder(folder.parent))
        except OSError as error:
            raise FileError(
                f"The cache folder {folder.parent} cannot be written: {error}",
                remedy="Choose another with --cache or LUNGACCESS_CACHE",
                expected="a folder that may be written to",
            ) from error
        try:
            yield work
            if _load(folder) is None:
                clear_place(folder)
                try:
                    os.replace(work, folder)
                except OSError:
                    if _load(folder) is None:
                        raise
        except OSError as error:
            raise FileError(
                f"The lung could not be stored in {folder}: {error}",
                remedy="Free some disk space (about 1.5 GB a patient) or choose another cache folder",
                expected="a folder that may be written to, with room on the disk",
            ) from error


def _save_rest(lung: Lung, folder: Path, linked: dict[str, list[int]]) -> None:
    """Write everything but the large arrays; the description last, with the states of linked files."""
    arrays: dict[str, Any] = {}
    described = plain_values(lung, "", arrays)
    small = {name: array for name, array in arrays.items() if not (folder / f"{name}.npy").exists()}
    np.savez(folder / "arrays.npz", **small)
    meta = {"format": stored_format(), "name": lung.name, "key": lung.key, "lung": described}
    written = sorted(path.name for path in folder.iterdir() if path.name not in linked)
    meta["files"] = file_states(folder, written) | linked
    meta = json.loads(json.dumps(meta))
    meta["checksum"] = values_checksum(meta)
    (folder / META).write_text(json.dumps(meta, indent=1), encoding="utf-8")


def _load(folder: Path, *, warn: bool = False) -> Lung | None:
    """Read a stored lung; None if there is none of the present format under its own key, or it is damaged."""
    if not folder.exists():
        return None
    try:
        meta = json.loads((folder / META).read_text(encoding="utf-8"))
        if meta["format"] != stored_format():
            return None
        stated = meta.pop("checksum")
        its_own = folder_name(meta["key"]) == folder.name
        if its_own and stated == values_checksum(meta) and are_unchanged(folder, meta["files"]):
            with open(folder / "arrays.npz", "rb") as stream, np.load(stream) as small:
                arrays = {name: read_only(small[name]) for name in small.files}
            arrays |= {path.stem: _mapped(folder, path.stem) for path in folder.glob("*.npy")}
            lung: Lung = record_from(Lung, meta["lung"], arrays)
            object.__setattr__(lung, "folder", folder)
            return lung
    except (*DAMAGE, LungaccessError):
        pass
    if warn:
        warn_of_damage(folder)
    return None


def _mapped(folder: Path, name: str) -> Array:
    return read_only(np.asarray(np.load(folder / f"{name}.npy", mmap_mode="r")))

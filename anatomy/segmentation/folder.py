"""The folder a segmentation writes: what was made from what, what a person corrected, its patient.toml."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.checksums import values_checksum
from anatomy.base.errors import AnatomyError, FileError, GridMismatchError
from anatomy.base.files import atomic_write, read_json, require_writable_folder, sha256, write_text
from anatomy.base.typed import Array
from anatomy.grid import Grid, Volume
from anatomy.io.corrections import FOLDER, corrections_file
from anatomy.io.images import SUFFIXES, read_volume, write_volume
from anatomy.io.own_masks import DESCRIPTION
from anatomy.io.voxels import COST_MAP_NOTE
from anatomy.lobes import LOBES
from anatomy.morphology import window
from anatomy.segmentation.canonical import canonical

STATE = "segmentation.json"
FORMAT = 1
_MADE_SUFFIX = ".nii.gz"
IMAGES = ("lungs", "airway", "airway_wall", "nodule", "vessels", "all_vessels", "lobes", "fissures")
"""A person may correct these."""
NOTES = {
    "cost": COST_MAP_NOTE,
    "lobes": ", ".join(f"{number} {name}" for number, name in LOBES.items()).replace(" lobe", ""),
    "fissures": "1 border of lobes without a fissure to be seen, 2 fissure seen, 3 to 49 chance in percent "
    "of lying beyond it, 99 unknown",
}
"""The headers of images that are no masks say this."""


class SegmentationFolder:
    """Images of one CT in a folder, with a record that tells made ones from corrected ones.

    An image counts as corrected if its file is not one that was written here, or if a file of the same name
    with another ending (`airway.seg.nrrd`) lies beside it.  Corrected files are moved to the folder
    `corrections`, and count until they are removed from there.  The record is written before a file gets its
    name, so that a run that was killed at any moment leaves no made file that looks corrected.

    No input may lie where an image is written or looked for.  With `force` files of others may lie there;
    masks then count as corrections.  Raises AnatomyError if the folder holds corrections made for another CT,
    and FileError if the folder cannot be written to, its record is damaged, or it holds inputs or files of
    others.
    """

    def __init__(
        self,
        folder: str | Path,
        grid: Grid,
        ct_digest: str,
        *,
        inputs: Sequence[Path] = (),
        force: bool = False,
    ) -> None:
        self.path = require_writable_folder(folder)
        self.grid = grid
        self._description, self._aside = self.path / DESCRIPTION, self.path / f".{DESCRIPTION}.aside"
        # All files that may be written here or be corrections: they are moved, or overwritten.
        images = [f"{name}{suffix}" for name in IMAGES for suffix in SUFFIXES]
        places = [self.path / name for name in (*images, f"cost{_MADE_SUFFIX}", DESCRIPTION)]
        stated = {os.path.realpath(path) for path in inputs}
        if found := [path.name for path in places if os.path.realpath(path) in stated]:
            raise FileError(
                f"{self.path} is to be written, and its {', '.join(found)} are inputs",
                expected="inputs outside of the folder that is written, or under other names",
                remedy="Choose another folder with --out; a mask that was corrected in this folder is found "
                "without an option",
            )
        held = [path.name for path in places if path.is_file()]
        if held and not force and not (self.path / STATE).is_file():
            raise FileError(
                f"{self.path} holds {', '.join(held)}, but no {STATE} that says a segmentation made them",
                expected="an empty folder, or one that was segmented into before",
                remedy="Choose another folder with --out, or say --force: masks then count as corrections, "
                f"and {DESCRIPTION} is kept",
            )
        self._record = _read_record(self.path / STATE)
        for left in self.path.glob(f".*-*{_MADE_SUFFIX}"):  # of a run that was killed
            left.unlink(missing_ok=True)
        self._collect_corrections()
        self._refuse_other_ct(ct_digest)
        self._record["ct"] = ct_digest

    def path_of(self, name: str) -> Path:
        """Return the file of an image."""
        return self.path / f"{name}{_MADE_SUFFIX}"

    def correction(self, name: str) -> Path | None:
        """Return the file that a person put in place of an image, or None.

        Raises AnatomyError if there are two of them.
        """
        paths = [self.path / FOLDER / f"{name}{suffix}" for suffix in SUFFIXES]
        found = [path for path in paths if path.is_file()]
        if len(found) > 1:
            raise AnatomyError(
                f"{self.path / FOLDER} holds {' and '.join(path.name for path in found)}",
                expected=f"one correction of the {name.replace('_', ' ')}",
                remedy="Remove the one that is not meant",
            )
        return found[0] if found else None

    def _collect_corrections(self) -> None:
        """Move images that were not written here to the corrections."""
        for name, suffix in product(IMAGES, SUFFIXES):
            path = self.path / f"{name}{suffix}"
            made = suffix == _MADE_SUFFIX and self._entry(name).get("written", ())
            if path.is_file() and not (made and sha256(path) in made):
                require_writable_folder(self.path / FOLDER)
                os.replace(path, self.path / FOLDER / path.name)

    def read(self, path: Path) -> Volume:
        """Read an image and put it on the grid of the CT."""
        return onto_grid(read_volume(path), self.grid, path.name)

    def digest_if_made_from(self, name: str, key: str) -> str | None:
        """Return the digest of an image if its file is the one made from `key`, else None."""
        entry = self._entry(name)
        path = self.path_of(name)
        if entry.get("key") != key or not path.is_file() or sha256(path) != entry.get("file"):
            return None
        return str(entry["voxels"])

    def write(self, name: str, array: Array, key: str) -> str:
        """Write an image made from `key`, and return the digest of its voxels."""
        digest = digest_of(array)
        with atomic_write(self.path_of(name)) as temporary:
            write_volume(temporary, Volume(grid=self.grid, array=array), note=NOTES.get(name, ""))
            file = sha256(temporary)
            known = [*self._entry(name).get("written", ())][-1:]
            entry = {"key": key, "file": file, "voxels": digest, "written": [*known, file]}
            self._record.setdefault("images", {})[name] = entry
            self.save()
        return digest

    def facts(self, step: str) -> dict[str, Any]:
        """Return what a step noted beside its images."""
        return dict(self._record.get("facts", {}).get(step, {}))

    def note(self, step: str, facts: Mapping[str, Any]) -> None:
        """Keep what a step found beside its images."""
        self._record.setdefault("facts", {})[step] = dict(facts)

    def remember(self, **others: Any) -> None:
        """Put further entries into the record, which is written with the next image."""
        self._record |= others

    def save(self, **others: Any) -> None:
        """Write the record, with further entries if given."""
        self.remember(**others)
        self._record = json.loads(json.dumps(self._record))
        sealed = self._record | {"checksum": values_checksum(self._record)}
        write_text(self.path / STATE, json.dumps(sealed, indent=1) + "\n")

    def set_description_aside(self) -> None:
        """Take `patient.toml` away until `describe`, so that no half-made patient is read; harmless again."""
        if self._description.is_file():
            os.replace(self._description, self._aside)

    def describe(self, text: str) -> bool:
        """Put `patient.toml` back: `text`, or what a person edited; return True if the latter."""
        self.set_description_aside()
        written = self._record.get("description") or []
        if self._aside.is_file() and sha256(self._aside) not in written:
            os.replace(self._aside, self._description)
            return True
        self.save(description=[*written[-1:], hashlib.sha256(text.encode("utf-8")).hexdigest()])
        write_text(self._description, text)
        self._aside.unlink(missing_ok=True)
        return False

    def _entry(self, name: str) -> dict[str, Any]:
        return dict(self._record.get("images", {}).get(name, {}))

    def _refuse_other_ct(self, ct_digest: str) -> None:
        if self._record.get("ct") in (None, ct_digest):
            return
        corrected = [name for name in IMAGES if self.correction(name)]
        corrected += ["what was painted"] if corrections_file(self.path).is_file() else []
        if corrected:
            raise AnatomyError(
                f"{self.path} holds images of another CT that were corrected: {', '.join(corrected)}",
                expected="the CT these corrections were made for, or an empty folder",
                remedy="Choose another folder with --out",
            )


def _read_record(path: Path) -> dict[str, Any]:
    """Return the record of a folder; empty if there is none, or of another format.

    Raises FileError if it is damaged: nothing else tells which images a person corrected.
    """
    if not path.is_file():
        return {"format": FORMAT}
    remedy = "Restore it; or remove it, and with it every image in the folder that you did not correct"
    expected = "the record that segment wrote"
    record = read_json(path, expected=expected, remedy=remedy)
    if not isinstance(record, dict) or record.pop("checksum", None) not in (None, values_checksum(record)):
        raise FileError(f"{path} is damaged or was changed", expected=expected, remedy=remedy)
    return record if record.get("format") == FORMAT else {"format": FORMAT}


def digest_of(array: Array) -> str:
    """Return the SHA-256 of the voxels of an image, whatever their order in memory."""
    plain = np.asfortranarray(array)
    plain = plain.view(np.uint8) if plain.dtype == np.bool_ else plain
    found = hashlib.sha256(f"{plain.dtype.str}{plain.shape}".encode())
    found.update(np.ascontiguousarray(plain.T).data)
    return found.hexdigest()


def grid_digest(grid: Grid) -> str:
    """Return the SHA-256 of a grid."""
    return hashlib.sha256(f"{grid.shape}{grid.lps_from_ijk.tobytes().hex()}".encode()).hexdigest()


def digest_of_ct(ct: Volume) -> str:
    """Return the hash of the voxels and the grid of a CT in the order of `canonical`."""
    ordered = canonical(ct)
    return key_of("ct", voxels=digest_of(ordered.array), grid=grid_digest(ordered.grid))


def segmented_ct(folder: Path) -> dict[str, Any] | None:
    """Return path, UID of the series and digest of the CT of a segmentation; None if they are not recorded.

    Raises FileError if the record of the segmentation is damaged.
    """
    if not (folder / STATE).is_file():
        return None
    record = _read_record(folder / STATE)
    source = record.get("ct_source")
    if source is None:
        return None
    return {"path": folder / source["path"], "series": source["series"], "digest": record["ct"]}


def key_of(step: str, **parts: Any) -> str:
    """Return the key of a step: the hash of its name, its settings and what it is made from."""
    return hashlib.sha256(json.dumps({"step": step, **parts}, sort_keys=True).encode()).hexdigest()


def onto_grid(volume: Volume, grid: Grid, name: str) -> Volume:
    """Place an image whose voxels coincide with those of `grid`, but which may cover another box.

    Its voxels may be stored in another order; those of `grid` are in that of `canonical`.  Raises
    GridMismatchError if the voxels do not coincide.
    """
    volume = canonical(volume)
    if volume.grid.is_close(grid):
        return Volume(grid=grid, array=volume.array)
    start = grid.ijk(volume.grid.lps((0, 0, 0)))
    shift = np.rint(start).astype(np.int64)
    axes = grid.ijk_from_lps[:3, :3] @ volume.grid.lps_from_ijk[:3, :3]
    steps = np.abs(axes - np.eye(3)).max() * max(volume.grid.shape)
    # Largest deviation from a whole number of voxels, in voxels.
    if not (np.abs(start - shift).max() <= 0.05 and steps <= 0.05):
        raise GridMismatchError(
            f"The voxels of {name} are not those of the CT: {volume.grid.describe()}",
            expected=f"a box of voxels of {grid.describe()}",
            remedy="Export the mask with the CT as its reference image",
        )
    placed = np.zeros(grid.shape, dtype=volume.array.dtype, order="F")
    low, high = np.maximum(shift, 0), np.minimum(shift + volume.grid.shape, grid.shape)
    if (low < high).all():
        placed[window(low, high)] = volume.array[window(low - shift, high - shift)]
    return Volume(grid=grid, array=placed)

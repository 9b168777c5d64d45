"""Which files make a patient, and their hashes, without reading a single voxel."""

import os.path
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from anatomy.base.errors import FileError
from anatomy.base.files import DAMAGE, read_text, require_file, sha256
from anatomy.io.corrections import corrections_file
from anatomy.io.images import image_suffix
from anatomy.io.own_masks import DESCRIPTION


def input_hashes(path: str | Path) -> dict[str, str]:
    """Return the SHA-256 of every file a patient may be read from, by its path in the patient's folder.

    `path` is what `anatomy.io.load_patient` takes.  Which file was stated as the label map is told apart by
    an entry of its own.  Raises FileError if there is nothing at `path`, or a file cannot be read.
    """
    path = Path(path)
    if path.is_dir() and (path / DESCRIPTION).is_file():
        path = path / DESCRIPTION
    if path.is_dir():
        return _hashes(path, _files_beside(path))
    require_file(path)
    if path.suffix == ".toml":
        return _hashes(path.parent, {path, *_files_named_in(path)})
    return _hashes(path.parent, _files_beside(path.parent)) | {f"{path.name} as label map": sha256(path)}


def _hashes(folder: Path, files: set[Path]) -> dict[str, str]:
    files |= {data for file in files for data in _detached_data(file)}
    if (painted := corrections_file(folder)).is_file():
        files.add(painted)
    return {Path(os.path.relpath(file, folder)).as_posix(): sha256(file) for file in sorted(files)}


def _files_beside(folder: Path) -> set[Path]:
    return {
        file
        for file in folder.iterdir()
        if file.is_file() and (image_suffix(file) or file.suffix in (".txt", ".json", ".toml"))
    }


def _detached_data(image: Path) -> set[Path]:
    """Return the file with the voxels of a MetaImage header; the whole folder if it names no single one."""
    if image_suffix(image) != ".mhd":
        return set()
    with require_file(image).open("rb") as stream:
        named = re.search(rb"^ElementDataFile\s*=\s*(.*?)\s*$", stream.read(1 << 20), re.MULTILINE)
    name = named[1].decode("utf-8", errors="replace") if named else "LOCAL"
    if name.upper() == "LOCAL":
        return set()
    data = image.with_name(name)
    return {data} if data.is_file() else {file for file in image.parent.iterdir() if file.is_file()}


def _files_named_in(description: Path) -> set[Path]:
    """Return the files that strings of a description name, itself being judged elsewhere."""
    try:
        values = tomllib.loads(read_text(description))
    except (FileError, *DAMAGE):
        return set()
    return {file for text in _strings(values) for file in _files_meant(description.parent, text)}


def _files_meant(folder: Path, text: str) -> Iterator[Path]:
    """Yield the file that `file` or `file#label` names, and side-cars that may name its labels."""
    name, separator, _label = text.rpartition("#")
    if os.path.isfile(folder / text):
        yield folder / text
    elif separator and os.path.isfile(folder / name):
        yield folder / name
        yield from (file for file in (folder / name).parent.glob("*.json") if file.is_file())


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for item in value.values():
            yield from _strings(item)
    elif isinstance(value, list):
        for item in value:
            yield from _strings(item)

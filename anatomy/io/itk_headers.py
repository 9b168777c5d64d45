"""Text headers of NRRD and MetaImage files: the stated frame, segment names, where the data begin."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from anatomy.errors import FileError, FrameError
from anatomy.io.frames import Frame
from anatomy.records import frozen_value

_HEADER_LIMIT = 1 << 20
_SPACES = {
    "left-posterior-superior", "lps", "right-anterior-superior", "ras", "left-anterior-superior", "las",
}  # fmt: skip


@frozen_value
class NrrdHeader:
    """The `field: value` and `key:=value` lines of a NRRD file, and where its data begin."""

    fields: Mapping[str, str]
    keys: Mapping[str, str]
    data_offset: int


def read_nrrd_header(path: Path) -> NrrdHeader:
    """Parse the text header of an attached NRRD file.

    Raises
    ------
    FileError
        If it is no NRRD file, or its data lie in another file.
    """
    with path.open("rb") as stream:
        start = stream.read(_HEADER_LIMIT)
    end = re.search(rb"\r?\n\r?\n", start)
    if not start.startswith(b"NRRD") or end is None:
        raise FileError(
            f"{path} does not begin with a NRRD header",
            expected="a complete .nrrd file",
            remedy="Copy or export the file again",
        )
    lines = start[: end.start()].decode("utf-8", errors="replace").splitlines()[1:]
    pairs = [re.split(r":=|: ", line, maxsplit=1) for line in lines if not line.startswith("#")]
    keyed = [":=" in line for line in lines if not line.startswith("#")]
    fields = {p[0].lower(): p[1].strip() for p, key in zip(pairs, keyed, strict=True) if not key and p[1:]}
    keys = {p[0]: p[1] for p, key in zip(pairs, keyed, strict=True) if key}
    if "data file" in fields or "datafile" in fields:
        raise FileError(
            f"{path} keeps its data in another file",
            expected="header and data in one file",
            remedy="Save it as .nrrd instead of .nhdr",
        )
    return NrrdHeader(fields=fields, keys=keys, data_offset=end.end())


def stated_frame(header: NrrdHeader, path: Path, frame: Frame | None) -> bool:
    """Tell whether the file states its frame; if not, `frame` must be given.

    Raises
    ------
    FrameError
        If there is neither.
    """
    space = header.fields.get("space", "").lower()
    if space in _SPACES:
        return True
    if frame is None:
        raise FrameError(
            f"{path} does not state its frame (space: {space or 'missing'})",
            expected="space: left-posterior-superior or right-anterior-superior",
            remedy="State the frame yourself (frame = 'ras' or 'lps'), or export the file again",
        )
    return False


def nrrd_labels(header: NrrdHeader) -> dict[int, str]:
    """Read the segments of a .seg.nrrd file: label value to name."""
    labels: dict[int, str] = {}
    for key, value in header.keys.items():
        match = re.fullmatch(r"(Segment\d+)_LabelValue", key)
        name = header.keys.get(f"{match[1]}_Name", "") if match else ""
        if name and value.strip().isdigit():
            labels[int(value)] = name.strip()
    return labels


def metaimage_payload(path: Path) -> tuple[Path, int] | None:
    """Return the file and offset of the compressed data of a MetaImage, or None if not compressed.

    Raises
    ------
    FileError
        If it is no MetaImage.
    """
    with path.open("rb") as stream:
        start = stream.read(_HEADER_LIMIT)
    end = re.search(rb"^ElementDataFile\s*=\s*(.*?)\s*?\r?\n", start, re.MULTILINE)
    if end is None:
        raise FileError(
            f"{path} does not begin with a MetaImage header",
            expected="a .mha or .mhd file",
            remedy="Copy or export the file again",
        )
    if not re.search(rb"^CompressedData\s*=\s*True", start[: end.start()], re.MULTILINE | re.IGNORECASE):
        return None
    data_file = end[1].decode("utf-8", errors="replace")
    return (path, end.end()) if data_file.upper() == "LOCAL" else (path.with_name(data_file), 0)

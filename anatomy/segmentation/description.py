"""The `patient.toml` of a folder while its images change."""

import hashlib
import json
import os
from collections.abc import Mapping, Sequence
from types import MappingProxyType

from anatomy.base.files import sha256, write_text
from anatomy.base.typed import Float
from anatomy.lobes import LOBES
from anatomy.segmentation.folder import SegmentationFolder


class Description:
    """The `patient.toml` of a folder: set aside while images change, so that no half-made patient is read.

    A person's own edits are kept.
    """

    def __init__(self, folder: SegmentationFolder, name: str) -> None:
        self._folder = folder
        self._path = folder.path / name
        self._aside = folder.path / f".{name}.aside"

    def set_aside(self) -> None:
        """Take the description away until `finish`; harmless when it is away already."""
        if self._path.is_file():
            os.replace(self._path, self._aside)

    def finish(self, text: str) -> bool:
        """Put the description back: `text`, or what a person edited; return True if the latter."""
        self.set_aside()
        written = self._folder.recorded("description") or []
        if self._aside.is_file() and sha256(self._aside) not in written:
            os.replace(self._aside, self._path)
            return True
        digest = hashlib.sha256(text.encode("utf-8")).hexdigest()
        self._folder.save(description=[*written[-1:], digest])
        write_text(self._path, text)
        self._aside.unlink(missing_ok=True)
        return False


def description_text(
    name: str,
    *,
    has_nodule: bool,
    lobes: Sequence[int],
    has_fissures: bool,
    warnings: tuple[str, ...],
    target_lps: Float | None,
    thick_slices_mm: float,
    accepted: tuple[str, ...] = (),
    large_radius_mm: float = 0.0,
    sources: Mapping[str, str] = MappingProxyType({}),
) -> str:
    """Return the `patient.toml` of a segmentation.

    An empty name is left out; `lobes` are the numbers of those that are known, and `warnings` what to say of
    them; the target `(3,)` is LPS mm; `thick_slices_mm` is the distance of slices that were accepted
    although they are thick, else 0; `accepted` are checks that failed and were overruled; `sources` tells
    what images were taken from elsewhere, by their names; `large_radius_mm`, from which vessels are
    obstacles, is 0 if a given mask says what they are.
    """
    lines = [f"name = {_quoted(name)}"] if name else []
    lines += [
        'lumen = "airway.nii.gz"',
        'wall = "airway_wall.nii.gz"',
        'vessels = "vessels.nii.gz"',
        'lung = "lungs.nii.gz"',
        'cost = "cost.nii.gz"',
    ]
    if has_fissures:
        lines.append('fissures = "fissures.nii.gz"')
    if lobes:
        files = (f'"{LOBES[number]}" = "lobes.nii.gz#{number}"' for number in lobes)
        lines.append(f"lobes = {{ {', '.join(files)} }}")
    if warnings:
        lines.append(f"warnings = {_quoted(list(warnings))}")
    if has_nodule:
        lines.append('nodule = "nodule.nii.gz"')
    if target_lps is not None:
        lines.append('targets = ["lps:{:.3f},{:.3f},{:.3f}"]'.format(*target_lps))
    if thick_slices_mm:
        lines.append(f"thick_slices_mm = {thick_slices_mm:.3f}")
    if large_radius_mm:
        lines.append(f"large_radius_mm = {large_radius_mm:.3f}")
    if accepted:
        lines.append(f"accepted = {_quoted(list(accepted))}")
    if sources:
        lines.append(f"sources = {{ {', '.join(f'{key} = {_quoted(v)}' for key, v in sources.items())} }}")
    return "\n".join(lines) + "\n"


def _quoted(value: str | list[str]) -> str:
    return json.dumps(value, ensure_ascii=False)

"""What a segmentation starts from: a CT, and whatever other programs or people have made already."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from pathlib import Path

from anatomy.errors import FileError
from anatomy.grid import Grid, Volume
from anatomy.io.files import sha256
from anatomy.io.images import read_volume
from anatomy.io.masks import read_masks
from anatomy.io.totalsegmentator import mask_sources
from anatomy.records import frozen_record, frozen_value
from anatomy.segmentation.box import VOXEL_MM
from anatomy.segmentation.folder import onto_grid
from anatomy.segmentation.vessels import LARGE_RADIUS_MM
from anatomy.typed import Float

_ROLES = {"lumen": "airway", "wall": "airway_wall", "vessels": "vessels", "lung": "lungs"}
"""Which image of the folder a role of TotalSegmentator's output stands for."""


@frozen_value
class Given:
    """Files in place of steps, and the target; all optional.

    Parameters
    ----------
    lungs : Path
        Label map (1 right, 2 left; or lobes 1 to 5, as lungmask writes them) or one mask of both lungs.
    airway, airway_wall, vessels : Path
        Masks.
    totalsegmentator : Path
        Folder with output of TotalSegmentator's tasks lung_vessels and total, or one of them.
    nodule_contours : Path
        Contours of radiologists, see `anatomy.segmentation.nodules.nodule_from_contours`.
    nodule_mask : Path
        Mask of one or more nodules.
    target : str
        A point with its frame, `ras:x,y,z` or `lps:x,y,z`.
    """

    lungs: Path | None = None
    airway: Path | None = None
    airway_wall: Path | None = None
    vessels: Path | None = None
    totalsegmentator: Path | None = None
    nodule_contours: Path | None = None
    nodule_mask: Path | None = None
    target: str | None = None

    def images(self, grid: Grid) -> dict[str, Volume]:
        """Read the masks that replace steps, by the name of the image they replace.

        Raises
        ------
        FileError
            If a file is missing or damaged, or the folder holds no output of TotalSegmentator.
        GridMismatchError
            If a mask does not fit the CT.
        """
        found = {} if self.totalsegmentator is None else _totalsegmentator_images(self.totalsegmentator, grid)
        for name in _ROLES.values():
            path = getattr(self, name)
            if path is not None:
                found[name] = onto_grid(read_volume(path), grid, path.name)
        return found

    def hashes(self) -> dict[str, str]:
        """Return the SHA-256 of the files that were named one by one."""
        paths = (self.lungs, self.airway, self.airway_wall, self.vessels)
        return {str(path): sha256(path) for path in (*paths, self.nodule_contours, self.nodule_mask) if path}


def _totalsegmentator_images(folder: Path, grid: Grid) -> dict[str, Volume]:
    if not folder.is_dir():
        raise FileError(
            f"There is no folder {folder}",
            expected="a folder with output of TotalSegmentator",
            remedy="Check the name and the folder",
        )
    sources, _ = mask_sources(folder)
    roles = {"lung" if source.role == "lobes" else source.role for source in sources}
    # The task total knows the trachea alone; only the task lung_vessels shows the airways.
    if not roles & {"wall", "vessels"}:
        roles.discard("lumen")
    if not roles & set(_ROLES):
        raise FileError(
            f"{folder} holds no lobes, airways or vessels of TotalSegmentator",
            expected="output of the tasks lung_vessels or total, such as lung_vessels.nii.gz",
            remedy="Run its task lung_vessels, or give masks one by one: --airway, --vessels, --lungs",
        )
    read = read_masks(sources)
    masks = dict(read.masks)
    if read.lobes is not None:
        masks["lung"] = (read.lobes > 0) | masks.get("lung", False)
    return {
        image: onto_grid(Volume(grid=read.grid, array=masks[role]), grid, f"{role} of {folder.name}")
        for role, image in _ROLES.items()
        if role in roles
    }


@frozen_record
class SegmentationRequest:
    """What to segment, and what is given.

    Parameters
    ----------
    ct : Volume
        Hounsfield units.
    out : Path
        The patient folder to write.
    name : str
        How reports call the patient; the folder's name if empty.
    sources : mapping of str to str
        Files the CT was read from, and their SHA-256.
    ex_vivo : bool
        The image shows an inflated lung in air.
    thick_slices : bool
        Accept slices of more than 3 mm; the folder is marked, and planning on it must be allowed too.
    large_radius_mm : float
        Vessels of this radius or more are obstacles, thinner ones costs.
    accept : tuple of str
        Checks of `anatomy.segmentation.gate.CHECKS` whose failure a person accepts; it is recorded.
    seed_lps : (3,) float64, optional
        A point in the trachea, LPS mm.
    given : Given
    voxel_mm : float
        Axes along which the CT has larger voxels are interpolated to about this size.
    """

    ct: Volume
    out: Path
    name: str = ""
    sources: Mapping[str, str] = field(default_factory=dict)
    ex_vivo: bool = False
    thick_slices: bool = False
    large_radius_mm: float = LARGE_RADIUS_MM
    accept: tuple[str, ...] = ()
    seed_lps: Float | None = None
    given: Given = field(default_factory=Given)
    voxel_mm: float = VOXEL_MM

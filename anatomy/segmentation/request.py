"""What a segmentation starts from: a CT, and whatever other programs or people have made already."""

from collections.abc import Mapping
from dataclasses import field
from pathlib import Path

from anatomy.base.files import sha256
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float
from anatomy.grid import Grid, Volume
from anatomy.io.images import images_in
from anatomy.segmentation.box import VOXEL_MM
from anatomy.segmentation.given import ROLES, GivenImages, read_given
from anatomy.segmentation.vessels import LARGE_RADIUS_MM


@frozen_value
class Given:
    """Files in place of steps, and the target; all optional.

    Parameters
    ----------
    lungs : Path
        Label map (1 right, 2 left; or lobes, see `lobes`) or one mask of both lungs.
    airway, airway_wall, vessels : Path
        Masks, label maps that name their labels, `file#1,2` for some labels, or folders of TotalSegmentator.
    lobes : Path
        Label map: see `anatomy.segmentation.labels.lobe_numbers`; or a folder of TotalSegmentator.
    fissures : Path
        Mask; or 1 where a fissure is inferred, and 2 where it is seen.
    onnx_airway : Path
        Network for the airway, see `anatomy.segmentation.learned`.
    totalsegmentator : Path
        Folder with output of TotalSegmentator's tasks lung_vessels and total, or one of them: all that it
        holds is taken.
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
    lobes: Path | None = None
    fissures: Path | None = None
    onnx_airway: Path | None = None
    totalsegmentator: Path | None = None
    nodule_contours: Path | None = None
    nodule_mask: Path | None = None
    target: str | None = None

    def files(self) -> dict[str, Path]:
        """Return the files that were named one by one, by the image they replace."""
        named = {image: getattr(self, image) for image in ROLES}
        return {image: path for image, path in named.items() if path is not None}

    def images(self, grid: Grid) -> GivenImages:
        """Read the masks that replace steps; the errors are those of `read_given`."""
        return read_given(self.files(), self.totalsegmentator, grid)

    def hashes(self) -> dict[str, str]:
        """Return the SHA-256 of the files that were named one by one, and of those in folders."""
        named = (self.totalsegmentator, self.onnx_airway, self.nodule_contours, self.nodule_mask)
        found: dict[str, str] = {}
        for path in (path for path in (*self.files().values(), *named) if path is not None):
            file = path if path.exists() else path.with_name(path.name.rpartition("#")[0])
            found |= {str(each): sha256(each) for each in (images_in(file) if file.is_dir() else [file])}
        return found


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

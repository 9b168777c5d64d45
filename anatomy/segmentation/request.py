"""What a segmentation starts from: a CT, and whatever other programs or people have made already."""

from collections.abc import Mapping, Sequence
from dataclasses import field, replace
from pathlib import Path

import numpy as np

from anatomy.base.errors import AnatomyError, FileError, GridMismatchError
from anatomy.base.files import sha256
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Array, Float
from anatomy.base.words import percent
from anatomy.grid import Grid, Volume
from anatomy.io import mask_values
from anatomy.io.ct_cases import ct_case
from anatomy.io.images import images_in, read_volume
from anatomy.io.masks import SOLID, MaskSource, place, read_masks
from anatomy.io.totalsegmentator import file_sources, mask_sources
from anatomy.segmentation.box import VOXEL_MM
from anatomy.segmentation.canonical import canonical
from anatomy.segmentation.labels import lobe_numbers, sides_of_lobes
from anatomy.segmentation.vessels import LARGE_RADIUS_MM

ROLES = {
    "airway": "lumen", "airway_wall": "wall", "vessels": "vessels", "lungs": "lung", "lobes": "lobes",
    "fissures": "fissures",
}  # fmt: skip
"""The images of the folder that may come from elsewhere, and the role of each among masks."""
LABELLED = ("lungs", "lobes", "fissures")
"""Images whose values mean something."""
SEEN = 2
"""The greatest value of an image of fissures that tells what was inferred from what was seen."""
GREATEST_LOSS = 0.02
"""Share of a mask that may lie outside the CT: more is another patient, or another frame."""


@frozen_record
class GivenImages:
    """Images on the voxels of the CT by their names, what each was made from, and what to look at."""

    images: Mapping[str, Volume]
    sources: Mapping[str, str]
    warnings: tuple[str, ...]


@frozen_record
class _Read:
    """An image on its own voxels, what it was made from, and how its values were understood."""

    volume: Volume
    source: str
    said: tuple[str, ...] = ()


def read_given(files: Mapping[str, Path], folder: Path | None, grid: Grid) -> GivenImages:
    """Read masks of other programs.

    Args:
        files: By the name of the image, a key of `ROLES`: a mask, a label map, `file#1,2` for some of its
            labels, a folder of TotalSegmentator or a case of AeroPath.
        folder: Output of TotalSegmentator, for all images that it holds.
        grid: The voxels of the CT, in the order of `canonical`.

    Raises:
        FileError: If a file is missing or damaged, or a folder holds nothing of the kind.
        AnatomyError: If a mask is empty, or its values do not say what is what.
        GridMismatchError: If a mask lies in another frame than the CT.
    """
    found = {} if folder is None else _all_of_folder(folder)
    for image, path in files.items():
        found[image] = _read(image, path)
    placed: dict[str, Volume] = {}
    warnings: list[str] = []
    for image, read in found.items():
        name = read.source.split(" (")[0]
        warnings += read.said
        volume, coarse_mm = _onto_ct(read.volume, grid, name, solid=ROLES[image] in SOLID)
        if not volume.array.any():
            raise AnatomyError(
                f"{name} holds nothing where the CT is: its mask is empty",
                expected="voxels that are not zero",
                remedy=f"Give another mask in place of the {image}, or leave the option out",
            )
        if coarse_mm:
            warnings.append(
                f"{name} has other voxels than the CT, of up to {coarse_mm:.2f} mm, and was carried over to "
                "the nearest ones: what is thinner is no better than that."
            )
        placed[image] = volume
    sources = {image: read.source for image, read in found.items()}
    return GivenImages(images=placed, sources=sources, warnings=tuple(dict.fromkeys(warnings)))


def _read(image: str, path: Path) -> _Read:
    if path.is_dir():
        case = ct_case(path)
        own = None if case is None else {"airway": case.airway, "lungs": case.lungs}.get(image)
        if case is None or own is None:
            return _of_sources(image, mask_sources(path)[0], path.name)
        read = _read(image, own)
        return replace(read, source=f"{read.source} ({case.data_set})")
    file, stated = mask_values.file_and_label(path)
    if file != path:
        labels = mask_values.parse_labels(stated)
        if labels is None:
            raise FileError(
                f"{path.name} names no labels",
                expected="values after #, with commas between them",
                remedy=f"Write for instance {file.name}#1,2",
            )
        return _of_file(image, file, labels, f"{file.name} (labels {stated})")
    sources, _ = file_sources(path)
    if sources:
        return _of_sources(image, sources, path.name)
    return _of_file(image, path, (), path.name)


def _of_file(image: str, path: Path, labels: tuple[int, ...], source: str) -> _Read:
    """Read a file as a mask, or, where its labels are parts of what it shows, with its labels."""
    volume = read_volume(path)
    array: Array = volume.array
    said: tuple[str, ...] = ()
    has_labels = image == "lobes" or (image in LABELLED and mask_values.is_whole(array))
    if has_labels:
        mask_values.require_label_values(array, path.name)
        array = np.where(mask_values.select(array, labels), array, array.dtype.type(0)) if labels else array
    if not has_labels or (image == "fissures" and array.max() > SEEN):
        array, said = mask_values.mask_of(
            volume.array,
            path.name,
            voxel_mm3=volume.grid.voxel_volume_mm3,
            role=_plain(image) if image not in LABELLED else ROLES[image],
            labels=labels,
        )
    found = Volume(grid=volume.grid, array=array)
    if image == "lobes":
        found = Volume(grid=volume.grid, array=lobe_numbers(found, source))
    return _Read(volume=found, source=source, said=said)


def _all_of_folder(folder: Path) -> dict[str, _Read]:
    if not folder.is_dir():
        raise FileError(
            f"There is no folder {folder}",
            expected="a folder with output of TotalSegmentator",
            remedy="Check the name and the folder",
        )
    sources, _ = mask_sources(folder)
    roles = {source.role for source in sources}
    roles |= {"lung"} if "lobes" in roles else set()
    # The task total knows the trachea alone; only the task lung_vessels shows the airways.
    if not roles & {"wall", "vessels"}:
        roles.discard("lumen")
    wanted = [image for image, role in ROLES.items() if role in roles]
    if not wanted:
        raise FileError(
            f"{folder} holds no lobes, airways or vessels of TotalSegmentator",
            expected="output of the tasks lung_vessels or total, such as lung_vessels.nii.gz",
            remedy="Run its task lung_vessels, or give masks one by one: --airway, --vessels, --lungs",
        )
    return {image: _of_sources(image, sources, folder.name) for image in wanted}


def _of_sources(image: str, sources: Sequence[MaskSource], name: str) -> _Read:
    """Unite the masks of a role; lungs are the lobes where there are no lungs."""
    role = ROLES[image]
    fitting = [source for source in sources if source.role == role]
    if image == "lungs" and not fitting:
        fitting = [source for source in sources if source.role == "lobes"]
    if not fitting:
        there = ", ".join(dict.fromkeys(source.role for source in sources))
        raise FileError(
            f"{name} holds no {_plain(image)}, but {there or 'only what has no name that is known'}",
            expected=f"a mask of the {_plain(image)}",
            remedy="Give the file that shows them, or name the labels, as in FILE#1,2",
        )
    read = read_masks(fitting)
    array: Array = read.masks[role] if role in read.masks else np.asarray(read.lobes)
    if image == "lungs" and role not in read.masks:
        array = sides_of_lobes(array)
    labels = [f" label {', '.join(map(str, source.labels))}" if source.labels else "" for source in fitting]
    shown = (f"{source.path.name}{label}" for source, label in zip(fitting, labels, strict=True))
    files = ", ".join(dict.fromkeys(shown))
    source = f"{name} (TotalSegmentator: {files})"
    return _Read(volume=Volume(grid=read.grid, array=array), source=source, said=read.statements)


def _plain(image: str) -> str:
    return image.replace("_", " ")


def _onto_ct(volume: Volume, grid: Grid, name: str, *, solid: bool) -> tuple[Volume, float]:
    """Return an image on the voxels of the CT, and the size of its own if they are others, else 0."""
    volume = canonical(volume)
    if volume.grid.is_close(grid):
        return Volume(grid=grid, array=volume.array), 0.0
    axes = [each.lps_from_ijk[:3, :3] / each.spacing_mm for each in (volume.grid, grid)]
    turned = float(np.abs(axes[0].T @ axes[1] - np.eye(3)).max())
    placed = place(volume.array, volume.grid, grid, solid=solid)
    lost = placed.n_lost / max(placed.n_voxels, 1)
    # An axis may turn by so many radians: over 300 mm a mask is then 3 mm off.
    if not (turned <= 0.01 and lost <= GREATEST_LOSS):
        why = f"{percent(lost)} of it lie outside the CT" if lost > GREATEST_LOSS else "its axes are turned"
        raise GridMismatchError(
            f"{name} lies in another frame than the CT: {why}. It has {volume.grid.describe()}",
            expected=f"a mask of this CT, which has {grid.describe()}",
            remedy="Export the mask with the CT as its reference image, and check that both show one patient",
        )
    coarse_mm = float(volume.grid.spacing_mm.max()) if placed.is_resampled else 0.0
    return Volume(grid=grid, array=placed.array), coarse_mm


@frozen_value
class Given:
    """Files in place of steps, and the target; all optional.

    Args:
        lungs: Label map (1 right, 2 left; or lobes, see `lobes`) or one mask of both lungs.
        airway, airway_wall, vessels: Masks, label maps that name their labels, `file#1,2` for some labels, or
            folders of TotalSegmentator.
        lobes: Label map: see `anatomy.segmentation.labels.lobe_numbers`; or a folder of TotalSegmentator.
        fissures: Mask; or 1 where a fissure is inferred, and 2 where it is seen.
        onnx_airway: Network for the airway, see `anatomy.segmentation.learned`.
        totalsegmentator: Folder with output of TotalSegmentator's tasks lung_vessels and total, or one of
            them: all that it holds is taken.
        nodule_contours: Contours of radiologists, see `anatomy.segmentation.nodules.nodule_from_contours`.
        nodule_mask: Mask of one or more nodules.
        nodules: Points in nodules, which are outlined by `anatomy.segmentation.outlining.outline_nodule`.
        target: A point with its frame, `ras:x,y,z` or `lps:x,y,z`.
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
    nodules: tuple[str, ...] = ()
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
            file, _label = mask_values.file_and_label(path)
            found |= {str(each): sha256(each) for each in (images_in(file) if file.is_dir() else [file])}
        return found


@frozen_record
class SegmentationRequest:
    """What to segment, and what is given.

    Args:
        ct: Hounsfield units.
        out: The patient folder to write.
        name: How reports call the patient; the folder's name if empty.
        sources: Files the CT was read from, and their SHA-256.
        ct_path: The image or folder of DICOM that holds the CT; it is recorded, so that others can show the
            CT.
        ct_series: UID of its series, where the folder holds several.
        ex_vivo: The image shows an inflated lung in air.
        thick_slices: Accept slices of more than 3 mm; the folder is marked, and planning on it must be
            allowed too.
        large_radius_mm: Vessels of this radius or more are obstacles, thinner ones costs.
        accept: Checks of `anatomy.plausibility.CHECKS` whose failure a person accepts; it is recorded.
        seed_lps ((3,) float64): A point in the trachea, LPS mm.
        voxel_mm: Axes along which the CT has larger voxels are interpolated to about this size.
        force: Whether the folder may hold masks and a description of others, which then count as corrections.
    """

    ct: Volume
    out: Path
    name: str = ""
    sources: Mapping[str, str] = field(default_factory=dict)
    ct_path: Path | None = None
    ct_series: str | None = None
    ex_vivo: bool = False
    thick_slices: bool = False
    large_radius_mm: float = LARGE_RADIUS_MM
    accept: tuple[str, ...] = ()
    seed_lps: Float | None = None
    given: Given = field(default_factory=Given)
    voxel_mm: float = VOXEL_MM
    force: bool = False

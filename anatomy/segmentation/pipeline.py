"""From a CT to a patient folder: every step that is not up to date, in order."""

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import Grid, Volume
from anatomy.io.frames import parse_point
from anatomy.io.own_masks import description_text
from anatomy.lobes import BORDER, LOBES, SEEN
from anatomy.machine_code.sources import version_of
from anatomy.plausibility import require_known_checks
from anatomy.segmentation.box import VOXEL_MM, Box
from anatomy.segmentation.canonical import canonical
from anatomy.segmentation.folder import SegmentationFolder, digest_of_ct
from anatomy.segmentation.input import has_thick_slices, require_chest_ct, slice_mm
from anatomy.segmentation.nodules import centre_of
from anatomy.segmentation.parts import Parts
from anatomy.segmentation.request import SegmentationRequest
from anatomy.segmentation.steps import VERSION, Steps
from anatomy.segmentation.vessels import border_mm, require_large_radius

Progress = Callable[[str], None]

MADE_MASKS = {
    "lumen": "airway.nii.gz", "wall": "airway_wall.nii.gz", "vessels": "vessels.nii.gz",
    "lung": "lungs.nii.gz", "cost": "cost.nii.gz",
}  # fmt: skip
"""Every segmentation makes these masks of a `patient.toml`."""
BYTES_PER_CT_VOXEL, BYTES_PER_VOXEL = 12, 30
"""Peak memory over the voxels of the CT, and over those of the box."""


@frozen_record
class Segmentation:
    """What a segmentation wrote; all images lie on the voxels of one `Box`, in the order of `canonical`.

    Steps not in `recomputed` were up to date; `corrected` images are a person's; `from_elsewhere` tells
    what images were given or made by a network, and from what; `kept_description` whether an edited
    `patient.toml` was kept.
    """

    folder: Path
    parts: Parts
    recomputed: tuple[str, ...]
    corrected: tuple[str, ...]
    from_elsewhere: Mapping[str, str]
    kept_description: bool
    warnings: tuple[str, ...]

    @property
    def grid(self) -> Grid:
        """The grid of all images."""
        return self.parts.ct.grid


def memory_estimate_gib(grid: Grid, voxel_mm: float = VOXEL_MM) -> float:
    """Return about how much memory the segmentation of a CT on this grid needs at most, in GiB."""
    finer = Box.whole(grid, voxel_mm).lattice
    # The box of the lungs of a very tall man: 350 x 260 x 330 mm.
    voxels = min(float(np.prod(finer.shape)), 30e6 / finer.voxel_volume_mm3)
    return (float(np.prod(grid.shape)) * BYTES_PER_CT_VOXEL + voxels * BYTES_PER_VOXEL) / 2**30


def segment(
    request: SegmentationRequest,
    progress: Progress | None = None,
    begun: Callable[[Parts], None] | None = None,
) -> Segmentation:
    """Segment a CT and write a patient folder that `anatomy.io.load_patient` reads.

    Steps whose inputs, settings and results are unchanged since the last run are not repeated; images that
    a person replaced in the folder are kept.  `patient.toml` is away while images change.

    Args:
        progress: Told each step as it begins.
        begun: See `anatomy.segmentation.steps.Steps`.

    Raises:
        AnatomyError: If the CT cannot be segmented, what was found cannot be a patient's lungs and airways,
            or the folder holds corrections of another CT.
        GridMismatchError: If a given mask does not fit the CT.
        SettingsError: If a check that is accepted is none, or vessels cannot be told by the radius.
        FileError: If a file cannot be read or written, or the folder holds inputs or files of others.
    """
    tell = progress or (lambda _step: None)
    tell("checking the CT")
    require_known_checks(request.accept)
    require_large_radius(request.large_radius_mm)
    request = replace(request, ct=canonical(request.ct))
    warnings = list(require_chest_ct(request.ct, thick_slices=request.thick_slices))
    grid = request.ct.grid
    stated = request.given.target
    target = None if stated is None else parse_point(stated)
    digest = digest_of_ct(request.ct)
    inputs = [Path(name) for name in (*request.given.hashes(), *request.sources)]
    folder = SegmentationFolder(request.out, grid, digest, inputs=inputs, force=request.force)
    folder.remember(ct_source=_ct_source(request))  # Early: a run that is refused goes on in this folder.
    steps = Steps(request, folder, digest, tell, begun)
    parts = steps.run()
    if parts.nodule.any() and target is None:
        target = centre_of(parts.nodule, parts.ct.grid)
    warnings += [*steps.warnings, *_target_warnings(target, parts, grid)]
    folder.save(provenance=_provenance(request, steps, warnings))
    thick_mm = slice_mm(request.ct) if has_thick_slices(request.ct) else 0.0
    # A given mask says itself which vessels are obstacles, and of its border nothing is known.
    large_mm = 0.0 if "vessels" in steps.given_names else request.large_radius_mm
    lobes = np.unique(parts.lobes[parts.lobes > 0]).tolist()
    fissures = [str(value) for value in (BORDER, SEEN) if (parts.fissures == value).any()]
    keys = {
        "name": request.name,
        **MADE_MASKS,
        "fissures": f"fissures.nii.gz#{','.join(fissures)}" if fissures else "",
        "fissure_band": "fissures.nii.gz" if fissures and lobes else "",
        "lobes": {LOBES[number]: f"lobes.nii.gz#{number}" for number in lobes},
        "warnings": tuple(folder.facts("lobes").get("warnings", ())),
        "nodule": "nodule.nii.gz" if parts.nodule.any() else "",
        "targets": () if target is None else ["lps:{:.3f},{:.3f},{:.3f}".format(*target)],
        "thick_slices_mm": thick_mm,
        "large_radius_mm": large_mm,
        "vessel_border_mm": border_mm(large_mm, slice_mm(request.ct)) if large_mm else (),
        "accepted": steps.accepted,
        "sources": steps.from_elsewhere,
    }
    return Segmentation(
        folder=folder.path,
        parts=parts,
        recomputed=tuple(steps.recomputed),
        corrected=tuple(steps.corrected),
        from_elsewhere=steps.from_elsewhere,
        kept_description=folder.describe(description_text(keys)),
        warnings=tuple(warnings),
    )


def _target_warnings(target_lps: Float | None, parts: Parts, ct_grid: Grid) -> list[str]:
    """Warn of a target that lies outside the lungs or in an obstacle."""
    if target_lps is None:
        return []
    place = f"The target at LPS ({', '.join(f'{x:.1f}' for x in target_lps)}) mm"
    if not bool(ct_grid.contains(target_lps)):
        return [f"{place} lies outside the image: check its frame."]
    grid = parts.ct.grid
    i, j, k = np.clip(grid.voxels(target_lps), 0, np.array(grid.shape) - 1).tolist()
    if parts.nodule[i, j, k]:
        return []
    if not (parts.left[i, j, k] or parts.right[i, j, k]):
        return [f"{place} lies outside the lungs; if it is in a nodule, outline that with --nodule."]
    if parts.large_vessels[i, j, k]:
        return [f"{place} lies in what was taken for a large vessel; outline a nodule with --nodule."]
    return []


def _ct_source(request: SegmentationRequest) -> Mapping[str, Any] | None:
    """Return where the CT lies, seen from the folder where one can, so that both may move together."""
    if request.ct_path is None:
        return None
    path = request.ct_path.resolve()
    with suppress(ValueError):  # two drives of Windows
        path = Path(os.path.relpath(path, request.out.resolve()))
    return {"path": path.as_posix(), "series": request.ct_series}


def _provenance(request: SegmentationRequest, steps: Steps, warnings: list[str]) -> Mapping[str, Any]:
    return {
        "lungaccess": version_of("lungaccess") or "unknown (not installed)",
        "steps_version": VERSION,
        "numpy": np.__version__,
        "ct_grid": request.ct.grid.describe(),
        "grid": steps.grid.describe(),
        "voxel_mm": request.voxel_mm,
        "ct_files": dict(request.sources),
        "given_files": request.given.hashes(),
        "ex_vivo": request.ex_vivo,
        "thick_slices": request.thick_slices,
        "large_radius_mm": request.large_radius_mm,
        "accepted": list(steps.accepted),
        "seed_lps": None if request.seed_lps is None else request.seed_lps.tolist(),
        "nodules": list(request.given.nodules),
        "corrected": steps.corrected,
        "from_elsewhere": steps.from_elsewhere,
        "warnings": warnings,
    }


def read_ct(path: str | Path, series_uid: str | None = None) -> tuple[Volume, dict[str, str]]:
    """Read a CT from an image file or a folder of DICOM files, in the order of voxels of `canonical`.

    Also returned are the files read, with their SHA-256.  Raises FileError or FrameError if there is no CT,
    or it cannot be read; see `anatomy.io.read_dicom` and `anatomy.io.read_volume`.
    """
    from anatomy.base.errors import FileError
    from anatomy.base.files import sha256
    from anatomy.io.dicom import list_series, read_dicom
    from anatomy.io.images import image_suffix, read_volume

    path = Path(path)
    if path.is_dir():
        volume = read_dicom(path, series_uid)
        chosen = [s for s in list_series(path) if series_uid in (None, s.uid)]
        files = sorted(file for series in chosen for file in series.paths)
        return canonical(volume), {file.relative_to(path).as_posix(): sha256(file) for file in files}
    if path.is_file() and image_suffix(path) is None:
        raise FileError(
            f"{path} is no image of a known kind",
            expected="a folder of DICOM files, or a NIfTI, NRRD or MetaImage file",
            remedy="Give the folder that holds the DICOM series",
        )
    return canonical(read_volume(path)), {path.name: sha256(path)}

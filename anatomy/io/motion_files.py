"""Reads what a patient.toml says of breathing: a displacement field, a transform, landmarks, two images."""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from anatomy.base.errors import AnatomyError, FileError, FrameError, SettingsError
from anatomy.base.files import read_text, reading, reason, require_file, unreadable
from anatomy.base.settings import quantity, settings, switch, text
from anatomy.base.typed import Array, Float
from anatomy.grid import Grid, transform_points
from anatomy.io import images, transform_values
from anatomy.io.frames import LPS_FROM, LPS_FROM_RAS, MOST_COORDINATE_MM
from anatomy.io.voxels import read_array
from anatomy.motion.source import MotionSource

TRANSFORMS = (".h5", ".hdf5", ".tfm", ".txt", ".mat", ".xfm")
LANDMARKS = ".csv"
SAMPLE_MM = 4.0
"""Spacing of the points at which a transform is evaluated: finer than the nodes of a motion."""
TRANSFORM_S = 300.0
"""A transform that takes longer is damaged: others take a second."""
MOST_DISPLACEMENT_MM = 1000.0
"""No tissue moves so far; what is plausible for a lung is judged where its place in the lung is known."""
MEDIAN_MOTION_MM = 17.3
"""Median of the population's 95 % motion (exp 2.85)."""
WORKING_MM = 4.0
"""Voxels that are registered: what is left of a good registration is 1 mm, and motion varies over cm."""
ITERATIONS = 60
"""The optimiser makes at most so many on each level; in a lung it has converged before."""
DEPTH_MM = 20.0
"""Masks are compared by their distance to the border, up to so far from it."""


@settings
class MotionFile:
    """The keys of [motion] in a `patient.toml`: `file`, `end_exhale` and `end_inhale`, or `population`."""

    file: Annotated[str, text("Displacement field, ITK transform or landmark pairs", may_be_empty=True)] = ""
    end_exhale: Annotated[str, text("Image or mask of the lungs at end-exhale", may_be_empty=True)] = ""
    end_inhale: Annotated[str, text("The same at end-inhale, to be registered", may_be_empty=True)] = ""
    population: Annotated[bool, switch("Whether other people's motion is to be used, as a warning")] = False
    population_motion_mm: Annotated[
        float, quantity("95 % motion of the patient for the population's model", above=0.0, at_most=60.0)
    ] = MEDIAN_MOTION_MM
    maps_from: Annotated[
        Literal["", "end-exhale", "end-inhale"],
        Field(description="Where the points of a field or transform lie"),
    ] = ""
    frame: Annotated[Literal["", "lps", "ras"], Field(description="Frame of landmark pairs")] = ""
    masks_phase: Annotated[
        float | None,
        quantity("Phase that the masks show: 0 end-exhale, 1 end-inhale", at_least=0.0, at_most=1.0),
    ] = None
    amplitude: Annotated[
        float, quantity("Share of the source's motion that the patient has", at_least=0.0, at_most=3.0)
    ] = 1.0
    hysteresis: Annotated[
        float,
        quantity("How far places stray against each other, by their distance", at_least=0.0, at_most=0.1),
    ] = 0.0
    other_lungs: Annotated[
        str, text("Mask of the lungs at the end of the breath farther from the masks'", may_be_empty=True)
    ] = ""

    @property
    def files(self) -> tuple[str, ...]:
        """The files that are named, some of them empty."""
        return (self.file, self.end_exhale, self.end_inhale, self.other_lungs)


def read_motion(keys: MotionFile, folder: Path, masks: Grid) -> MotionSource:
    """Read the motion that a patient.toml names; paths are relative to its folder.

    A displacement field or transform follows ITK: at a point p in LPS mm stands the vector, LPS mm, that
    leads p to the same tissue at the other end of the breath.  (NIfTI fields with the intent code 1006 are
    RAS on disk.)  Landmark pairs are lines of six numbers: a place at end-exhale and the same tissue at
    end-inhale.  A transform is evaluated over the grid of the masks.

    Raises:
        SettingsError: If the keys contradict each other, or the phase of the masks or the direction is not
            stated.
        FileError: If a file is missing, damaged or of another kind.
        FrameError: If a file states no frame, or one in which vectors are not LPS.
        AnatomyError: If a file holds numbers that are not finite.
    """
    if keys.masks_phase is None:
        raise SettingsError(
            "[motion] of patient.toml does not say in which phase of the breath the masks were taken",
            expected="masks_phase from 0 (end-exhale) to 1 (end-inhale)",
            remedy="Write masks_phase = 0.0 where the CT was taken at end-exhale, 1.0 at end-inhale of quiet "
            "breathing, 0.5 halfway; a CT of deep inspiration lies beyond all of them and cannot be used",
        )
    kinds = [bool(keys.file), bool(keys.end_exhale or keys.end_inhale), keys.population]
    if sum(kinds) != 1 or bool(keys.end_exhale) != bool(keys.end_inhale):
        raise SettingsError(
            "[motion] of patient.toml names " + ("nothing" if not any(kinds) else "more than one motion"),
            expected="one of: file; end_exhale and end_inhale; population = true",
            remedy='Write for instance file = "field.nrrd", maps_from = "end-exhale"',
        )
    common: dict[str, Any] = {key: getattr(keys, key) for key in ("masks_phase", "amplitude", "hysteresis")}
    if keys.other_lungs:
        common["other_lungs"] = images.read_mask(folder / keys.other_lungs, role="lung")
    if keys.population:
        words = f"population: other people's motion by height, {keys.population_motion_mm:g} mm"
        return MotionSource(description=words, population_motion_mm=keys.population_motion_mm, **common)
    if keys.end_exhale:
        exhale, inhale = folder / keys.end_exhale, folder / keys.end_inhale
        grid, vectors = _register(exhale, inhale)
        words = f"registration of {keys.end_exhale} and {keys.end_inhale}"
        return MotionSource(description=words, grid=grid, vectors=vectors, **common)
    path = require_file(folder / keys.file)
    if path.suffix.lower() == LANDMARKS:
        if not keys.frame:
            raise FrameError(
                f"[motion] of patient.toml does not state the frame of {path.name}",
                expected='frame = "lps" or frame = "ras"',
                remedy="3D Slicer shows RAS coordinates, DICOM and ITK use LPS",
            )
        exhale_lps, inhale_lps = read_landmarks(path, keys.frame)
        words = f"{len(exhale_lps)} landmark pairs of {keys.file}"
        return MotionSource(description=words, exhale_lps=exhale_lps, inhale_lps=inhale_lps, **common)
    if not keys.maps_from:
        raise SettingsError(
            f"[motion] of patient.toml does not say at which end of the breath the points of {keys.file} lie",
            expected="maps_from",
            remedy='Write maps_from = "end-exhale" where end-exhale was the fixed image of the registration, '
            'else maps_from = "end-inhale"',
        )
    grid, vectors = read_transform(path, masks) if images.image_suffix(path) is None else read_vectors(path)
    return MotionSource(
        description=f"displacement of {keys.file}, from {keys.maps_from}",
        maps_from=keys.maps_from,
        grid=grid,
        vectors=vectors,
        **common,
    )


def read_landmarks(path: Path, frame: str) -> tuple[Float, Float]:
    """Return the places `(N, 3)` LPS mm at end-exhale and at end-inhale that a CSV of six columns states.

    Lines that begin with a letter or # are headings.  Raises FileError if a line does not hold six finite
    numbers.
    """
    rows, lps = [], LPS_FROM[frame]
    for number, line in enumerate(read_text(path).splitlines(), 1):
        if not line.strip() or line.lstrip()[0] == "#" or line.lstrip()[0].isalpha():
            continue
        try:
            row = [float(each) for each in line.replace(";", ",").split(",")]
        except ValueError:
            row = []
        if len(row) != 6 or not (np.abs(row) <= MOST_COORDINATE_MM).all():
            raise FileError(
                f"Line {number} of {path} is {line.strip()!r:.60}",
                expected="six finite numbers: x, y, z at end-exhale, then x, y, z at end-inhale, mm",
                remedy="Correct the line",
            )
        rows.append(row)
    values = np.array(rows, dtype=np.float64).reshape(-1, 6)
    return transform_points(lps, values[:, :3]), transform_points(lps, values[:, 3:])


def read_vectors(path: Path) -> tuple[Grid, Float]:
    """Return the grid and the vectors `(ni, nj, nk, 3)` LPS mm of an image of displacements.

    Raises FileError if it is no complete image of three dimensions with three numbers a voxel, FrameError if
    it states no frame, its vectors may not be LPS, or its axes are not perpendicular, and AnatomyError if a
    number is not finite.
    """
    with reading(path):
        header, stream = images.open_image(path, None, components=3)
        vectors = read_array(header, stream, path)
    if header.vectors_are_ras:
        vectors = vectors * LPS_FROM_RAS.diagonal()[:3].astype(vectors.dtype)
    return header.grid, _finite(vectors, path)


def read_transform(path: Path, masks: Grid) -> tuple[Grid, Float]:
    """Return grid and displacements of an ITK transform, evaluated over the grid of the masks.

    Raises FileError if it is no transform of three dimensions that ITK reads, and AnatomyError if it moves
    nothing, or farther than a lung is large.
    """
    if path.suffix.lower() not in TRANSFORMS:
        raise FileError(
            f"{path} is of an unknown kind",
            expected=f"a displacement field ({', '.join(images.SUFFIXES)}), an ITK transform "
            f"({', '.join(TRANSFORMS)}) or landmark pairs ({LANDMARKS})",
            remedy="Export the registration in one of them",
        )
    low, high = masks.corners_lps.min(axis=0), masks.corners_lps.max(axis=0)
    grid = Grid.over(low, high, SAMPLE_MM)
    numbers = ",".join(repr(float(n)) for n in (*low, *grid.shape, *grid.spacing_mm))
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "values.npy")
        command = [sys.executable, "-P", transform_values.__file__, str(path.resolve()), numbers, str(out)]
        try:
            done = subprocess.run(command, capture_output=True, timeout=TRANSFORM_S, check=False)
            said = done.stderr.decode("utf-8", errors="replace")
            why = ValueError(said if done.returncode > 0 else f"ITK ended with {done.returncode}")
        except subprocess.TimeoutExpired:
            why = ValueError(f"ITK takes more than {TRANSFORM_S:g} s")
        if not out.is_file():
            raise unreadable(path, why)
        vectors = np.load(out).transpose(2, 1, 0, 3)
    return grid, _finite(vectors, path)


def _finite(vectors: Array, path: Path) -> Float:
    vectors = np.ascontiguousarray(vectors, dtype=np.float64)
    farthest = float(np.abs(vectors).max())
    if not 0.0 < farthest <= MOST_DISPLACEMENT_MM:
        raise AnatomyError(
            f"{path} holds displacements that are not finite"
            if not np.isfinite(farthest)
            else f"{path} holds displacements of at most {farthest:.3g} mm",
            expected=f"finite numbers in mm, some of them not 0, none above {MOST_DISPLACEMENT_MM:g}",
            remedy="Register again, or fill what is missing",
        )
    return vectors


def write_vectors(path: str | Path, grid: Grid, vectors: Float) -> None:
    """Write a displacement field, `(ni, nj, nk, 3)` LPS mm, in single precision, as `read_vectors` reads it.

    Raises FileError if the folder cannot be written to.
    """
    images.write_image(images.itk_image(vectors.astype(np.float32), grid), Path(path), components=3)


def _register(exhale: Path, inhale: Path) -> tuple[Grid, Float]:
    """Return a displacement field `(ni, nj, nk, 3)` LPS mm from end-exhale to end-inhale: a B-spline.

    CTs are compared by correlation; two masks by the distance to their borders, which tells nothing of the
    motion inside but what the border implies.  Raises AnatomyError if an image is constant, or one is a mask
    and the other is not, or nothing is found, and FileError or FrameError as `anatomy.io.read_volume`.
    """
    import SimpleITK

    fixed, fixed_is_mask = _image(exhale)
    moving, moving_is_mask = _image(inhale)
    if fixed_is_mask != moving_is_mask:
        raise AnatomyError(
            f"Of {exhale.name} and {inhale.name} one is a mask and the other is not",
            expected="two CTs, or two masks of the lungs",
        )
    size = np.array(fixed.GetSize()) * fixed.GetSpacing()
    # Distance of the control points of the spline: a lung has several along each axis.
    start = SimpleITK.BSplineTransformInitializer(fixed, [max(int(round(n / 40.0)), 2) for n in size])
    method = SimpleITK.ImageRegistrationMethod()
    if fixed_is_mask:
        method.SetMetricAsMeanSquares()
    else:
        method.SetMetricAsCorrelation()
    method.SetInterpolator(SimpleITK.sitkLinear)
    method.SetOptimizerAsLBFGSB(numberOfIterations=ITERATIONS)
    method.SetShrinkFactorsPerLevel([2, 1])
    method.SetSmoothingSigmasPerLevel([1.0, 0.0])
    method.SetInitialTransform(start, inPlace=True)
    try:
        method.Execute(fixed, moving)
    except RuntimeError as error:
        raise AnatomyError(
            f"{exhale.name} and {inhale.name} could not be registered ({reason(error)})",
            expected="two images of the same lungs that overlap",
            remedy="Register them by a program of your own, and name its displacement field in file",
        ) from error
    field = SimpleITK.TransformToDisplacementField(
        start, SimpleITK.sitkVectorFloat64, fixed.GetSize(), fixed.GetOrigin(), fixed.GetSpacing(),
        fixed.GetDirection(),
    )  # fmt: skip
    vectors = SimpleITK.GetArrayFromImage(field).transpose(2, 1, 0, 3)
    grid = Grid.from_spacing(fixed.GetSize(), fixed.GetSpacing(), fixed.GetOrigin())
    return grid, np.ascontiguousarray(vectors)


def _image(path: Path) -> tuple[Any, bool]:
    """Return an image on voxels of `WORKING_MM` along LPS, and whether it is a mask."""
    from scipy import ndimage

    volume = images.read_volume(path)
    values = volume.array
    if values.min() == values.max():
        raise AnatomyError(f"{path} has one value everywhere", expected="a CT, or a mask of the lungs")
    is_mask = bool(np.isin(values, (0, values.max())).all())
    grid = volume.grid
    low, high = grid.corners_lps.min(axis=0), grid.corners_lps.max(axis=0)
    coarse = Grid.over(low, high, WORKING_MM)
    smooth = ndimage.gaussian_filter(values.astype(np.float32), 0.4 * WORKING_MM / grid.spacing_mm)
    index = grid.ijk(coarse.centres_lps)
    out = ndimage.map_coordinates(smooth, np.moveaxis(index, -1, 0), order=1, mode="nearest")
    if is_mask:
        inside = out > 0.5 * float(values.max())
        out = ndimage.distance_transform_edt(inside, sampling=WORKING_MM)
        out = np.clip(out - ndimage.distance_transform_edt(~inside, sampling=WORKING_MM), -DEPTH_MM, DEPTH_MM)
    return images.itk_image(out.astype(np.float32), coarse), is_mask

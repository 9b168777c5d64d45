"""Registers the lungs at end-exhale and end-inhale: two CTs, or two masks."""

from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.files import reason
from anatomy.base.typed import Float
from anatomy.grid import Grid
from anatomy.io.images import itk_image, read_volume

WORKING_MM = 4.0
"""Voxels that are registered: what is left of a good registration is 1 mm, and motion varies over cm."""
CONTROL_MM = 40.0
"""Distance of the control points of the spline: a lung has several along each axis."""
ITERATIONS = 60
"""The optimiser makes at most so many on each level; in a lung it has converged before."""
DEPTH_MM = 20.0
"""Masks are compared by their distance to the border, up to so far from it."""


def register(exhale: Path, inhale: Path) -> tuple[Grid, Float]:
    """Return a displacement field from end-exhale to end-inhale: a B-spline by mutual similarity.

    CTs are compared by correlation; two masks by the distance to their borders, which tells nothing of the
    motion inside but what the border implies.

    Returns
    -------
    Grid, (ni, nj, nk, 3) float64
        LPS mm.

    Raises
    ------
    AnatomyError
        If an image is constant, or one is a mask and the other is not, or nothing is found.
    FileError, FrameError
        As `anatomy.io.read_volume`.
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
    mesh = [max(int(round(n / CONTROL_MM)), 2) for n in size]
    start = SimpleITK.BSplineTransformInitializer(fixed, mesh)
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

    volume = read_volume(path)
    values = volume.array
    if values.min() == values.max():
        raise AnatomyError(f"{path} has one value everywhere", expected="a CT, or a mask of the lungs")
    is_mask = bool(np.isin(values, (0, values.max())).all())
    grid = volume.grid
    low, high = grid.corners_lps.min(axis=0), grid.corners_lps.max(axis=0)
    coarse = Grid.from_spacing(np.ceil((high - low) / WORKING_MM).astype(int) + 1, (WORKING_MM,) * 3, low)
    smooth = ndimage.gaussian_filter(values.astype(np.float32), 0.4 * WORKING_MM / grid.spacing_mm)
    index = grid.ijk(coarse.lps(np.moveaxis(np.indices(coarse.shape), 0, -1)))
    out = ndimage.map_coordinates(smooth, np.moveaxis(index, -1, 0), order=1, mode="nearest")
    if is_mask:
        inside = out > 0.5 * float(values.max())
        out = ndimage.distance_transform_edt(inside, sampling=WORKING_MM)
        out = np.clip(out - ndimage.distance_transform_edt(~inside, sampling=WORKING_MM), -DEPTH_MM, DEPTH_MM)
    return itk_image(out.astype(np.float32), coarse), is_mask

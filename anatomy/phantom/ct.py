"""The CT of a phantom: Hounsfield units of partly covered voxels, blurred, with noise."""

from __future__ import annotations

import numpy as np

from anatomy.base.typed import Array, Float32
from anatomy.grid import Volume
from anatomy.phantom.rasterize import LABELS, Canvas

AIR_HU = -1000.0
"""By definition of the scale."""
BULLA_HU = -985.0
"""Air with a trace of tissue."""
PARENCHYMA_HU = -860.0
"""Lung after breathing in."""
GRAVITY_HU_PER_MM = 0.35
"""Lung is denser towards the back of a patient who lies on it: about 70 HU over 200 mm."""
WALL_HU = 0.0
"""Walls are soft tissue that thin airways share with air."""
SOLID_HU = 40.0
"""Blood without contrast medium, and nodules."""
FISSURE_HU, FISSURE_THICKNESS_MM = -400.0, 0.6
"""A fissure is a double layer of pleura, thinner than a voxel."""
TISSUE_HU = {"background": AIR_HU, "soft_tissue": 20.0, "mediastinum": 30.0, "heart": 40.0, "bone": 420.0}
"""Usual values of these tissues."""
BLUR_SIGMA_MM = 0.6
"""Point spread of a usual reconstruction kernel: about 1.4 mm full width at half maximum."""
LEAST_HU, GREATEST_HU = -1024, 3071
"""Range of a CT of 12 bits."""


def simulate_ct(canvas: Canvas, noise_hu: float, rng: np.random.Generator) -> Volume:
    """Return the int16 CT in HU: material shares, Gaussian point spread of 0.6 mm, white noise.

    The patient lies on the back, so the lung is denser towards +y.
    """
    from scipy.ndimage import gaussian_filter

    image = _materials(canvas)
    sigma = BLUR_SIGMA_MM / canvas.spacing_mm
    # Passing the transpose keeps the filter's passes along memory; the blur is isotropic.
    gaussian_filter(image.T, sigma, output=image.T, truncate=3.0, mode="nearest")
    image.T[...] += np.float32(noise_hu) * rng.standard_normal(image.T.shape, dtype=np.float32)
    np.rint(image, out=image)
    np.clip(image, LEAST_HU, GREATEST_HU, out=image)
    return Volume(grid=canvas.grid, array=image.astype(np.int16))


def _materials(canvas: Canvas) -> Float32:
    """Mix the HU of what each voxel holds, slab by slab to stay in the cache."""
    shape = canvas.grid.shape
    image = np.zeros(shape, dtype=np.float32, order="F")
    table = np.full(len(LABELS), TISSUE_HU["mediastinum"], dtype=np.float32)
    for name, tissue in TISSUE_HU.items():
        table[LABELS[name]] = tissue
    y = canvas.grid.lps_from_ijk[1, 3] + canvas.spacing_mm * np.arange(shape[1])
    lung = (PARENCHYMA_HU + GRAVITY_HU_PER_MM * y).astype(np.float32)[None, :]
    sheet = np.float32(min(1.0, FISSURE_THICKNESS_MM / canvas.spacing_mm))
    for k in range(shape[2]):
        labels = canvas.labels[:, :, k]
        lobes = canvas.lobes[:, :, k] > 0
        value: Array = table[labels]
        inside = np.where(labels == LABELS["fissure"], lung + sheet * (FISSURE_HU - lung), lung)
        inside = np.where(labels == LABELS["bulla"], np.float32(BULLA_HU), inside)
        share = canvas.lung_cover[:, :, k] * np.float32(1 / 255)
        value = np.where(lobes, np.float32(TISSUE_HU["mediastinum"]), value)
        value += share * (inside - value)
        value += canvas.solid_cover[:, :, k] * np.float32(1 / 255) * (np.float32(SOLID_HU) - value)
        value += canvas.airway_cover[:, :, k] * np.float32(1 / 255) * (np.float32(WALL_HU) - value)
        value += canvas.lumen_cover[:, :, k] * np.float32(1 / 255) * (np.float32(AIR_HU) - value)
        image[:, :, k] = value
    return image

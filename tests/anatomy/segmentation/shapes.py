"""Shapes like vessels and what is taken for them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def distance_to_surface(shape: str, radius_mm: float, spacing_mm: ArrayLike, size_mm: float) -> np.ndarray:
    """Return the signed distance to a cylinder, plate or ball in the middle of a cube, mm."""
    spacings = np.broadcast_to(spacing_mm, 3).tolist()
    counts = [int(size_mm / spacing) for spacing in spacings]
    axes = [(np.arange(n) - (n - 1) / 2) * spacing for n, spacing in zip(counts, spacings, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    along = np.array([0.3, 0.2, 0.93]) / np.linalg.norm([0.3, 0.2, 0.93])
    if shape == "cylinder":
        away = np.linalg.norm(points - (points @ along)[..., None] * along, axis=-1)
    elif shape == "plate":
        away = np.abs(points @ along)
    else:
        away = np.linalg.norm(points, axis=-1)
    return away - radius_mm

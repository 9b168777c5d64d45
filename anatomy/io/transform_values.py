"""Evaluates an ITK transform in a process of its own, because ITK's readers may end the process they run in.

Run as a script with a file, the origin and the size of a grid, its spacing in mm, and a file for the vectors.
"""

import contextlib
import sys

import numpy as np

MOST_MEMORY_BYTES = 8 << 30
"""Reading a transform may take this memory: no chest needs as much, and a damaged file may ask for all."""


def _write_values(path: str, grid: str, out: str) -> None:
    """Write the displacements of a transform at the points of a grid, (nk, nj, ni, 3) float64 LPS mm."""
    import SimpleITK

    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY_BYTES, MOST_MEMORY_BYTES))
    origin, size, spacing = np.array([float(word) for word in grid.split(",")]).reshape(3, 3)
    transform = SimpleITK.ReadTransform(path)
    if transform.GetDimension() != 3:
        raise ValueError(f"it is a transform of {transform.GetDimension()} dimensions, not of 3")
    image = SimpleITK.TransformToDisplacementField(
        transform, SimpleITK.sitkVectorFloat64, size.astype(int).tolist(), origin.tolist(), spacing.tolist()
    )
    np.save(out, SimpleITK.GetArrayViewFromImage(image))


if __name__ == "__main__":
    _write_values(*sys.argv[1:])

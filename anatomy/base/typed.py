"""The array types of the whole project.

An alias names what the numbers are; the shape, the unit and the frame of each array stand in the docstrings.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
"""Numbers of any type."""

Float = NDArray[np.float64]
"""Lengths, positions, angles, matrices: whatever is computed in double precision."""

Float32 = NDArray[np.float32]
"""Values at voxels that are kept in single precision: distances, vesselness, costs of a cost map."""

Int = NDArray[np.int64]
"""Indices and counts."""

Int32 = NDArray[np.int32]
"""Indices and counts of which there are so many that their memory matters."""

Int16 = NDArray[np.int16]
"""Hounsfield units of a CT."""

UInt8 = NDArray[np.uint8]
"""Small numbers at voxels, classes, states, and the bytes of pictures and files."""

UInt16 = NDArray[np.uint16]
"""Distances as fixed-point numbers."""

UInt64 = NDArray[np.uint64]
"""Sets of bits, and the states of random generators."""

Bool = NDArray[np.bool_]
"""One answer, yes or no, for each row of a table."""

Mask = NDArray[np.bool_]
"""The voxels of a grid that belong to something."""

Labels = NDArray[np.uint16]
"""The labels of a lung's voxels: bits of `anatomy.structures` and the number of a branch."""

"""The air around the patient, told apart from lungs that reach the edge of the image."""

import numpy as np

from anatomy.base.typed import Float32, Mask

OUTSIDE_HU = -950.0
"""Air that touches the edge of a slice and has a median below this is not lung."""


def outside_air(hu: Float32, air: Mask) -> Mask:
    """Mark the air around the patient.

    In every axial slice, pieces of air that touch the edge of the image are taken, because the chest wall
    closes the lungs off within a slice even where mouth or trachea open to the outside.  Where the field
    of view cuts off the skin, a lung may touch the edge too; the lung holds tissue, so its median is
    higher than that of air.

    Parameters
    ----------
    hu : (Ni, Nj, Nk) float32
        Coarse CT, axis 2 along the body.
    air : (Ni, Nj, Nk) bool
        Voxels of air and lung.

    Returns
    -------
    (Ni, Nj, Nk) bool
    """
    from scipy import ndimage

    outside = np.zeros(air.shape, dtype=np.bool_, order="F")
    for k in range(air.shape[2]):
        pieces, count = ndimage.label(air[:, :, k])
        if not count:
            continue
        edge = np.concatenate([pieces[0], pieces[-1], pieces[:, 0], pieces[:, -1]])
        touching = np.unique(edge[edge > 0])
        sizes = np.bincount(pieces.ravel(), minlength=count + 1)
        thin = np.bincount(pieces[hu[:, :, k] < OUTSIDE_HU], minlength=count + 1)
        chosen = np.zeros(count + 1, dtype=np.bool_)
        chosen[touching] = 2 * thin[touching] > sizes[touching]
        outside[:, :, k] = chosen[pieces]
    return outside

"""Nodules that lie on the chest wall: notches of the lung too wide for its closing."""

import numpy as np

from anatomy.base.typed import Int, Mask
from anatomy.morphology import bounds, window
from anatomy.segmentation.closing import closed, distance_mm, without_holes
from anatomy.segmentation.coarse import CoarseCt

NOTCH_MM = 12.0
"""Ball of the wider closing: notches of up to about 24 mm across become lung."""
BELOW_HULL_MM = 15.0
"""Half the diameter of the largest nodule that is not called a mass, 30 mm."""
FROM_OTHER_LUNG_MM = 40.0
"""A notch of the chest wall lies near the convex hull of both lungs and far from the other lung; what does
not may be the heart, the aorta or the hilum, and stays outside."""
LEAST_HALF_THICKNESS_MM = 2.0
"""Ribs indent the lung less than this."""
SOFT_HU = 150.0
"""Bone is denser on coarse voxels."""


def notches(ct: CoarseCt, right: Mask, left: Mask, closing_mm: float) -> tuple[Mask, Mask]:
    """Return nodule-like notches in the costal side of each lung, bool `(Ni, Nj, Nk)` on coarse voxels.

    One lung may be empty; a closing of the radius `closing_mm` fills what is narrower anyway.
    """
    hull = _near_hull(right | left, ct)
    return _notches_of(ct, right, left, hull, closing_mm), _notches_of(ct, left, right, hull, closing_mm)


def _notches_of(ct: CoarseCt, side: Mask, other: Mask, hull: Mask, closing_mm: float) -> Mask:
    """Return the notches of one lung that lie near the hull of both."""
    found = np.zeros(side.shape, dtype=np.bool_, order="F")
    pad = np.ceil(2.0 * NOTCH_MM / np.asarray(ct.spacing_mm)).astype(np.int64)
    box = window(*bounds(side, pad))
    filled = without_holes(closed(np.asfortranarray(side[box]), closing_mm, ct.spacing_mm))
    added = closed(filled, NOTCH_MM, ct.spacing_mm) & ~filled & (ct.hu[box] < SOFT_HU) & hull[box]
    core = distance_mm(added, ct.spacing_mm) > LEAST_HALF_THICKNESS_MM
    if core.any() and other.any():
        core &= distance_mm(~other, ct.spacing_mm)[box] > FROM_OTHER_LUNG_MM
    if core.any():
        found[box] = added & (distance_mm(~core, ct.spacing_mm) <= 2.0 * LEAST_HALF_THICKNESS_MM)
    return found


def _near_hull(lungs: Mask, ct: CoarseCt) -> Mask:
    """Mark, in every axial slice, what lies close below the convex hull of both lungs."""
    import edt
    from skimage.morphology import convex_hull_image

    near = np.zeros(lungs.shape, dtype=np.bool_, order="F")
    for k in np.flatnonzero(lungs.any(axis=(0, 1))):
        hull = np.asfortranarray(convex_hull_image(lungs[:, :, k]))
        depth = edt.edt(hull, anisotropy=ct.spacing_mm[:2], order="F", black_border=True)
        near[:, :, k] = hull & (depth <= BELOW_HULL_MM)
    _clear_edge(near, np.ceil(NOTCH_MM / np.asarray(ct.spacing_mm)).astype(np.int64))
    return near


def _clear_edge(mask: Mask, width: Int) -> None:
    """Empty the border of an array: near the edge of the image a closing cannot tell notch from outside."""
    for axis, n in enumerate(width):
        layers = np.moveaxis(mask, axis, 0)
        layers[:n] = False
        layers[-n:] = False

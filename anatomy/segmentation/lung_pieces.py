"""The lung among all the air of a chest: pieces of air at the bronchi.

The gas beside them and the air outside are left out, and the notches of nodules that lie on the chest wall,
too wide for a closing of the lung, are filled.
"""

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float32, Int, Mask
from anatomy.morphology import bounds, window
from anatomy.segmentation.closing import closed, distance_mm, near, without_holes
from anatomy.segmentation.coarse import CoarseCt

SMALLEST_LUNG_ML = 150.0
"""The smallest lung of a child after breathing out is about this large."""
GAS_RADIUS_MM = 4.0
"""A ball of this radius fits into a pocket of gas that matters, but into no airway beyond the main
bronchi."""
NOTCH_MM = 12.0
"""Ball of the wider closing: notches of up to about 24 mm across become lung."""
LEAST_HALF_THICKNESS_MM = 2.0
"""Ribs indent the lung less than this."""


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
        # Air that touches the edge of a slice and has a median below this is not lung.
        thin = np.bincount(pieces[hu[:, :, k] < -950.0], minlength=count + 1)
        chosen = np.zeros(count + 1, dtype=np.bool_)
        chosen[touching] = 2 * thin[touching] > sizes[touching]
        outside[:, :, k] = chosen[pieces]
    return outside


def lung_pieces(coarse: CoarseCt, air: Mask, airway: Mask) -> Mask:
    """Keep the pieces of air that are as large as a lung and lie at the bronchi.

    Parameters
    ----------
    coarse : CoarseCt
    air : (Ni, Nj, Nk) bool
        What is as thin as lung, without the airway and the outside.
    airway : (Ni, Nj, Nk) bool
        Trachea and bronchi as far as they could be followed.

    Raises
    ------
    AnatomyError
        If there is none.
    """
    from scipy import ndimage

    pieces, count = ndimage.label(air)
    volumes_ml = np.bincount(pieces.ravel(), minlength=count + 1) * coarse.voxel_ml
    volumes_ml[0] = 0.0
    large = volumes_ml >= SMALLEST_LUNG_ML
    at_bronchi = np.zeros(count + 1, dtype=np.bool_)
    # Wall of a main bronchus and the tissue around it: lung begins within this distance of the bronchi.
    at_bronchi[np.unique(pieces[near(airway, 10.0, coarse.spacing_mm)])] = True
    lung = large & at_bronchi
    if not lung.any():
        largest = f"the largest piece of air inside has {volumes_ml.max():.0f} ml"
        if large.any():
            largest = f"none of the {np.count_nonzero(large)} large pieces of air in it lies at the bronchi"
        raise AnatomyError(
            f"The image holds no lung: {largest}",
            expected="a CT of the chest with trachea, bronchi and lungs",
            remedy="Choose the series of the chest; for an inflated lung outside a body use --ex-vivo",
        )
    # A lung has at least this share of the other's volume; a smaller piece of air is something else.
    lung &= volumes_ml >= 0.1 * volumes_ml[lung].max()
    return np.asfortranarray(lung[pieces])


def gas_pockets(coarse: CoarseCt, lung: Mask, air_hu: float) -> Mask:
    """Mark gas that no tissue runs through: a pneumothorax, or a bulla.

    Parameters
    ----------
    coarse : CoarseCt
    lung : (Ni, Nj, Nk) bool
        What was taken for lung.
    air_hu : float
        What air measures in this image.
    """
    from scipy import ndimage

    found = np.zeros(lung.shape, dtype=np.bool_, order="F")
    box = window(*bounds(lung, 1))
    # Gas outside the lung is as thin as air; lung with severe emphysema, at -950 HU, is denser than this.
    thin = ndimage.uniform_filter(coarse.hu[box], 3, mode="nearest") < air_hu + 25.0
    thin &= lung[box]
    core = distance_mm(np.asfortranarray(thin), coarse.spacing_mm) > GAS_RADIUS_MM
    if not core.any():
        return found
    pocket = (distance_mm(np.asfortranarray(~core), coarse.spacing_mm) <= GAS_RADIUS_MM + 1.5) & lung[box]
    pieces, count = ndimage.label(pocket)
    volumes_ml = np.bincount(pieces.ravel(), minlength=count + 1) * coarse.voxel_ml
    volumes_ml[0] = 0.0
    # Holes of emphysema are smaller; a layer of gas over half a lung, 4 mm thick, is larger.
    found[box] = (volumes_ml >= 20.0)[pieces]
    return found


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
    # Bone is denser on coarse voxels.
    added = closed(filled, NOTCH_MM, ct.spacing_mm) & ~filled & (ct.hu[box] < 150.0) & hull[box]
    core = distance_mm(added, ct.spacing_mm) > LEAST_HALF_THICKNESS_MM
    if core.any() and other.any():
        # A notch of the chest wall lies near the convex hull of both lungs and far from the other lung; what
        # does not may be the heart, the aorta or the hilum, and stays outside.
        core &= distance_mm(~other, ct.spacing_mm)[box] > 40.0
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
        # Half the diameter of the largest nodule that is not called a mass, 30 mm.
        near[:, :, k] = hull & (depth <= 15.0)
    _clear_edge(near, np.ceil(NOTCH_MM / np.asarray(ct.spacing_mm)).astype(np.int64))
    return near


def _clear_edge(mask: Mask, width: Int) -> None:
    """Empty the border of an array: near the edge of the image a closing cannot tell notch from outside."""
    for axis, n in enumerate(width):
        layers = np.moveaxis(mask, axis, 0)
        layers[:n] = False
        layers[-n:] = False

"""Which pieces of air in a chest are lungs: those that lie at the bronchi, without the gas beside them."""

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Mask
from anatomy.morphology import bounds, window
from anatomy.segmentation.closing import distance_mm
from anatomy.segmentation.coarse import CoarseCt

SMALLEST_LUNG_ML = 150.0
"""The smallest lung of a child after breathing out is about this large."""
SMALLER_SHARE = 0.1
"""A lung has at least this share of the other's volume; a smaller piece of air is something else."""
CONTACT_MM = 10.0
"""Wall of a main bronchus and the tissue around it: lung begins within this distance of the bronchi."""
GAS_ABOVE_AIR_HU = 25.0
"""Gas outside the lung is as thin as air; lung with severe emphysema, at -950 HU, is denser than this."""
GAS_RADIUS_MM = 4.0
"""A ball of this radius fits into a pocket of gas that matters, but into no airway beyond the main
bronchi."""
SMALLEST_GAS_ML = 20.0
"""Holes of emphysema are smaller; a layer of gas over half a lung, 4 mm thick, is larger."""


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
    at_bronchi[np.unique(pieces[near(airway, CONTACT_MM, coarse)])] = True
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
    lung &= volumes_ml >= SMALLER_SHARE * volumes_ml[lung].max()
    return np.asfortranarray(lung[pieces])


def near(mask: Mask, reach_mm: float, coarse: CoarseCt) -> Mask:
    """Mark what lies within a distance of a mask."""
    pad = np.ceil(reach_mm / np.asarray(coarse.spacing_mm)).astype(np.int64)
    box = window(*bounds(mask, pad))
    found = np.zeros(mask.shape, dtype=np.bool_, order="F")
    if mask.any():
        found[box] = distance_mm(~mask[box], coarse.spacing_mm) <= reach_mm
    return found


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
    thin = ndimage.uniform_filter(coarse.hu[box], 3, mode="nearest") < air_hu + GAS_ABOVE_AIR_HU
    thin &= lung[box]
    core = distance_mm(np.asfortranarray(thin), coarse.spacing_mm) > GAS_RADIUS_MM
    if not core.any():
        return found
    pocket = (distance_mm(np.asfortranarray(~core), coarse.spacing_mm) <= GAS_RADIUS_MM + 1.5) & lung[box]
    pieces, count = ndimage.label(pocket)
    volumes_ml = np.bincount(pieces.ravel(), minlength=count + 1) * coarse.voxel_ml
    volumes_ml[0] = 0.0
    found[box] = (volumes_ml >= SMALLEST_GAS_ML)[pieces]
    return found

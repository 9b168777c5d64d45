"""An inflated lung outside a body: in air, in a bag, or on a tray."""

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float, Int32, Mask
from anatomy.segmentation.central_airway import CentralAirway, grow_from
from anatomy.segmentation.closing import closed, largest_piece, without_holes
from anatomy.segmentation.coarse import CoarseCt
from anatomy.segmentation.labels import RIGHT, sides_from_right

GREATEST_LUNG_HU = -200.0
"""Denser than any inflated lung: trays, clamps, the heart."""
SMALLEST_LUNG_ML = 150.0
"""As for lungs in a chest."""
AIRWAY_BELOW_HU = -920.0
"""Only air of a wide airway is below it; inflated lung is above."""
LEAST_AIRWAY_RADIUS_MM = 2.5
"""The main bronchus of a small lung has this radius; bullae in the lung rarely have."""


def coarse_lung_ex_vivo(
    ct: CoarseCt, seed_lps: Float | None
) -> tuple[float, CentralAirway, Int32, tuple[str, ...]]:
    """Find a lung surrounded by air, and its largest airway.

    The background is grown from the edge of the image until the lung is encountered [Fu2018, III-A.1]: the
    threshold lies halfway between the air around and the lung.

    Parameters
    ----------
    ct : CoarseCt
    seed_lps : (3,) float64, optional
        A point in the main bronchus or trachea, LPS mm.

    Returns
    -------
    threshold : float
        What is denser is not lung, HU.
    airway : CentralAirway
    sides : (Ni, Nj, Nk) int32
        1 right lung, 2 left lung; one lung alone is labelled 1.
    warnings : tuple of str

    Raises
    ------
    AnatomyError
        If there is no lung or no airway.
    """
    background = _background(ct)
    tissue = (ct.hu < GREATEST_LUNG_HU) & ~background
    lung = largest_piece(np.asfortranarray(tissue))
    if np.count_nonzero(lung) * ct.voxel_ml < SMALLEST_LUNG_ML:
        raise AnatomyError(
            "No inflated lung was found in the air of the image",
            expected=f"a lung of at least {SMALLEST_LUNG_ML:g} ml surrounded by air",
            remedy="For a CT of a patient leave out --ex-vivo",
        )
    # Airways open to the outside of the lung are closed over this width before its hull is filled.
    hull = without_holes(closed(lung, 15.0, ct.spacing_mm))
    airway = _airway(ct, hull, seed_lps)
    sides = sides_from_right(lung & ~airway.main, ct)
    if sides is not None:
        return GREATEST_LUNG_HU, airway, sides, ()
    warnings = ("One lung was found; its side is unknown, and it is stored as the right one.",)
    return GREATEST_LUNG_HU, airway, np.asfortranarray(lung * np.int32(RIGHT)), warnings


def _background(ct: CoarseCt) -> Mask:
    """Grow the air around the lung from the edge of the image."""
    from scipy import ndimage

    faces = [ct.hu[0], ct.hu[-1], ct.hu[:, 0], ct.hu[:, -1], ct.hu[:, :, 0], ct.hu[:, :, -1]]
    air = float(np.median(np.concatenate([face.ravel() for face in faces])))
    # Lung is at least this much above the air around it: several times the noise.
    body = ct.hu[(ct.hu > air + 40.0) & (ct.hu < GREATEST_LUNG_HU)]
    if air > AIRWAY_BELOW_HU or not body.size:
        raise AnatomyError(
            f"The edge of the image has a median of {air:.0f} HU, and lung was not found in it",
            expected="an inflated lung surrounded by air (about -1000 HU)",
            remedy="For a CT of a patient leave out --ex-vivo",
        )
    thin = ct.hu < 0.5 * (air + float(np.median(body)))
    pieces, count = ndimage.label(thin)
    at_edge = np.zeros(count + 1, dtype=np.bool_)
    for axis in range(3):
        for end in (0, -1):
            at_edge[np.unique(pieces[tuple(end if a == axis else slice(None) for a in range(3))])] = True
    at_edge[0] = False
    background: Mask = at_edge[pieces]
    return background


def _airway(ct: CoarseCt, hull: Mask, seed_lps: Float | None) -> CentralAirway:
    """Grow the airway from the widest air inside the hull of the lung."""
    import edt

    if seed_lps is not None:
        return grow_from(ct, ~hull, seed_lps)
    air = np.asfortranarray((ct.hu < AIRWAY_BELOW_HU) & hull)
    radius = edt.edt(air, anisotropy=ct.spacing_mm, order="F", black_border=True)
    widest = np.unravel_index(int(np.argmax(radius)), radius.shape)
    if radius[widest] < LEAST_AIRWAY_RADIUS_MM:
        raise AnatomyError(
            f"The widest airway in the lung has a radius of {float(radius[widest]):.1f} mm",
            expected=f"a main bronchus of at least {LEAST_AIRWAY_RADIUS_MM:g} mm",
            remedy="Give a point in the main bronchus with --seed",
        )
    return grow_from(ct, ~hull, ct.grid.lps(widest))

"""The lung among all the air of a chest: pieces of air at the bronchi.

The gas beside them and the air outside are left out, and the notches of nodules that lie on the chest wall,
too wide for a closing of the lung, are filled.
"""

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Float, Float32, Int32, Mask
from anatomy.morphology import (
    bounds,
    closed,
    distance_mm,
    largest_piece,
    near,
    pieces_of,
    window,
    without_holes,
)
from anatomy.segmentation.central_airway import CentralAirway, grow_from
from anatomy.segmentation.coarse import CoarseCt
from anatomy.segmentation.input import AIR_HU
from anatomy.segmentation.labels import RIGHT, sides_from_right

GREATEST_LUNG_HU = -200.0
"""Denser than any inflated lung: trays, clamps, the heart."""
AIRWAY_BELOW_HU = -920.0
"""Only air of a wide airway is below it; inflated lung is above."""
LEAST_AIRWAY_RADIUS_MM = 2.5
"""The main bronchus of a small lung has this radius; bullae in the lung rarely have."""

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
    """Mark the air around the patient, `(Ni, Nj, Nk)`; axis 2 of the coarse CT runs along the body.

    In every axial slice, pieces of `air`, which holds lungs as well, that touch the edge of the image are
    taken, because the chest wall closes the lungs off within a slice even where mouth or trachea open to the
    outside.  Where the field of view cuts off the skin, a lung may touch the edge too; the lung holds tissue,
    so its median is higher than that of air.
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
    """Keep the pieces of air as large as a lung that lie at the bronchi; AnatomyError if there is none.

    `air` `(Ni, Nj, Nk)` is what is as thin as lung, without the airway and the outside; `airway` are trachea
    and bronchi as far as they could be followed.
    """
    pieces, sizes = pieces_of(air)
    volumes_ml = sizes * coarse.voxel_ml
    large = volumes_ml >= SMALLEST_LUNG_ML
    at_bronchi = np.zeros(len(sizes), dtype=np.bool_)
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


def gas_pockets(coarse: CoarseCt, lung: Mask, air_hu: float) -> tuple[Mask, Mask]:
    """Tell gas that no tissue runs through, a pneumothorax, a bulla or bowel, from lung `(Ni, Nj, Nk)`.

    `air_hu` is what air measures in the trachea, where scatter raises it as it raises gas beside it.
    Returned are the gas and what is left of the lung: pieces that are gas for the most part are none.
    """
    from scipy import ndimage

    found = np.zeros(lung.shape, dtype=np.bool_, order="F")
    box = window(*bounds(lung, 1))
    # Gas is as thin as air.  Tissue is denser, even of lungs with severe emphysema, at -950 HU; where scatter
    # raises the air, the lungs themselves tell up to where.
    thinnest = float(np.percentile(coarse.hu[lung], 65.0)) - 40.0
    limit = max(AIR_HU + 25.0, min(air_hu + 25.0, thinnest))
    thin = ndimage.uniform_filter(coarse.hu[box], 3, mode="nearest") < limit
    thin &= lung[box]
    core = distance_mm(np.asfortranarray(thin), coarse.spacing_mm) > GAS_RADIUS_MM
    if not core.any():
        return found, lung
    pocket = (distance_mm(np.asfortranarray(~core), coarse.spacing_mm) <= GAS_RADIUS_MM + 1.5) & lung[box]
    pieces, sizes = pieces_of(pocket)
    # Holes of emphysema are smaller; a layer of gas over half a lung, 4 mm thick, is larger.
    found[box] = (sizes * coarse.voxel_ml >= 20.0)[pieces]
    pieces, sizes = pieces_of(lung)
    kept = np.bincount(pieces[found], minlength=len(sizes)) < 0.5 * sizes
    return found, np.asfortranarray(kept[pieces] & ~found)


def notches(ct: CoarseCt, right: Mask, left: Mask, closing_mm: float) -> tuple[Mask, Mask]:
    """Return nodule-like notches in the costal side of each lung, bool `(Ni, Nj, Nk)` on coarse voxels.

    One lung may be empty; a closing of the radius `closing_mm` fills what is narrower anyway.
    """
    hull = _near_hull(right | left, ct)
    return _notches_of(ct, right, left, hull, closing_mm), _notches_of(ct, left, right, hull, closing_mm)


def _notches_of(ct: CoarseCt, side: Mask, other: Mask, hull: Mask, closing_mm: float) -> Mask:
    """Return the notches of one lung that lie near the hull of both."""
    found = np.zeros(side.shape, dtype=np.bool_, order="F")
    box = window(*bounds(side, np.ceil(2.0 * NOTCH_MM / np.asarray(ct.spacing_mm)).astype(np.int64)))
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
    from skimage.morphology import convex_hull_image

    near = np.zeros(lungs.shape, dtype=np.bool_, order="F")
    for k in np.flatnonzero(lungs.any(axis=(0, 1))):
        hull = np.asfortranarray(convex_hull_image(lungs[:, :, k]))
        depth = distance_mm(hull, ct.spacing_mm[:2], bordered=True)
        # Half the diameter of the largest nodule that is not called a mass, 30 mm.
        near[:, :, k] = hull & (depth <= 15.0)
    # Near the edge of the image a closing cannot tell notch from outside.
    for axis, n in enumerate(np.ceil(NOTCH_MM / np.asarray(ct.spacing_mm)).astype(np.int64)):
        layers = np.moveaxis(near, axis, 0)
        layers[:n] = layers[-n:] = False
    return near


def coarse_lung_ex_vivo(
    ct: CoarseCt, seed_lps: Float | None
) -> tuple[float, CentralAirway, Int32, tuple[str, ...]]:
    """Find a lung surrounded by air, and its largest airway.

    The background is grown from the edge of the image until the lung is encountered [Fu2018, III-A.1]: the
    threshold lies halfway between the air around and the lung.  Returned are the HU above which nothing is
    lung, the airway, the sides (1 right lung, 2 left lung, one lung alone 1), and warnings.  A point in the
    main bronchus or trachea may be given, LPS mm.  Raises AnatomyError if there is no lung or no airway.
    """
    lung = largest_piece(np.asfortranarray((ct.hu < GREATEST_LUNG_HU) & ~_background(ct)))
    if np.count_nonzero(lung) * ct.voxel_ml < SMALLEST_LUNG_ML:
        raise AnatomyError(
            "No inflated lung was found in the air of the image",
            expected=f"a lung of at least {SMALLEST_LUNG_ML:g} ml surrounded by air",
            remedy="For a CT of a patient leave out --ex-vivo",
        )
    # Airways open to the outside of the lung are closed over this width before its hull is filled.
    airway = _airway(ct, without_holes(closed(lung, 15.0, ct.spacing_mm)), seed_lps)
    sides = sides_from_right(lung & ~airway.main, ct)
    if sides is not None:
        return GREATEST_LUNG_HU, airway, sides, ()
    warnings = ("One lung was found; its side is unknown, and it is stored as the right one.",)
    return GREATEST_LUNG_HU, airway, np.asfortranarray(lung * np.int32(RIGHT)), warnings


def _background(ct: CoarseCt) -> Mask:
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
    return ~without_holes(ct.hu >= 0.5 * (air + float(np.median(body))))


def _airway(ct: CoarseCt, hull: Mask, seed_lps: Float | None) -> CentralAirway:
    if seed_lps is not None:
        return grow_from(ct, ~hull, seed_lps)
    air = np.asfortranarray((ct.hu < AIRWAY_BELOW_HU) & hull)
    radius = distance_mm(air, ct.spacing_mm, bordered=True)
    widest = np.unravel_index(int(np.argmax(radius)), radius.shape)
    if not radius[widest] >= LEAST_AIRWAY_RADIUS_MM:
        raise AnatomyError(
            f"The widest airway in the lung has a radius of {float(radius[widest]):.1f} mm",
            expected=f"a main bronchus of at least {LEAST_AIRWAY_RADIUS_MM:g} mm",
            remedy="Give a point in the main bronchus with --seed",
        )
    return grow_from(ct, ~hull, ct.grid.lps(widest))

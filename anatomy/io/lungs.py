"""Lungs that are whole: made of lobes, or of a mask that leaves out what is in them; their fissures."""

from dataclasses import replace

import numpy as np

from anatomy.base.typed import Mask, UInt8
from anatomy.io.masks import MaskSet
from anatomy.lobes import LOBES, fissures_between, grown_into, main_pieces
from anatomy.morphology import bounds, grown_by_one, window

EXCLUDED_SHARE, TOUCHING_SHARE = 0.05, 0.5
"""A label map has one label a voxel: of its vessels less than the first share lies in the lungs, and of their
surface at least the second share touches the lungs.  Vessels that lie elsewhere do not touch them."""


def with_lobes(masks: MaskSet) -> MaskSet:
    """Make lungs and fissures of lobes, as far as they have no masks of their own.

    The lungs are the union of the lobes, see `fill_lung`.  A fissure lies on both sides of every border
    between two lobes of the same lung.  What was derived is stated.
    """
    if masks.lobes is None:
        return masks
    known = dict(masks.masks)
    statements = list(masks.statements)
    are_the_lungs = "lung" not in known
    main = _main_lobes(masks.lobes, statements)
    union = masks.lobes > 0 if are_the_lungs else known["lung"] | (masks.lobes > 0)
    masks = replace(masks, masks={**known, "lung": union})
    known = dict((fill_lung(masks) if are_the_lungs else masks).masks)
    lobes = grown_into(main, known["lung"])
    if are_the_lungs:
        absent = [name for number, name in LOBES.items() if not (lobes == number).any()]
        statements += [f"There is no mask of the {name}: what lies there is not lung." for name in absent]
    if "fissures" not in known or not known["fissures"].any():
        fissures = fissures_between(lobes)
        if fissures.any():
            known["fissures"] = fissures
            statements.append(
                f"No fissure mask: {np.count_nonzero(fissures)} voxels on both sides of the borders between "
                "lobes of the same lung are taken as fissures."
            )
    return replace(masks, masks=known, lobes=lobes, statements=tuple(statements))


def _main_lobes(lobes: UInt8, statements: list[str]) -> UInt8:
    """Return the lobes without the pieces apart from them, which stay lung."""
    kept = np.zeros_like(lobes)
    for number, name in LOBES.items():
        lobe = lobes == number
        main = main_pieces(lobe)
        kept[main] = number
        stray = int(np.count_nonzero(lobe)) - int(np.count_nonzero(main))
        if stray:
            statements.append(
                f"{stray} voxels of the mask of the {name} lie apart from it: they are lung, but of no lobe."
            )
    return kept


def fill_lung(masks: MaskSet) -> MaskSet:
    """Count airways and vessels, and the rim between them and a lobe, as lung.

    Masks of lobes leave out the larger bronchi and vessels, and two networks do not agree on a border to the
    voxel.  All that is added is airway or vessel, hence an obstacle, or lies in a gap of at most two voxels
    between one of them and a lobe, so that the mediastinum does not become passable.
    """
    roles = [masks.masks[role] for role in ("lumen", "wall", "vessels") if role in masks.masks]
    if "lung" not in masks.masks or not masks.masks["lung"].any() or not roles:
        return masks
    lobes = masks.masks["lung"]
    tubes: Mask = np.logical_or.reduce(roles)
    lung: Mask = lobes | tubes
    box = window(*bounds(lung, 2))
    closed = ~grown_by_one(~grown_by_one(lung[box]))
    lung[box] |= closed & grown_by_one(tubes[box]) & grown_by_one(grown_by_one(lobes[box]))
    return replace(masks, masks={**masks.masks, "lung": lung})


def with_contents(masks: MaskSet) -> MaskSet:
    """Count what a mask of the lungs leaves out of them as lung, where it has the air alone.

    A label map cannot have a voxel twice, so that its lungs have holes where vessels, airways, fissures and
    nodules are.  What is added is one of these, or a gap as in `fill_lung`; it is stated.
    """
    held = masks.masks
    if not {"lung", "vessels"} <= held.keys() or not held["vessels"].any():
        return masks
    lung, vessels = held["lung"], held["vessels"]
    if np.count_nonzero(vessels & lung) >= EXCLUDED_SHARE * np.count_nonzero(vessels):
        return masks
    surface = vessels & grown_by_one(~vessels)
    if np.count_nonzero(surface & grown_by_one(lung)) < TOUCHING_SHARE * np.count_nonzero(surface):
        return masks
    inside = [held[role] for role in ("fissures", "nodules") if role in held]
    filled = fill_lung(replace(masks, masks={**held, "lung": np.logical_or.reduce([lung, *inside])}))
    added = np.count_nonzero(filled.masks["lung"]) - np.count_nonzero(lung)
    said = (
        "The mask of the lungs leaves out the vessels, as a label map does: they, airways, fissures and "
        f"nodules count as lung, {added * masks.grid.voxel_volume_mm3 / 1000.0:.0f} ml."
    )
    return replace(filled, statements=(*masks.statements, said))

"""The nodules of a patient: number, size, and where they lie."""

import numpy as np

from anatomy.base.errors import TargetError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.lung import Lung
from anatomy.morphology import components, voxels_of
from anatomy.nodule_size import NoduleSize, nodule_size
from anatomy.organ import Organ


@frozen_record
class Nodule:
    """A nodule of the nodule mask.

    Args:
        number: Its label in the patient's files, where these tell nodules apart; else its rank by size, from
            1.
        voxels ((N, 3) int64): On the grid of the organ.
        diameter_mm: Of the ball with its volume.
        centre_lps ((3,) float64): Mean of its voxels, LPS mm.
    """

    number: int
    is_label: bool
    voxels: Int
    size: NoduleSize
    diameter_mm: float
    centre_lps: Float

    def words(self, lung: Lung) -> str:
        """Say number, place and size: "nodule 2 in RS6, 14 mm"."""
        place = lung.segment_at(self.centre_lps) or lung.lobe_at(self.centre_lps)
        return f"nodule {self.number}{f' in {place}' if place else ''}, {self.diameter_mm:.0f} mm"


def nodules_of(organ: Organ) -> tuple[Nodule, ...]:
    """Return the nodules of a patient, by label where the files have labels, else the largest first."""
    if organ.nodules is None:
        return ()
    if organ.nodule_labels is not None:
        voxels = voxels_of(organ.nodules.array)
        labels = organ.nodule_labels.array[tuple(voxels.T)]
        return tuple(_nodule(organ, int(n), True, voxels[labels == n]) for n in np.unique(labels[labels > 0]))
    voxels, part = components(organ.nodules.array)
    order = np.argsort(-np.bincount(part), kind="stable")
    return tuple(_nodule(organ, n, False, voxels[part == p]) for n, p in enumerate(order, start=1))


def find_nodule(organ: Organ, number: int) -> Nodule:
    """Return the nodule with a number, the largest for 0; TargetError if there is none."""
    found = nodules_of(organ)
    if not found:
        raise TargetError(
            f"Patient {organ.name} has no nodule mask",
            expected="a nodule mask among the patient's files",
            remedy="Name a point with --target ras:x,y,z or lps:x,y,z",
        )
    if number == 0:
        return max(found, key=lambda each: len(each.voxels))
    named = {each.number: each for each in found}
    if number in named:
        return named[number]
    expected = f"a number from 1 to {len(found)}, 1 being the largest"
    if found[0].is_label:
        expected = f"one of the labels {', '.join(map(str, named))} of the mask"
    raise TargetError(
        f"There is no nodule {number}",
        expected=expected,
        remedy="Choose one of these numbers, or name a point with --target",
    )


def target_words(lung: Lung, point_lps: Float) -> str:
    """Return what a target `(3,)` LPS mm is and where: "nodule 2 in RS6, 14 mm", or its segment and lobe."""
    index = np.rint(lung.grid.ijk(point_lps)).astype(np.int64)
    for each in nodules_of(lung):
        if (each.voxels == index).all(axis=1).any():
            return each.words(lung)
    return lung.region_at(point_lps)


def _nodule(organ: Organ, number: int, is_label: bool, voxels: Int) -> Nodule:
    size = nodule_size(voxels, organ.grid)
    return Nodule(
        number=number,
        is_label=is_label,
        voxels=voxels,
        size=size,
        diameter_mm=float(np.cbrt(6000.0 * size.volume_ml / np.pi)),
        centre_lps=np.asarray(organ.grid.lps(voxels).mean(axis=0)),
    )

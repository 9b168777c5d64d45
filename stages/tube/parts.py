"""The parts of a tube: where it is curved at rest, and where a laser has cut slots into it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from anatomy.base.typed import Float
from anatomy.shafts import SlottedSegment


class TubeParts(NamedTuple):
    """The parts of a tube of one precurvature and one pattern of slots each, K of them, from the tip on.

    Args:
        begin_mm, end_mm ((K,) float64): Places along the tube, counted from its tip.
        curvature_per_mm, direction_rad ((K,) float64): Precurvature, and its direction about the axis, 0
            where it is straight.
        stiffness_n_mm2 ((K,) float64): Bending stiffness.
        strained_radius_mm ((K,) float64): Strain for each 1/mm of change of curvature: the radius by the
            factor of the slots.
    """

    begin_mm: Float
    end_mm: Float
    curvature_per_mm: Float
    direction_rad: Float
    stiffness_n_mm2: Float
    strained_radius_mm: Float


class Bend(NamedTuple):
    """A piece of a tube of one precurvature, by arc lengths from the tube's rear end."""

    from_mm: float
    to_mm: float
    curvature_per_mm: float
    direction_rad: float


def tube_parts(
    length_mm: float,
    bends: Sequence[Bend],
    slots: Sequence[SlottedSegment],
    stiffness_n_mm2: float,
    radius_mm: float,
) -> TubeParts:
    """Cut a tube, of which stiffness and radius are given where it is plain, into its parts."""
    curved = [(length_mm - bend.to_mm, length_mm - bend.from_mm, bend) for bend in bends]
    slotted = [(each.from_tip_mm, each.to_mm, each) for each in slots]
    edges = {0.0, length_mm, *(edge for begin, end, _ in (*curved, *slotted) for edge in (begin, end))}
    ends = np.array(sorted(edges))
    middle = 0.5 * (ends[:-1] + ends[1:])
    curvature, direction = np.zeros(len(middle)), np.zeros(len(middle))
    stiffness, strain = np.ones(len(middle)), np.ones(len(middle))
    for begin, end, bend in curved:
        within = (middle > begin) & (middle < end)
        curvature[within], direction[within] = bend.curvature_per_mm, bend.direction_rad
    for begin, end, each in slotted:
        within = (middle > begin) & (middle < end)
        stiffness[within], strain[within] = each.stiffness_factor, each.strain_factor
    return TubeParts(
        begin_mm=ends[:-1],
        end_mm=ends[1:],
        curvature_per_mm=curvature,
        direction_rad=direction,
        stiffness_n_mm2=stiffness_n_mm2 * stiffness,
        strained_radius_mm=radius_mm * strain,
    )

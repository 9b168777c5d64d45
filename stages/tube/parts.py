"""The parts of a tube: where it is curved at rest, and where a laser has cut slots into it."""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

import numpy as np

from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float


@settings
class SlottedSegment:
    """A stretch of a tube that a laser has patterned with slots, so that it bends more easily.

    Both factors compare it with the plain tube at the same curvature: the bending stiffness, and the largest
    strain of the material.
    """

    from_tip_mm: Annotated[
        float, quantity("place of its front end, counted from the tube's tip", at_least=0.0, at_most=2000.0)
    ] = 0.0
    length_mm: Annotated[float, quantity("length of the segment", above=0.0, at_most=2000.0)]
    stiffness_factor: Annotated[
        float, quantity("bending stiffness as a share of the plain tube's", above=0.0, at_most=1.0)
    ]
    strain_factor: Annotated[
        float, quantity("strain as a share of the plain tube's at the same curvature", above=0.0, at_most=2.0)
    ]


class TubeParts(NamedTuple):
    """The parts of a tube of one precurvature and one pattern of slots each, K of them, from the tip on.

    Parameters
    ----------
    begin_mm, end_mm : (K,) float64
        Places along the tube, counted from its tip.
    curvature_per_mm : (K,) float64
        Precurvature.
    stiffness_n_mm2 : (K,) float64
        Bending stiffness.
    strained_radius_mm : (K,) float64
        Strain for each 1/mm of change of curvature: the radius by the factor of the slots.
    """

    begin_mm: Float
    end_mm: Float
    curvature_per_mm: Float
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
    curved = [(length_mm - bend.to_mm, length_mm - bend.from_mm, bend.curvature_per_mm) for bend in bends]
    slotted = [(each.from_tip_mm, each.from_tip_mm + each.length_mm, each) for each in slots]
    edges = {0.0, length_mm, *(edge for begin, end, _ in (*curved, *slotted) for edge in (begin, end))}
    ends = np.array(sorted(edges))
    middle = 0.5 * (ends[:-1] + ends[1:])
    curvature, stiffness, strain = np.zeros(len(middle)), np.ones(len(middle)), np.ones(len(middle))
    for begin, end, kappa in curved:
        curvature[(middle > begin) & (middle < end)] = kappa
    for begin, end, each in slotted:
        within = (middle > begin) & (middle < end)
        stiffness[within], strain[within] = each.stiffness_factor, each.strain_factor
    return TubeParts(
        begin_mm=ends[:-1],
        end_mm=ends[1:],
        curvature_per_mm=curvature,
        stiffness_n_mm2=stiffness_n_mm2 * stiffness,
        strained_radius_mm=radius_mm * strain,
    )

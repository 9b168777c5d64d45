"""Sequences and designs that keep the tubes' sideways motion small, and what reach that costs."""

import math
from collections.abc import Callable
from collections.abc import Sequence as SequenceOf
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float, Int
from anatomy.base.words import plural
from stages.tube.device import ConcentricTubes, Tube
from stages.tube.following import DeployedSequence, SnapError, deploy
from stages.tube.kernels.shapes import SWEEP, TIP
from stages.tube.mechanics import TubeMechanics
from stages.tube.one_shape import deployed, design_arrays, without_limits
from stages.tube.sequences import Sequence, alternating, inner_first, together

WALLS, LENGTHS, CURVATURES = 4, 13, 36
"""How many values of each dimension are tried."""
SAME_MM, SAME_RAD = 0.05, 0.02
"""Values that differ by less are taken to be equal."""
ROUNDING = 1e-12
"""Share of the strain limit that stays unused, so that rounding does not exceed it."""


@frozen_record
class SequenceComparison:
    """Sequences to one final place that can be carried out, least sweep first, and why the others cannot."""

    deployed: tuple[DeployedSequence, ...]
    refused: dict[str, str]

    @property
    def best(self) -> DeployedSequence:
        """The sequence with the least sweep.  Raises SettingsError if none can be carried out."""
        if not self.deployed:
            raise SettingsError(
                "No sequence reaches this deployment: "
                + "; ".join(f"{name}: {why}" for name, why in self.refused.items()),
                expected="at least one sequence without a snap",
                remedy="Insert the tubes less far, turn them less against each other, or alter their lengths",
            )
        return self.deployed[0]


def least_sweep_sequence(
    tubes: SequenceOf[Tube],
    base_angles_rad: ArrayLike,
    insertions_mm: ArrayLike,
    *,
    needle: Tube | None = None,
) -> SequenceComparison:
    """Compare the sequences that lead to one deployment, by their sweep.

    Looked at are: all tubes together, the innermost first, by increments in turns, and all tubes together
    without relative rotation, which then turn in place.  Arguments and errors are those of `together`, and a
    straight needle whose tip stays where that of the innermost tube is.
    """
    together(tubes, base_angles_rad, insertions_mm)
    angles = np.broadcast_to(np.asarray(base_angles_rad, dtype=np.float64), (len(tubes),))
    mechanics = TubeMechanics(tubes, needle=needle)
    deployed, refused = [], {}
    for name, make in _makers(tubes, angles, insertions_mm).items():
        try:
            deployed.append(deploy(mechanics, replace(make(), name=name)))
        except (SettingsError, SnapError) as error:
            refused[name] = str(error)
    deployed.sort(key=lambda each: each.lateral_sweep_mm)
    return SequenceComparison(deployed=tuple(deployed), refused=refused)


def _makers(
    tubes: SequenceOf[Tube], angles: Float, insertions_mm: ArrayLike
) -> dict[str, Callable[[], Sequence]]:
    """Return what makes each sequence that is compared, by its name."""
    makers: dict[str, Callable[[], Sequence]] = {
        "together": partial(together, tubes, angles, insertions_mm),
        "inner first": partial(inner_first, tubes, angles, insertions_mm),
    }
    # The alternating sequences that are compared have these increments, mm.
    for increment in (2.0, 5.0, 10.0):
        name = f"alternating by {increment:g} mm"
        makers[name] = partial(alternating, tubes, angles, insertions_mm, increment_mm=increment)
    if np.ptp(angles) > 0.0:
        aligned = together(tubes, angles[0], insertions_mm)
        makers["together, then turned in place"] = partial(aligned.then_turn, angles)
    return makers


@settings
class MakerLimits:
    """What limits a maker of tubes; 0 curves the inner one for the larger of insertion and present length."""

    channel_diameter_mm: Annotated[float, quantity("working channel of the scope", above=0.0, at_most=10.0)]
    longest_curve_mm: Annotated[
        float, quantity("longest curved part, 0 if only the insertion limits it", at_least=0.0, at_most=500.0)
    ] = 0.0
    thinnest_wall_mm: Annotated[float, quantity("thinnest wall outside", above=0.0, at_most=2.0)] = 0.05
    nesting_clearance_mm: Annotated[
        float, quantity("difference of diameters of bore and inner tube", above=0.0, at_most=2.0)
    ] = 0.15
    channel_clearance_mm: Annotated[
        float, quantity("difference of diameters of channel and outer tube", above=0.0, at_most=2.0)
    ] = 0.1


@frozen_value
class DesignProposal:
    """A pair of tubes, and what one deployment of it does, both tubes first, then the inner one alone.

    The sweep is the largest distance of any point of the body from its final place, the offset the distance
    of the tip from the scope's axis, the angle that between tip and scope.
    """

    tubes: ConcentricTubes
    lateral_sweep_mm: float
    tip_offset_mm: float
    tip_angle_rad: float


def propose_designs(
    tubes: ConcentricTubes, outer_mm: float, inner_mm: float, max_sweep_mm: float, limits: MakerLimits
) -> tuple[DesignProposal, ...]:
    """Vary what a maker can vary, and return the designs that sweep little enough, least sweep first.

    Varied are the wall of the outer tube, and length and curvature of the inner tube's curved part, within
    the strain limit of `tubes`, whose lengths, limits and inner diameters are kept; the curved part is at
    least half as long as theirs.  A design is left out if another one sweeps no more at these insertions,
    reaches no less to the side, turns the tip no more and has no longer curved part.  Raises SettingsError if
    there are not two tubes, the insertions are impossible, the sweep is not finite, or no outer tube fits
    into the channel.
    """
    if tubes.outer is None or tubes.middle is not None:
        raise SettingsError(
            f"The design has {plural(len(tubes.nested), 'tube')}",
            expected="an outer and an inner tube, whose sizes are varied",
            remedy="Add [tubes.outer] to the device file, or leave out [tubes.middle]",
        )
    together(tubes.nested, 0.0, (inner_mm, outer_mm))
    if inner_mm == 0.0:
        raise SettingsError("The inner tube stays in the scope", expected="an insertion above 0")
    if not 0.0 <= max_sweep_mm < math.inf:
        raise SettingsError(f"The largest sweep is {max_sweep_mm:g} mm", expected="finite, at least 0")
    bore = tubes.inner.outer_diameter_mm + limits.nesting_clearance_mm
    thickest = 0.5 * (limits.channel_diameter_mm - limits.channel_clearance_mm - bore)
    if thickest < limits.thinnest_wall_mm:
        raise SettingsError(
            f"The outer tube's wall could be {thickest:g} mm thick at most",
            expected=f"space for {limits.thinnest_wall_mm:g} mm between inner tube and channel",
            remedy="Allow less clearance, or take a thinner inner tube or a larger channel",
        )
    longest = limits.longest_curve_mm or max(inner_mm, tubes.inner.curved_length_mm)
    shortest = min(max(0.5 * tubes.inner.curved_length_mm, longest / LENGTHS), longest)
    bent = tubes.max_channel_curvature_per_mm or 0.0
    straight = tubes.outer.most_bent_per_mm(tubes.max_strain, tubes.passing_mm) * tubes.outer.radius_mm
    if bent > 0.0:
        thickest = min(thickest, straight / bent * (1.0 - ROUNDING) - 0.5 * bore)
    uncurved = replace(tubes.inner, curved_length_mm=0.0, precurvature_per_mm=0.0, bent_pieces=())
    steepest = (uncurved.most_bent_per_mm(tubes.max_strain, tubes.passing_mm) - bent) * (1.0 - ROUNDING)
    outers = [
        replace(tubes.outermost, inner_diameter_mm=bore, outer_diameter_mm=bore + 2.0 * wall_mm)
        for wall_mm in np.linspace(limits.thinnest_wall_mm, thickest, WALLS).tolist()
    ]
    curves = product(
        np.linspace(shortest, longest, LENGTHS).tolist(),
        np.linspace(steepest / CURVATURES, steepest, CURVATURES).tolist(),
    )
    inners = [
        replace(uncurved, curved_length_mm=curve_mm, precurvature_per_mm=curvature_per_mm)
        for curve_mm, curvature_per_mm in curves
    ]
    pairs = [replace(tubes, outer=outer, inner=inner) for outer, inner in product(outers, inners)]
    found = [evaluate_design(pair.with_needle(tubes.needle_shaft), outer_mm, inner_mm) for pair in pairs]
    kept = _worth_a_look([each for each in found if each.lateral_sweep_mm <= max_sweep_mm])
    return tuple(sorted(kept, key=lambda each: (each.lateral_sweep_mm, -each.tip_offset_mm)))


def evaluate_design(tubes: ConcentricTubes, outer_mm: float, inner_mm: float) -> DesignProposal:
    """Return sweep and reach of a design, whose tubes are not turned against each other.

    Raises SettingsError if the tubes cannot be inserted so, or snap.
    """
    inserted = np.array([inner_mm, outer_mm], dtype=np.float64)
    made = deployed(without_limits(design_arrays(tubes)), inserted, np.zeros(2))
    if made is None:
        raise SettingsError(
            f"The tubes cannot be inserted by {outer_mm:g} and {inner_mm:g} mm",
            expected="insertions of outer and inner tube that are in order and snap nothing",
        )
    x, y, _z = made.result[TIP + 9 :]
    ahead = made.result[TIP + np.array([2, 5, 8])]
    return DesignProposal(
        tubes=tubes,
        lateral_sweep_mm=float(made.result[SWEEP]),
        tip_offset_mm=float(math.hypot(x, y)),
        tip_angle_rad=float(math.atan2(math.hypot(ahead[0], ahead[1]), ahead[2])),
    )


def _worth_a_look(proposals: list[DesignProposal]) -> list[DesignProposal]:
    """Leave out what another proposal does as well in every respect."""
    if not proposals:
        return []
    # Rounded, so that designs that hardly differ count as one.
    ranks = np.array(
        [
            (
                round(each.lateral_sweep_mm / SAME_MM),
                -round(each.tip_offset_mm / SAME_MM),
                round(each.tip_angle_rad / SAME_RAD),
                each.tubes.inner.curved_length_mm,
            )
            for each in proposals
        ]
    )
    _, first = np.unique(ranks, axis=0, return_index=True)
    ranks = ranks[first]
    # Each is no worse than itself; the ranks of all others differ.
    others: Int = np.sum(np.all(ranks[:, None] <= ranks[None], axis=2), axis=0) - 1
    return [proposals[number] for number, count in zip(first, others, strict=True) if count == 0]

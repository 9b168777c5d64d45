"""What the planner has to know of concentric tubes."""

import math
from collections.abc import Sequence
from dataclasses import field, replace
from functools import cached_property
from itertools import pairwise
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from anatomy.base.errors import SettingsError
from anatomy.base.records import LEFT_OUT_IF_EMPTY
from anatomy.base.settings import impossible, quantity, settings
from anatomy.base.typed import Float
from anatomy.shafts import SlottedSegment, check_segments, second_moment_mm4


class TubeParts(NamedTuple):
    """The parts of a tube of one precurvature and one pattern of slots each, K of them, from the tip on.

    Args:
        begin_mm, end_mm ((K,) float64): Places along the tube, counted from its tip.
        curvature_per_mm, direction_rad ((K,) float64): Precurvature and its direction, 0 where straight.
        stiffness_n_mm2 ((K,) float64): Bending stiffness.
        strained_radius_mm ((K,) float64): Strain for each 1/mm of change of curvature: radius by slot factor.
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


def _tube_parts(
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


ROUNDING = 1e-9
"""Share of a limit by which a value may seem to break it that was computed from it."""
AIRWAY_MM = 300.0
"""From the larynx on no airway is longer; before it the channel is in throat and mouth, no part of a plan."""
DEFAULT_WALL_RUN_MM = 5.0
"""A straight tube of radius r has (t + r) / sin(a) of its length in a wall of thickness t that it meets at
the angle a: so much do 1.9 mm tubes at 30 degrees need for 1.5 mm, the wall of a segmental bronchus."""


@settings
class BentPiece:
    """A piece of a tube that is an arc at rest, or straight; pieces of one direction lie in a plane."""

    length_mm: Annotated[float, quantity("length of the piece", above=0.0, at_most=500.0)]
    precurvature_per_mm: Annotated[float, quantity("curvature at rest", at_least=0.0, at_most=1.0)]
    direction_deg: Annotated[
        float, quantity("direction of the bend about the axis", at_least=-360.0, at_most=360.0)
    ] = 0.0


@settings
class Tube:
    """One superelastic tube: straight, with a curved distal part.

    The curved part is one arc or, for several curvatures or out of one plane, `bent_pieces`, rearmost first.
    Raises SettingsError if a value is not finite or absurd, the tube has no wall, or the curved part
    contradicts itself.
    """

    outer_diameter_mm: Annotated[float, quantity("outer diameter of the tube", above=0.0, at_most=10.0)]
    inner_diameter_mm: Annotated[
        float, quantity("inner diameter of the tube, 0 of a wire", at_least=0.0, at_most=10.0)
    ]
    length_mm: Annotated[float, quantity("whole length of the tube", above=0.0, at_most=2000.0)]
    curved_length_mm: Annotated[
        float, quantity("length of the precurved distal part, 0 if straight", at_least=0.0, at_most=500.0)
    ] = 0.0
    precurvature_per_mm: Annotated[
        float, quantity("curvature of the distal part at rest, 0 if straight", at_least=0.0, at_most=1.0)
    ] = 0.0
    bent_pieces: Annotated[
        tuple[BentPiece, ...], Field(description="pieces of the distal part, if it is no single arc")
    ] = ()
    slotted_segments: Annotated[
        tuple[SlottedSegment, ...], Field(description="stretches with slots, the foremost first")
    ] = ()
    youngs_modulus_gpa: Annotated[float, quantity("Young's modulus", above=0.0, at_most=1000.0)] = 60.0
    poisson_ratio: Annotated[float, quantity("Poisson's ratio", at_least=0.0, below=0.5)] = 0.3

    def __post_init__(self) -> None:
        if self.inner_diameter_mm >= self.outer_diameter_mm:
            allowed = f"less than outer_diameter_mm = {self.outer_diameter_mm:g}"
            raise impossible("inner_diameter_mm", self.inner_diameter_mm, allowed)
        curved_mm, length = self.curved_length_mm, f"length_mm = {self.length_mm:g}"
        if curved_mm > self.length_mm:
            raise impossible("curved_length_mm", curved_mm, f"at most {length}")
        pieces_mm = sum(piece.length_mm for piece in self.bent_pieces)
        if self.bent_pieces and curved_mm > 0.0:
            raise impossible("curved_length_mm", curved_mm, "0 where bent_pieces say how the tube is curved")
        if pieces_mm > self.length_mm:
            raise impossible("bent_pieces", pieces_mm, f"in all at most {length} long")
        if (curved_mm > 0.0) != (self.precurvature_per_mm > 0.0):
            raise impossible(
                "precurvature_per_mm",
                self.precurvature_per_mm,
                "above 0 if curved_length_mm is (curved tube), 0 if that is 0 (straight tube); "
                f"curved_length_mm = {curved_mm:g}",
            )
        check_segments(self.slotted_segments, self.length_mm)

    @cached_property
    def parts(self) -> TubeParts:
        """The tube cut where its precurvature or its slots change."""
        slots, stiffness = self.slotted_segments, self.bending_stiffness_n_mm2
        return _tube_parts(self.length_mm, self.bends, slots, stiffness, self.radius_mm)

    def most_bent_per_mm(self, max_strain: float, passing_mm: float) -> float:
        """Return how bent a channel may be that the first `passing_mm` of the tube pass, 1/mm.

        At worst the channel bends the tube against its precurvature.  Below 0 the tube cannot be straight.
        """
        parts = self.parts
        most = max_strain / parts.strained_radius_mm - parts.curvature_per_mm
        return float(most[parts.begin_mm <= passing_mm].min())

    @property
    def radius_mm(self) -> float:
        """Outer radius, mm."""
        return 0.5 * self.outer_diameter_mm

    @property
    def second_moment_mm4(self) -> float:
        """Second moment of area of the cross-section, mm^4."""
        return second_moment_mm4(self.outer_diameter_mm, self.inner_diameter_mm)

    @property
    def bending_stiffness_n_mm2(self) -> float:
        """Bending stiffness E I where the tube is plain, N mm^2 [Rucker2010]."""
        return 1e3 * self.youngs_modulus_gpa * self.second_moment_mm4

    @property
    def torsional_stiffness_n_mm2(self) -> float:
        """Torsional stiffness G J = E I / (1 + nu), N mm^2, since J = 2 I and G = E / 2 (1 + nu)."""
        return self.bending_stiffness_n_mm2 / (1.0 + self.poisson_ratio)

    @property
    def bends(self) -> tuple[Bend, ...]:
        """The curved pieces, the rearmost first; none of a straight tube."""
        pieces = self.bent_pieces
        if self.curved_length_mm > 0.0:
            arc = BentPiece(length_mm=self.curved_length_mm, precurvature_per_mm=self.precurvature_per_mm)
            pieces = (arc,)
        found = []
        at = self.length_mm - sum(piece.length_mm for piece in pieces)
        for piece in pieces:
            end = at + piece.length_mm
            if piece.precurvature_per_mm > 0.0:
                found.append(Bend(at, end, piece.precurvature_per_mm, math.radians(piece.direction_deg)))
            at = end
        return tuple(found)

    @property
    def bent_length_mm(self) -> float:
        """Length from the tip to the rear end of the rearmost bend, 0 of a straight tube."""
        return self.length_mm - min((bend.from_mm for bend in self.bends), default=self.length_mm)

    @property
    def max_precurvature_per_mm(self) -> float:
        """Largest curvature at rest, 1/mm."""
        return max((bend.curvature_per_mm for bend in self.bends), default=0.0)

    @property
    def rest_strain(self) -> float:
        """Largest strain when the precurved part is held straight (dimensionless)."""
        return float((self.parts.curvature_per_mm * self.parts.strained_radius_mm).max())


@settings
class ConcentricTubes:
    """One, two or three nested tubes, and the limits of their deployment.

    Without an outer tube the inner one is alone, for instance as a straight stylet through the wall.  Where
    only the inner tube is bent, by one arc, the tubes bend in one plane and their shape has a closed form;
    any other design is turned tube by tube, and its shapes follow from the mechanics.
    A straight needle whose tip stays at that of the inner tube while they are deployed bends with them
    (`with_needle`).
    The sweep is that of any point of the tubes in tissue during deployment; 90 degrees to the wall is
    perpendicular; the extension counts along the tubes.  In the worst case the working channel bends the tube
    that it holds against its precurvature.  Where no largest curvature of the channel is stated, it is what
    `max_strain` allows.  Raises SettingsError if a value is not finite or absurd, the tubes do not nest, a
    tube held straight exceeds `max_strain`, or slots would make the tubes bend otherwise than plain ones.
    """

    outer: Tube | None = None
    middle: Tube | None = field(default=None, metadata={LEFT_OUT_IF_EMPTY: True})
    inner: Tube
    max_lateral_sweep_mm: Annotated[
        float, quantity("largest sideways motion of the tubes in tissue", at_least=0.0, at_most=20.0)
    ] = 1.0
    min_wall_angle_deg: Annotated[
        float, quantity("smallest angle between tube and airway wall at the exit", at_least=0.0, at_most=90.0)
    ] = 10.0
    max_wall_run_mm: Annotated[
        float,
        quantity("longest stretch of tube in the wall of the airway it leaves", above=0.0, at_most=100.0),
    ] = DEFAULT_WALL_RUN_MM
    max_extension_mm: Annotated[
        float, quantity("largest extension beyond the tip of the scope", above=0.0, at_most=300.0)
    ] = 60.0
    max_strain: Annotated[float, quantity("largest strain of the material", above=0.0, at_most=0.1)] = 0.04
    min_clearance_mm: Annotated[
        float, quantity("least difference of diameters of nested tubes", at_least=0.0, at_most=2.0)
    ] = 0.0
    max_channel_curvature_per_mm: Annotated[
        float | None,
        quantity("largest curvature of the channel that the tubes pass", at_least=0.0, at_most=0.5),
    ] = None
    needle_shaft: Tube | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self._check_nesting()
        self._check_strain()
        self._check_slots()

    def _check_strain(self) -> None:
        for name, tube in self.named:
            if tube.rest_strain > self.max_strain:
                most = self.max_strain / tube.radius_mm
                raise impossible(
                    f"{name}.precurvature_per_mm",
                    tube.max_precurvature_per_mm,
                    f"at most 2 max_strain / outer_diameter_mm = {most:.6g} without slots: held straight its "
                    f"strain is {tube.rest_strain:.4g}, max_strain is {self.max_strain:g}",
                )
        for name, tube in self.named:
            most = tube.most_bent_per_mm(self.max_strain, self.passing_mm)
            if (self.max_channel_curvature_per_mm or 0.0) > most * (1.0 + ROUNDING) + ROUNDING:
                raise impossible(
                    "max_channel_curvature_per_mm",
                    self.max_channel_curvature_per_mm,
                    f"at most {most:.4g}: there the strain of the {name} tube reaches max_strain = "
                    f"{self.max_strain:g}. A thinner tube, less precurvature or slotted_segments allow more",
                )

    def _check_slots(self) -> None:
        """Where tubes are deployed or bent their stiffness changes nowhere, and slots change all alike."""
        other = float(self.inner.parts.stiffness_n_mm2[0] / self.inner.bending_stiffness_n_mm2)
        twisted = sum(bool(tube.bends) for tube in self.nested) > 1
        for name, tube in self.named:
            parts = tube.parts
            bent_mm = 0.0 if self.planar else tube.bent_length_mm
            deployed = parts.stiffness_n_mm2[parts.begin_mm < max(self.max_extension_mm, bent_mm)]
            share = deployed / tube.bending_stiffness_n_mm2
            if twisted and tube.slotted_segments:
                raise impossible(
                    f"{name}.slotted_segments",
                    len(tube.slotted_segments),
                    "none where more than one tube is bent: how slots soften a tube that is twisted is not "
                    "modelled",
                )
            if np.ptp(share) > 0.0 or abs(share[0] - other) > ROUNDING:
                raise impossible(
                    f"{name}.slotted_segments",
                    len(tube.slotted_segments),
                    f"the same stiffness_factor for {'both' if self.middle is None else 'all'} tubes over "
                    f"the whole max_extension_mm = {self.max_extension_mm:g} from their tips: plans assume "
                    "that they share their bend as plain tubes do",
                )

    @property
    def planar(self) -> bool:
        """Whether at most the inner of two tubes is bent, by one arc: the shape has a closed form."""
        bent = any(tube.bends for tube in self.nested[1:])
        return self.middle is None and not bent and not self.inner.bent_pieces

    def require_planar(self, what: str) -> None:
        """Raise SettingsError unless the tubes are planar, which `what` needs."""
        if not self.planar:
            raise SettingsError(
                f"{what} is asked for with {len(self.nested)} tubes, of which "
                f"{sum(bool(tube.bends) for tube in self.nested)} are bent",
                expected="one tube of one arc, or a straight outer and an inner tube of one arc: only these "
                "have a closed form",
                remedy="Leave that out, or choose a system with such tubes, for instance lung-default",
            )

    @property
    def passing_mm(self) -> float:
        """Length of tube, from its tip, that passes bends of the airways when it is inserted farthest."""
        return self.max_extension_mm + AIRWAY_MM

    @property
    def channel_curvature_per_mm(self) -> float:
        """Largest curvature of channel that the tubes may pass, 1/mm: as stated, or what strain allows."""
        if self.max_channel_curvature_per_mm is not None:
            return self.max_channel_curvature_per_mm
        return min(tube.most_bent_per_mm(self.max_strain, self.passing_mm) for tube in self.nested)

    def _check_nesting(self) -> None:
        if self.max_extension_mm > self.inner.length_mm:
            allowed = f"at most inner.length_mm = {self.inner.length_mm:g}"
            raise impossible("max_extension_mm", self.max_extension_mm, allowed)
        if self.middle is not None and self.outer is None:
            raise impossible("middle", "there", "left out where there is no tubes.outer")
        for (name, around), (within, tube) in pairwise(self.named):
            clearance = around.inner_diameter_mm - tube.outer_diameter_mm
            if clearance <= 0.0 or clearance < self.min_clearance_mm - 1e-9:
                raise impossible(
                    f"{within}.outer_diameter_mm",
                    tube.outer_diameter_mm,
                    f"less than {name}.inner_diameter_mm = {around.inner_diameter_mm:g}, by at least "
                    f"min_clearance_mm = {self.min_clearance_mm:g}",
                )
            if tube.length_mm < around.length_mm:
                allowed = f"at least {name}.length_mm = {around.length_mm:g}"
                raise impossible(f"{within}.length_mm", tube.length_mm, allowed)

    @property
    def nested(self) -> tuple[Tube, ...]:
        """The tubes, the innermost first."""
        return tuple(tube for _name, tube in reversed(self.named))

    @property
    def named(self) -> tuple[tuple[str, Tube], ...]:
        """The tubes with their names in a device file, the outermost first."""
        all_three = (("outer", self.outer), ("middle", self.middle), ("inner", self.inner))
        return tuple((name, tube) for name, tube in all_three if tube is not None)

    @property
    def outermost(self) -> Tube:
        """The tube that lies in the channel of the scope."""
        return self.nested[-1]

    @property
    def max_inner_protrusion_mm(self) -> float:
        """Length of inner tube that can be ahead of the outer one, mm, their rear ends being in order."""
        return self.inner.length_mm - (0.0 if self.outer is None else self.outer.length_mm)

    def with_needle(self, shaft: Tube | None) -> "ConcentricTubes":
        """Return the tubes with a straight needle kept at the inner tip; no file states it among them."""
        made = replace(self)
        object.__setattr__(made, "needle_shaft", shaft)
        return made

    @property
    def curved_out_mm(self) -> float:
        """Length from the inner tube's tip within which tubes are bent ahead of the scope at most, mm."""
        if any(tube.bends for tube in self.nested[1:]):
            return self.max_extension_mm
        return min(self.inner.bent_length_mm, self.max_extension_mm)

    @property
    def overlap_curvature_per_mm(self) -> float:
        """Curvature of the inner tube's bent part inside the straight outer tube of planar tubes, 1/mm."""
        return self._shared_curvature(*self.nested[1:])

    @property
    def free_curvature_per_mm(self) -> float:
        """Curvature of the inner tube's bent part ahead of all other tubes where they are planar, 1/mm."""
        return self._shared_curvature()

    def _shared_curvature(self, *around: Tube) -> float:
        """Return a bent inner tube's curvature in others, 1/mm, by bending stiffness [Rucker2010]."""
        straight = around if self.needle_shaft is None else (self.needle_shaft, *around)
        inner, *others = (float(tube.parts.stiffness_n_mm2[0]) for tube in (self.inner, *straight))
        return self.inner.precurvature_per_mm * (inner / (inner + sum(others)))


def straightening(
    tubes: ConcentricTubes,
    insertions_mm: ArrayLike,
    bending_length_mm: float,
    section_stiffness_n_mm2: float,
    *,
    needle: Tube | None = None,
    needle_out_mm: float = 0.0,
) -> float:
    """Return the bending stiffness of what lies in a scope's bending section, as a share of the section's.

    Beam in beam: the section's own bending moment, which the handle sets, also bends what is inside.  With
    the share q the handle must be set to 1 + q times the bend that is wanted [Rucker2010, for tubes].
    Where the tubes are not equally stiff all along the section, their stiffest part there counts, and of the
    needle the stiffest that passes the section on the whole of its way.

    Args:
        insertions_mm ((n,) float64): Of the tubes beyond the scope's tip, the outermost first; the last are
            those of the tubes there are.
        needle_out_mm: How far the needle goes beyond the tip of the inner tube.
    """
    total = 0.0
    inserted = np.asarray(insertions_mm, dtype=np.float64)[-len(tubes.nested) :]
    for (_name, tube), out_mm in zip(tubes.named, inserted, strict=True):
        parts = tube.parts
        inside = (parts.end_mm > out_mm) & (parts.begin_mm < out_mm + bending_length_mm)
        total += float(parts.stiffness_n_mm2[inside].max(initial=0.0))
    if needle is not None:
        passing_mm = float(inserted[-1]) + needle_out_mm + bending_length_mm
        total += float(needle.parts.stiffness_n_mm2[needle.parts.begin_mm < passing_mm].max())
    return total / section_stiffness_n_mm2

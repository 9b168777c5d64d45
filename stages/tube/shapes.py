"""All deployments of a design in the frame of the scope tip: their shapes, and what it takes to get there.

They do not depend on the patient, who only decides where the scope tip is and how all tubes together are
turned about it.
"""

import itertools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from stages.tube.arcs import TubeShape
from stages.tube.device import Tube
from stages.tube.equilibrium import SAME_MM, matrices
from stages.tube.kernels import shapes as kernel
from stages.tube.mechanics import TubeMechanics
from stages.tube.sequences import BEND_RAD

SNAPS = "the tubes would snap on the way"
SWEEPS = "the tubes would sweep tissue sideways"
STRAINS = "a tube would be strained too much"


@settings
class ShapeLimits:
    """What a deployment may do, whatever the patient."""

    max_extension_mm: Annotated[
        float, quantity("largest extension beyond the tip of the scope", above=0.0, at_most=300.0)
    ] = 60.0
    max_lateral_sweep_mm: Annotated[
        float, quantity("largest sideways motion of the tubes in tissue", at_least=0.0, at_most=20.0)
    ] = 1.0
    max_strain: Annotated[float, quantity("largest strain of the material", above=0.0, at_most=0.1)] = 0.04


@settings
class ShapeGrid:
    """Which deployments are looked at.

    All tubes stop at multiples of `stop_mm`, or a little less or more, so that the last stop is the
    longest insertion; the rear ends of bent tubes are turned against the innermost of them by multiples of
    360 degrees over `rotations`.
    """

    stop_mm: Annotated[float, quantity("spacing of insertions", above=0.0, at_most=50.0)] = 2.0
    rotations: Annotated[int, quantity("relative rotations of a tube", at_least=1, at_most=360)] = 24

    @classmethod
    def default(cls, tubes: Sequence[Tube]) -> "ShapeGrid":
        """Return the grid for a design: coarser for two independent rotations, whose deployments are many."""
        if _free_rotations(tubes) > 1:
            return cls(stop_mm=4.0, rotations=12)
        return cls()


@frozen_record
class TubeShapes:
    """The S deployments of a design of n tubes that can be reached and keep the limits, and counts of others.

    Tubes are listed from the innermost.  The sequence to each is that of `stages.tube.sequences.together`.

    Args:
        insertions_mm, rotations_rad ((S, n) float64): How far each tube comes out, and how its rear end is
            turned; 0 bends towards +x of the scope tip.
        tip_angles_rad ((S, n) float64): Rotation of each tube at its own end.
        arcs ((A, 4) float64): Length in mm; direction of the bend in rad about the tangent, from +x of a
            frame that is carried along without turning; curvature in 1/mm; outermost radius in mm.
        first_arc ((S + 1,) int64): Where the arcs of each deployment begin.
        scope_from_tip ((S, 4, 4) float64): Frame carried to the innermost tip without turning; +z forward.
        least_determinant ((S,) float64): Least on the whole way; see `Equilibrium.determinant`.
        lateral_sweep_mm, follow_the_leader_error_mm ((S,) float64): Largest on the whole way; see
            `DeployedSequence`.  Between steps it is bounded by second differences.
        strain ((S,) float64): Largest of bending on the whole way, the scope being straight.
        arc_error_mm ((S,) float64): Largest distance between arcs and tubes; clearances are larger by it.
        candidates: Deployments looked at.
        refused: Counts by reason.
    """

    tubes: tuple[Tube, ...]
    limits: ShapeLimits
    grid: ShapeGrid
    insertions_mm: Float
    rotations_rad: Float
    tip_angles_rad: Float
    arcs: Float
    first_arc: Int
    scope_from_tip: Float
    least_determinant: Float
    lateral_sweep_mm: Float
    follow_the_leader_error_mm: Float
    strain: Float
    arc_error_mm: Float
    candidates: int
    refused: dict[str, int]

    @property
    def count(self) -> int:
        """Number of deployments, S."""
        return len(self.insertions_mm)

    @property
    def stop_mm(self) -> float:
        """Spacing of the insertions, mm."""
        longest = min(self.limits.max_extension_mm, self.tubes[0].length_mm)
        return longest / _n_stops(longest, self.grid)

    def arcs_of(self, shape: int) -> Float:
        """Return the arcs `(a, 4)` of one deployment."""
        return self.arcs[self.first_arc[shape] : self.first_arc[shape + 1]]

    def member(self, shape: int) -> TubeShape:
        """Return one deployment by itself."""
        return TubeShape(
            insertions_mm=self.insertions_mm[shape],
            rotations_rad=self.rotations_rad[shape],
            arcs=self.arcs_of(shape),
            lateral_sweep_mm=float(self.lateral_sweep_mm[shape]),
            follow_the_leader_error_mm=float(self.follow_the_leader_error_mm[shape]),
            arc_error_mm=float(self.arc_error_mm[shape]),
            least_determinant=float(self.least_determinant[shape]),
        )

    def subset(self, members: Int) -> "TubeShapes":
        """Return some of the deployments `(M,)` as a set."""
        counts = np.diff(self.first_arc)[members]
        chosen: dict[str, Any] = {
            name: read_only(getattr(self, name)[members])
            for name in (
                "insertions_mm", "rotations_rad", "tip_angles_rad", "scope_from_tip", "least_determinant",
                "lateral_sweep_mm", "follow_the_leader_error_mm", "strain", "arc_error_mm",
            )
        }  # fmt: skip
        arcs = [self.arcs_of(shape) for shape in members.tolist()]
        return replace(
            self,
            **chosen,
            arcs=read_only(np.concatenate([self.arcs[:0], *arcs])),
            first_arc=read_only(np.concatenate([[0], np.cumsum(counts)])),
        )


def tube_shapes(
    tubes: Sequence[Tube],
    limits: ShapeLimits | None = None,
    grid: ShapeGrid | None = None,
    *,
    needle: Tube | None = None,
) -> TubeShapes:
    """Return all deployments of a design that follow a stable branch of equilibria and keep its limits.

    A straight needle's tip stays where that of the innermost tube is; without a grid it is the default.

    Raises:
        SettingsError: If there are more than three tubes, they do not nest, or slots make them other than
            plain tubes scaled: several of them are bent, or not all are equally softened.
    """
    if len(tubes) > 3:
        raise SettingsError(
            f"There are {len(tubes)} tubes",
            expected="one, two or three",
            remedy="Leave out tubes, or ask `deploy` for single deployments",
        )
    limits, grid = limits or ShapeLimits(), grid or ShapeGrid.default(tubes)
    mechanics = TubeMechanics(tubes, needle=needle)
    longest = min(limits.max_extension_mm, float(mechanics.lengths_mm[0]))
    stops = np.linspace(0.0, longest, _n_stops(longest, grid) + 1)
    states, parents = _states(mechanics, stops)
    # Of the rear ends; 0 for straight tubes and the first bent one.
    turns = 2.0 * math.pi / grid.rotations * np.arange(grid.rotations)
    bent = [number for number, tube in enumerate(mechanics.tubes) if tube.bends]
    free = [turns if number in bent[1:] else turns[:1] for number in range(mechanics.count)]
    rotations = np.array(list(itertools.product(*free)))
    strained = strained_radii(mechanics.tubes, float(stops[-1]))

    def with_rotations(base: Float) -> tuple[Float, Int, Float, Float]:
        return _follow(mechanics, strained, base + BEND_RAD, stops, states, parents)

    # The kernel runs without the interpreter's lock.
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(with_rotations, rotations))
    results, firsts, arcs, tips = zip(*found, strict=True)
    values = np.concatenate(results)
    kept, refused = _within(values, limits)
    counts = np.concatenate([np.diff(first) for first in firsts])
    values = values[kept]
    return TubeShapes(
        tubes=mechanics.tubes,
        limits=limits,
        grid=grid,
        insertions_mm=read_only(np.tile(stops[states], (len(rotations), 1))[kept]),
        rotations_rad=read_only(np.repeat(rotations, len(states), axis=0)[kept]),
        tip_angles_rad=read_only(np.concatenate(tips)[kept]),
        arcs=read_only(np.concatenate(arcs)[np.repeat(kept, counts)]),
        first_arc=read_only(np.concatenate([[0], np.cumsum(counts[kept])])),
        scope_from_tip=read_only(matrices(values[:, kernel.TIP :])),
        least_determinant=read_only(values[:, kernel.LEAST].copy()),
        lateral_sweep_mm=read_only(values[:, kernel.SWEEP].copy()),
        follow_the_leader_error_mm=read_only(values[:, kernel.LEADER].copy()),
        strain=read_only(values[:, kernel.STRAIN].copy()),
        arc_error_mm=read_only(values[:, kernel.ERROR].copy()),
        candidates=len(rotations) * (len(states) - 1),
        refused=refused,
    )


def strained_radii(tubes: Sequence[Tube], longest_mm: float) -> Float:
    """Return the strain of each tube for each 1/mm `(n,)`, mm, and check that slots change no shape."""
    softened, strained = [], []
    for tube in tubes:
        bent_mm = tube.length_mm - min((bend.from_mm for bend in tube.bends), default=tube.length_mm)
        parts = tube.parts
        out = parts.begin_mm < max(longest_mm, bent_mm)
        softened.append(parts.stiffness_n_mm2[out] / tube.bending_stiffness_n_mm2)
        strained.append(float(parts.strained_radius_mm[out].max()))
    factors = np.concatenate(softened)
    slotted = any(tube.slotted_segments for tube in tubes)
    # Rounding of stiffness factors.
    if np.ptp(factors) > 1e-9 or (slotted and _free_rotations(tubes) > 0):
        raise SettingsError(
            f"{sum(bool(tube.slotted_segments) for tube in tubes)} of {len(tubes)} tubes have slots, with "
            f"{factors.min():g} to {factors.max():g} of the plain stiffness, and "
            f"{sum(bool(tube.bends) for tube in tubes)} are bent",
            expected="slots of one stiffness_factor in all tubes, where they come out, and one bent tube",
            remedy="Leave out slotted_segments: how slots soften a tube that is twisted is not modelled",
        )
    return np.array(strained)


def _free_rotations(tubes: Sequence[Tube]) -> int:
    """Return how many tubes can be turned against another so that the shape changes."""
    return max(sum(bool(tube.bends) for tube in tubes) - 1, 0)


def _n_stops(longest_mm: float, grid: ShapeGrid) -> int:
    return max(round(longest_mm / grid.stop_mm), 1)


def _states(mechanics: TubeMechanics, stops: Float) -> tuple[Int, Int]:
    """Return deployments as indices of stops `(S, n)`, and the one before: the farthest tubes go back."""
    lengths, n = mechanics.lengths_mm, mechanics.count
    of: dict[tuple[int, ...], int] = {}
    states: list[tuple[int, ...]] = []
    parents: list[int] = []
    for state in sorted(itertools.combinations_with_replacement(range(len(stops) - 1, -1, -1), n)):
        ahead = -np.diff(stops[list(state)])
        if (ahead > -np.diff(lengths) + SAME_MM).any() or (stops[list(state)] > lengths + SAME_MM).any():
            continue
        flush = sum(place == state[0] for place in state)
        before = (*[state[0] - 1] * flush, *state[flush:])
        parents.append(of[before] if state[0] > 0 else -1)
        of[state] = len(states)
        states.append(state)
    return np.array(states, dtype=np.int64), np.array(parents, dtype=np.int64)


def _follow(
    mechanics: TubeMechanics, strained: Float, base: Float, stops: Float, states: Int, parents: Int
) -> tuple[Float, Int, Float, Float]:
    """Return results, first arcs, arcs and tip angles for given rotations of the rear ends."""
    results, tips = np.zeros((len(states), kernel.SHAPE_COLUMNS)), np.zeros(states.shape)
    first = np.zeros(len(states) + 1, dtype=np.int64)
    radii = np.array([tube.radius_mm for tube in mechanics.tubes])
    # The room for arcs is doubled where that is too little.
    room = 16 * len(states)
    while True:
        arcs = np.zeros((room, kernel.ARC_COLUMNS))
        count = kernel.follow_all(
            mechanics.design, radii, strained, base, stops, states, parents, mechanics.step_rad, tips,
            results, first, arcs,
        )  # fmt: skip
        if count >= 0:
            return results, first, arcs[:count].copy(), tips
        room *= 2


def _within(results: Float, limits: ShapeLimits) -> tuple[np.ndarray, dict[str, int]]:
    """Return which deployments keep the limits `(S,)`, and how many do not by reason."""
    verdicts = {
        SNAPS: results[:, kernel.LEAST] <= 0.0,
        STRAINS: results[:, kernel.STRAIN] > limits.max_strain,
        SWEEPS: results[:, kernel.SWEEP] > limits.max_lateral_sweep_mm,
    }
    kept = results[:, kernel.EXTENSION] > 0.0
    refused = {}
    for why, wrong in verdicts.items():
        refused[why] = int((kept & wrong).sum())
        kept &= ~wrong
    return kept, {why: count for why, count in refused.items() if count}

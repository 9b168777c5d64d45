"""The path of a scope: its states one sub-step apart, and where its body lies."""

import math

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import freeze_arrays, read_only
from stages.scope.advisor import kinematics
from stages.scope.advisor.kinematics import ScopeModel, ScopeState
from stages.scope.advisor.nf1 import Goal


@frozen_record
class ScopePath:
    """A path of Algorithm 2 [Rosell2012]; M states.

    Parameters
    ----------
    states : (M, 14) float64
        See `ScopeState.of_array`.
    steps_mm : (M,) float64
        Advance of the base from the state before, 0 at the first.
    costs : (M,) float64
        Eq. 9 of the motion that led to the state, 0 at the first.
    potentials : (M,) float64
        Of the navigation field at the tip.
    reached : bool
        Whether the tip ends in the goal voxel.
    nearest : int
        The first state of least potential: the last one, except in reproduction.
    retreats : int
        How often the scope was pulled back and tried again.
    reproduction : bool
        Whether eq. 1 decided about collisions: then the path must not feed a plan.
    """

    model: ScopeModel
    goal: Goal
    states: Float
    steps_mm: Float
    costs: Float
    potentials: Float
    reached: bool
    nearest: int
    retreats: int
    reproduction: bool

    def __post_init__(self) -> None:
        freeze_arrays(self, "states", "steps_mm", "costs", "potentials", dtype=np.float64)

    @property
    def count(self) -> int:
        """Number of states, M."""
        return len(self.states)

    @property
    def length_mm(self) -> float:
        """How far the scope is advanced."""
        return float(self.steps_mm.sum())

    @property
    def lps_from_tip(self) -> Float:
        """The pose to hand over to the tubes: the tip nearest to the goal, looking along +z, `(4, 4)`."""
        frame: Float = read_only(kinematics.tip_frames(self.model, self.states[self.nearest])[0])
        return frame

    @property
    def distance_mm(self) -> float:
        """From the nearest tip to the centre of the goal voxel."""
        return float(np.linalg.norm(self.lps_from_tip[:3, 3] - self.goal.centre_lps))

    @property
    def distance_to_lesion_mm(self) -> float:
        """From the nearest tip to the surface of the lesion, 0 inside."""
        away = float(np.linalg.norm(self.lps_from_tip[:3, 3] - self.goal.lesion_lps))
        return max(away - self.goal.lesion_radius_mm, 0.0)

    def state(self, number: int) -> ScopeState:
        """Return a state by its number."""
        return ScopeState.of_array(self.states[number])

    def tips(self) -> Float:
        """Return the tip poses `lps_from_tip` of all states, `(M, 4, 4)`."""
        return kinematics.tip_frames(self.model, self.states)

    def between(self, number: int, fraction: float) -> Float:
        """Return the state (14,) at a fraction of the motion from state `number - 1` to state `number`.

        The base moves along its arc while twist and bend change evenly.
        """
        before, after = self.states[number - 1], self.states[number]
        advance_mm = fraction * float(self.steps_mm[number])
        moved = kinematics.advanced(
            self.model, ScopeState.of_array(before), advance_mm, float(after[12]), float(after[13])
        ).array
        moved[12:] = before[12:] + fraction * (after[12:] - before[12:])
        return moved

    def body(self, number: int, spacing_mm: float = 0.25) -> Float:
        """Return points `(B, 3)` LPS mm along the body in a state, from the first base to the tip.

        Behind the base the body lies where the base has been.
        """
        shaft = [self.states[0, 9:12]]
        for k in range(1, number + 1):
            pieces = max(1, math.ceil(float(self.steps_mm[k]) / spacing_mm))
            shaft += [self.between(k, n / pieces)[9:12] for n in range(1, pieces + 1)]
        chain = kinematics.joints(self.model, self.states[number])[0]
        pieces = max(1, math.ceil(self.model.link_mm / spacing_mm))
        share = (np.arange(pieces)[:, None] + 1.0) / pieces
        links = [a + share * (b - a) for a, b in zip(chain[:-1], chain[1:], strict=True)]
        return np.concatenate([np.array(shaft), *links])

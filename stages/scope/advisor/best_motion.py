"""The best motion: 121 candidates (eq. 3) and their costs (eqs. 4 to 9) [Rosell2012].

Where all valid candidates have the same potential, K_NF1 is 0 for all; the same holds for K_cl.  A range of 0
adds nothing to K_alpha.  Among equals the first wins, in the order of the table.
"""

import math
from collections.abc import Iterator
from typing import Annotated

import numpy as np

from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.settings import impossible, quantity, settings
from anatomy.base.typed import Float, Int
from anatomy.grid import read_only
from stages.scope.advisor.environment import ScopeEnvironment
from stages.scope.advisor.kernels import motion as kernel
from stages.scope.advisor.kinematics import ScopeState

VERDICTS = ("out of range", "leads away", "collides", "valid")
CANDIDATES = kernel.CANDIDATES


@settings
class Weights:
    """Weights of a motion's cost (eq. 9), which add up to 1: for goal, middle, few and steady twists."""

    nf1: Annotated[float, quantity("weight of the potential", at_least=0.0, at_most=1.0)] = 0.4
    clearance: Annotated[float, quantity("weight of the clearance", at_least=0.0, at_most=1.0)] = 0.4
    twist: Annotated[float, quantity("weight of the twist", at_least=0.0, at_most=1.0)] = 0.2

    def __post_init__(self) -> None:
        total = self.nf1 + self.clearance + self.twist
        # Weights may add up to 1 but for rounding.
        if not abs(total - 1.0) <= 1e-9:
            raise impossible("nf1", self.nf1, f"the three weights add up to {total:g}, not 1")

    @property
    def array(self) -> Float:
        """The weights in the order of eq. 9."""
        return np.array([self.nf1, self.clearance, self.twist])


@frozen_value
class Motion:
    """An advance, back if negative, and the twist alpha and bend beta when it is done."""

    advance_mm: float
    twist_rad: float
    bend_rad: float


@frozen_record
class Candidates:
    """The candidates of a motion and what they cost; C = 121 rows, twist by twist.

    Args:
        best: Row of least cost, -1 if none is valid.
        twist_rad, bend_rad: (C,) float64.
        verdict ((C,) int64): Index into `VERDICTS`.  Only what leads on is tried for collision.
        potential ((C,) float64): At the voxel of the tip; infinity in the wall.
        k_nf1, k_clearance, k_twist ((C,) float64): Eqs. 4, 7 and 8, in [0, 1]; 0 for candidates that are not
            valid.
        cost ((C,) float64): Eq. 9; infinity for candidates that are not valid.
        look_at_lps ((C, 3) float64, LPS mm): Where the tip would be (fig. 5).
    """

    advance_mm: float
    best: int
    twist_rad: Float
    bend_rad: Float
    verdict: Int
    potential: Float
    k_nf1: Float
    k_clearance: Float
    k_twist: Float
    cost: Float
    look_at_lps: Float

    def motion(self, row: int) -> Motion:
        """Return the motion of a row."""
        return Motion(
            advance_mm=self.advance_mm,
            twist_rad=float(self.twist_rad[row]),
            bend_rad=float(self.bend_rad[row]),
        )


@frozen_value
class MotionEvaluation:
    """The evaluation of the user's own motion beside the candidates: one of `VERDICTS`, and eq. 9.

    The cost has the extremes of the candidates, its terms held to [0, 1]; it is infinite if the motion is not
    valid.
    """

    verdict: str
    cost: float


def offsets(rng: np.random.Generator | None) -> Float:
    """Return the random shares (121, 2) of a spacing that move candidates, zeros without a generator."""
    if rng is None:
        return np.zeros((CANDIDATES, 2))
    return np.asarray(rng.uniform(-0.5, 0.5, (CANDIDATES, 2)))


def evaluate_motions(
    environment: ScopeEnvironment,
    state: ScopeState,
    advance_mm: float,
    weights: Weights,
    *,
    rng: np.random.Generator | None = None,
    own: Motion | None = None,
) -> tuple[Candidates, MotionEvaluation | None]:
    """Evaluate all candidates from a state (eqs. 3 to 9), and the user's own motion if there is one.

    The tip of the state lies in the lumen; all look ahead by `advance_mm`.  A generator moves all candidates
    but the middle one at random within their spacing (fig. 5b); else they stay on the grid of eq. 3.
    """
    table = np.zeros((CANDIDATES + (own is not None), kernel.COLUMNS))
    if own is not None:
        table[CANDIDATES, kernel.TWIST], table[CANDIDATES, kernel.BEND] = own.twist_rad, own.bend_rad
    best = kernel.best_motion(
        environment.arrays, environment.scope, state.array, float(advance_mm), weights.array, offsets(rng),
        table,
    )  # fmt: skip
    mine = None
    if own is not None:
        row = table[CANDIDATES]
        mine = MotionEvaluation(verdict=VERDICTS[int(row[kernel.VERDICT])], cost=float(row[kernel.COST]))
        scope = environment.scope
        in_range = scope.twist_low <= own.twist_rad <= scope.twist_high
        if not (in_range and scope.bend_low <= own.bend_rad <= scope.bend_high):
            mine = MotionEvaluation(verdict=VERDICTS[0], cost=math.inf)
    return _candidates(table[:CANDIDATES], float(advance_mm), int(best)), mine


def _candidates(table: Float, advance_mm: float, best: int) -> Candidates:
    def columns() -> Iterator[tuple[str, Float]]:
        yield "twist_rad", table[:, kernel.TWIST]
        yield "bend_rad", table[:, kernel.BEND]
        yield "potential", table[:, kernel.POTENTIAL]
        yield "k_nf1", table[:, kernel.COST_NF1]
        yield "k_clearance", table[:, kernel.COST_CLEARANCE]
        yield "k_twist", table[:, kernel.COST_TWIST]
        yield "cost", table[:, kernel.COST]
        yield "look_at_lps", table[:, kernel.LOOK_X :]

    verdict = read_only(table[:, kernel.VERDICT].astype(np.int64))
    parts = {name: read_only(values) for name, values in columns()}
    return Candidates(advance_mm=advance_mm, best=best, verdict=verdict, **parts)

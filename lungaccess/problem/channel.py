"""What tubes in the channel ask of the handle, and what the needle does to the tubes that aim it."""

import math

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.records import frozen_value
from lungaccess.problem.system import System
from stages.tube import straightening


def bend_factor(system: System, *insertions_mm: float) -> float:
    """Return by how much more the handle must bend the section while tubes and needle are in it, 1 or more.

    The tubes are inserted by so much beyond the tip, the outermost first; see `stages.tube.straightening`.
    """
    return _factor(system, insertions_mm, system.scope.bending_length_mm)


def bends_with_tubes_rad(system: System) -> tuple[float, float]:
    """Return the bends farthest down (0 or negative) and up that the section keeps, filled, in rad.

    They hold for every insertion: for each tube the stiffest part counts that may come to lie in the section.
    The handle bends an empty section up to `bend_down_deg` and `bend_up_deg`.
    """
    tubes, scope = system.tubes, system.scope
    factor = _factor(system, np.zeros(len(tubes.nested)), scope.bending_length_mm + tubes.max_extension_mm)
    down, up = scope.bends_rad
    return (
        max(down, -math.radians(scope.bend_down_deg) / factor),
        min(up, math.radians(scope.bend_up_deg) / factor),
    )


def _factor(system: System, insertions_mm: ArrayLike, length_mm: float) -> float:
    """Return the factor where so much of the tubes behind their insertions may lie in the section."""
    shaft, stiffness = system.tubes.needle_shaft, system.scope.bending_stiffness_n_mm2
    out_mm = 0.0 if system.needle is None else system.needle.max_length_mm
    return 1.0 + straightening(
        system.tubes, insertions_mm, length_mm, stiffness, needle=shaft, needle_out_mm=out_mm
    )


@frozen_value
class NeedleLoad:
    """What the needle does to tubes, in the air, when its tip arrives at theirs.

    Args:
        ratio: See `stiffness_ratio`.
        out_mm: How far the inner tube is inserted beyond the scope, the others not at all: its whole curve is
            out, or as much of it as its limits allow.
        shift_mm, turn_deg: By how much the tip of the inner tube moves, and its direction turns.
    """

    ratio: float
    out_mm: float
    shift_mm: float
    turn_deg: float

    @property
    def words(self) -> str:
        """The load in one sentence."""
        return (
            f"The needle is {self.ratio:.2g} times as stiff as the inner tube: when it arrives, the tip of "
            f"the inner tube, inserted by {self.out_mm:.0f} mm, moves by {self.shift_mm:.1f} mm and turns by "
            f"{self.turn_deg:.0f}°. No plan counts that."
        )


def stiffness_ratio(system: System) -> float:
    """Return how many times as stiff in bending the needle is as the tube that aims it, 0 if it is neglected.

    Of the needle the stiffest part counts that comes to lie in tubes beyond the scope, on its whole way; of
    the inner tube the softest part that comes out of the scope.
    """
    shaft, tubes = system.needle_tube, system.tubes
    if shaft is None:
        return 0.0
    passing_mm = tubes.max_extension_mm + system.require_needle("Its stiffness").max_length_mm
    needle = shaft.parts.stiffness_n_mm2[shaft.parts.begin_mm < passing_mm].max()
    parts = tubes.inner.parts
    return float(needle / parts.stiffness_n_mm2[parts.begin_mm < tubes.max_extension_mm].min())


def needle_load(system: System) -> NeedleLoad | None:
    """Return what a system's needle does to its tubes; None without one, or if its stiffness is neglected.

    The section does not give way here, and no tissue holds it; docs/explanation/tubes.md says what they do.
    """
    from stages.tube import TubeMechanics

    shaft, tubes = system.needle_tube, system.tubes
    if shaft is None:
        return None
    bent_mm = max((tubes.inner.length_mm - bend.from_mm for bend in tubes.inner.bends), default=0.0)
    ahead_mm = tubes.max_extension_mm
    if tubes.outer is not None:
        ahead_mm = min(ahead_mm, tubes.inner.length_mm - tubes.nested[1].length_mm)
    out_mm = min(bent_mm, ahead_mm) or ahead_mm
    mechanics = TubeMechanics(tubes.nested, needle=shaft)
    beta = -mechanics.lengths_mm
    beta[0] += out_mm
    before, arrived = (
        mechanics.given_base_angles(np.zeros(mechanics.count), beta, needle_mm=at).base_from_tip
        for at in (0.0, out_mm)
    )
    ahead, was = arrived[:3, 2], before[:3, 2]
    return NeedleLoad(
        ratio=stiffness_ratio(system),
        out_mm=out_mm,
        shift_mm=float(np.linalg.norm(arrived[:3, 3] - before[:3, 3])),
        turn_deg=math.degrees(math.atan2(float(np.linalg.norm(np.cross(ahead, was))), float(ahead @ was))),
    )


def system_warnings(system: System) -> tuple[str, ...]:
    """Return what no plan with a system counts, in sentences with numbers."""
    load = None if system.needle_preloaded else needle_load(system)
    # A needle that moves the tubes' tip by less is not worth a warning: a tenth of a mm is far below errors.
    return () if load is None or load.shift_mm < 0.1 else (load.words,)

"""How a bronchoscope moves: advance, twist and bend of a chain of links [Rosell2012, sec. IV-C]."""

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.settings import impossible, quantity, settings
from anatomy.base.typed import Float
from anatomy.grid import read_only
from anatomy.poses import pose
from stages.scope.advisor.kernels import chain
from stages.scope.device import Bronchoscope

FREEST_TWIST_DEG = 90.0
"""A device is turned so far to either side; as it bends up and down, it then bends in every direction."""

TIP_FROM_TOOL = np.diag([1.0, -1.0, -1.0, 1.0])
"""The tool frame looks along its -z, a tip frame along its +z."""


@settings
class ScopeModel:
    """A chain of n = `links` links of length l; the defaults are those of [Rosell2012].

    n l is the length of the bending tip.  The ranges of the twist alpha and of the bend beta, which is that
    of all links together, hold 0; `bend_step_deg` is the spacing of the candidates' bends (eq. 3).  Raises
    SettingsError if a value is absurd, or one joint would bend by 90 degrees or more.
    """

    links: Annotated[int, Field(description="links with coupled joints", strict=True, ge=1, le=200)] = 10
    link_mm: Annotated[float, quantity("length of a link", above=0.0, at_most=20.0)] = 1.0
    radius_mm: Annotated[float, quantity("radius of the scope with its gap", above=0.0, at_most=15.0)] = 1.0
    twist_low_deg: Annotated[float, quantity("least twist", at_least=-360.0, at_most=0.0)] = -60.0
    twist_high_deg: Annotated[float, quantity("largest twist", at_least=0.0, at_most=360.0)] = 90.0
    bend_low_deg: Annotated[float, quantity("least bend", at_least=-270.0, at_most=0.0)] = -90.0
    bend_high_deg: Annotated[float, quantity("largest bend", at_least=0.0, at_most=270.0)] = 120.0
    bend_step_deg: Annotated[float, quantity("spacing of the bends tried", above=0.0, at_most=45.0)] = 5.0

    def __post_init__(self) -> None:
        most = max(-self.bend_low_deg, self.bend_high_deg)
        if most >= 90.0 * self.links:
            raise impossible(
                "links", self.links, f"more than {most / 90.0:g}: a joint bends by less than 90 degrees"
            )

    @property
    def length_mm(self) -> float:
        """Length of the bending tip, n l."""
        return self.links * self.link_mm


def model_of(scope: Bronchoscope, *, links: int = 10) -> ScopeModel:
    """Return the chain of a device: its radius with the gap it keeps, its bends, twists of 90 degrees.

    Its bends are those of its whole bending section; a shorter chain bends at most as tightly as that of
    [Rosell2012], 120 degrees in 10 mm.
    """
    # The tip of a device is bent at most so much for each mm of its chain, as that of [Rosell2012].
    most = 12.0 * links
    return ScopeModel(
        links=links,
        radius_mm=scope.radius_mm + scope.lumen_margin_mm,
        twist_low_deg=-FREEST_TWIST_DEG,
        twist_high_deg=FREEST_TWIST_DEG,
        bend_low_deg=-min(scope.bend_down_deg, most),
        bend_high_deg=min(scope.bend_up_deg, most),
    )


@frozen_record
class ScopeState:
    """Where the scope is: the base `(4, 4)` of its bending tip, and how the tip is turned, alpha and beta.

    The scope points along -z; a positive bend at twist 0 turns it towards +y.  The base never rolls about its
    axis.
    """

    lps_from_base: Float
    twist_rad: float = 0.0
    bend_rad: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "lps_from_base", read_only(np.array(self.lps_from_base, dtype=np.float64)))

    @property
    def array(self) -> Float:
        """The `(14,)` array that kernels take."""
        frame = self.lps_from_base
        return np.concatenate([frame[:3, :3].ravel(), frame[:3, 3], [self.twist_rad, self.bend_rad]])

    @classmethod
    def of_array(cls, array: Float) -> "ScopeState":
        """Return the state in a `(14,)` array."""
        frame = np.eye(4)
        frame[:3, :3] = array[:9].reshape(3, 3)
        frame[:3, 3] = array[9:12]
        return cls(lps_from_base=frame, twist_rad=float(array[12]), bend_rad=float(array[13]))


def straight_state(base_lps: Float, forward: Float) -> ScopeState:
    """Return the state of a straight scope whose bending tip begins at a point, turned as `start_state`."""
    frame = pose(base_lps, forward)
    base = np.eye(4)
    base[:3, :3] = np.column_stack([frame[:3, 1], frame[:3, 0], -frame[:3, 2]])
    base[:3, 3] = base_lps
    return ScopeState(lps_from_base=base)


def advanced(
    model: ScopeModel, state: ScopeState, distance_mm: float, twist_rad: float, bend_rad: float
) -> ScopeState:
    """Algorithm 1 of [Rosell2012]: return the state with a new twist and bend, advanced along its circle.

    A negative distance with the present twist and bend takes an advance back exactly.  Raises SettingsError
    if a value is not finite, or a joint would bend by 180 degrees or more.
    """
    values = (distance_mm, twist_rad, bend_rad)
    if not np.isfinite(values).all() or abs(bend_rad) >= math.pi * model.links:
        raise SettingsError(
            f"The scope cannot move by {distance_mm:g} mm with twist {twist_rad:g} and bend {bend_rad:g} rad",
            expected="finite values, a joint bent by less than 180 degrees",
        )
    moved = chain.advance(state.array, model.link_mm, model.links, *(float(value) for value in values))
    return ScopeState.of_array(moved)


def joints(model: ScopeModel, states: Float) -> Float:
    """Return base, joints and tool centre point of states (M, 14): `(M, links + 1, 3)` LPS mm."""
    return _bodies(model, states)[0]


def tool_frames(model: ScopeModel, states: Float) -> Float:
    """Return the tool frames `(M, 4, 4)` of states (M, 14): the chain of Table I [Rosell2012].

    The camera looks along -z.  Table I prints no angle between the axes of twist and bend; they are
    perpendicular here, as fig. 3 draws them.  A link is a step along the axis, then the turn of its joint:
    only in this order do all joints lie on the circle of Algorithm 1.
    """
    return _bodies(model, states)[1]


def tip_frames(model: ScopeModel, states: Float) -> Float:
    """Return `lps_from_tip` `(M, 4, 4)` of states (M, 14): the tool frames turned to look along +z."""
    return np.asarray(tool_frames(model, states) @ TIP_FROM_TOOL)


def _bodies(model: ScopeModel, states: Float) -> tuple[Float, Float]:
    rows: Float = np.ascontiguousarray(np.atleast_2d(states))
    points, frames = np.zeros((len(rows), model.links + 1, 3)), np.zeros((len(rows), 4, 4))
    chain.bodies(rows, model.link_mm, model.links, points, frames)
    return points, frames

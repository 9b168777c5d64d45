"""The mechanics of concentric tubes as CasADi functions, for exact derivatives and as a second opinion.

This is the model of `stages.tube.mechanics` in the form of [Rucker2010]: the state is the frame of the
innermost tube, the angles of the others relative to it and the torsional moments, and Runge-Kutta steps
carry it from the tip to the front plate.  It is written from the equations and shares no arithmetic with
the kernels, so that either can test the other.  It is slow, but can be part of a nonlinear program.

Units are mm, N and rad.  Tubes are listed innermost first.  The base frame has its origin at the front
plate, where the arc length is 0, and +z forward.  Tubes are held straight behind the plate.
"""

import itertools
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import casadi
import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float
from anatomy.grid import read_only
from stages.tube.casadi_rates import (
    FIRST_ANGLE,
    POSITION,
    ROTATION,
    about_z,
    bending_n_mm2,
    determinant_function,
    landmarks_mm,
    rest_curvature_per_mm,
    rotation_of,
    runge_kutta,
    state_rates,
)
from stages.tube.device import Tube
from stages.tube.errors import ConvergenceError

DEFAULT_STEPS = 40
"""Runge-Kutta steps in each piece of constant stiffness and precurvature."""

LARGEST_RESIDUAL_RAD = 1e-9
"""A larger residual after Newton's method means that it did not converge."""
_NEWTON = {"abstol": 1e-12, "abstolStep": 1e-13, "max_iter": 60, "error_on_fail": False}


@frozen_value
class Order:
    """The order in which ends and bends of the tubes follow each other, the farthest from the plate first.

    A landmark is a tube and an index: places where its precurvature changes, from its base, and its end.
    """

    landmarks: tuple[tuple[int, int], ...]


@frozen_record
class CasadiEquilibrium:
    """One equilibrium of the tubes: angles `(n,)` at their own ends and at their bases.

    `base_from_tip` `(4, 4)` is the material frame of the innermost tube at its end, `determinant` that of the
    derivative of the base angles by the tip angles.
    """

    tip_angles_rad: Float
    base_angles_rad: Float
    base_from_tip: Float
    determinant: float


class OrderedTubes:
    """The functions of n tubes, the innermost first, whose landmarks keep one order.

    All are `casadi.Function`, made when first asked for, and can be called with numbers or with symbols.
    Vectors are columns.  Where the landmarks have another order the results mean nothing.  The error falls
    with the fourth power of `steps_per_piece`, the Runge-Kutta steps between two landmarks.
    """

    def __init__(self, tubes: Sequence[Tube], order: Order, *, steps_per_piece: int) -> None:
        self._tubes = tuple(tubes)
        self._order = order
        self._steps = steps_per_piece
        self._marks = [landmarks_mm(tube) for tube in tubes]
        self._ahead = [sum(tube == i for tube, _ in order.landmarks) for i in range(len(tubes))]

    @cached_property
    def forward(self) -> Any:
        """Function: tip angles (n,) rad, beta (n,) mm -> base angles, position, rotation, determinant.

        The base angles are (n,) rad, the position (3,) mm and the rotation (3, 3) are those of the tip in
        the base frame.  The determinant is that of the derivative of the base angles by the tip angles.
        It is 0 where two equilibria merge: a motion that begins stable and keeps it above 0 stays stable.
        """
        tip, beta = self._symbols("tip_angles_rad")
        base, position, rotation = self._integrate(tip, beta)
        determinant = determinant_function(len(self._tubes))(casadi.jacobian(base, tip))
        return casadi.Function(
            "forward",
            [tip, beta],
            [base, position, rotation, determinant],
            ["tip_angles_rad", "beta_mm"],
            ["base_angles_rad", "position_mm", "rotation", "determinant"],
        )

    @cached_property
    def equilibrium(self) -> Any:
        """Function: base angles (n,), beta (n,), guess (n,) -> tip angles, position, rotation, determinant.

        It finds by Newton's method the equilibrium near the guess of the tip angles.  Its derivatives are
        those of the implicit function, and the guess has none.  Call `forward` with the tip angles to see
        whether it converged.
        """
        base, beta = self._symbols("base_angles_rad")
        tip = casadi.MX.sym("tip_angles_rad", len(self._tubes))
        given = casadi.vertcat(base, beta)
        problem = {"x": tip, "p": given, "g": self._integrate(tip, beta)[0] - base}
        found = casadi.rootfinder("tip_angles", "newton", problem, _NEWTON)(x0=tip, p=given)["x"]
        _, position, rotation, determinant = self.forward(found, beta)
        return casadi.Function(
            "equilibrium",
            [base, beta, tip],
            [found, position, rotation, determinant],
            ["base_angles_rad", "beta_mm", "guess_rad"],
            ["tip_angles_rad", "position_mm", "rotation", "determinant"],
        )

    def _symbols(self, angles: str) -> tuple[Any, Any]:
        n = len(self._tubes)
        return casadi.MX.sym(angles, n), casadi.MX.sym("beta_mm", n)

    def _places(self, beta: Any) -> list[Any]:
        """Return the arc lengths of the landmarks, and of the plate."""
        return [beta[tube] + self._marks[tube][index] for tube, index in self._order.landmarks] + [0.0]

    @cached_property
    def body(self) -> Any:
        """Function: tip angles (n,) rad, beta (n,) mm -> `(3 + n, N)` from tip, as `CasadiTubes.body`."""
        tip, beta = self._symbols("tip_angles_rad")
        passed: list[Any] = []
        _, position, rotation = self._integrate(tip, beta, passed)
        from_tip = casadi.horzcat(casadi.MX.zeros(3), *(states[POSITION, :] for states in passed))
        others = slice(FIRST_ANGLE + 1, FIRST_ANGLE + len(self._tubes))
        relative = casadi.horzcat(tip[1:] - tip[0], *(states[others, :] for states in passed))
        gaps = [(far - near) / self._steps for far, near in itertools.pairwise(self._places(beta))]
        spacing = casadi.vertcat(0, *(casadi.repmat(gap, self._steps) for gap in gaps))
        s = self._places(beta)[0] - casadi.cumsum(spacing)
        points = casadi.repmat(position, 1, from_tip.shape[1]) + rotation @ from_tip
        return casadi.Function("body", [tip, beta], [casadi.vertcat(s.T, points, relative)])

    def _integrate(self, tip: Any, beta: Any, states: list[Any] | None = None) -> tuple[Any, Any, Any]:
        """Return the base angles, and position and rotation of the tip; list all states of each piece."""
        n = len(self._tubes)
        state = casadi.vertcat(0, 0, 0, 1, 0, 0, 0, tip[0], casadi.MX.zeros(2 * n - 1))
        gaps = itertools.pairwise(self._places(beta))
        passed = [0] * n
        for (tube, _), (far, near) in zip(self._order.landmarks, gaps, strict=True):
            passed[tube] += 1
            if tube > 0 and passed[tube] == 1:
                state[FIRST_ANGLE + tube] = tip[tube] - state[FIRST_ANGLE]
            step, length = self._step(passed), (near - far) / self._steps
            if states is None:
                state = step.fold(self._steps)(state, length)
                continue
            states.append(step.mapaccum(self._steps)(state, casadi.repmat(length, 1, self._steps)))
            state = states[-1][:, -1]
        first = state[FIRST_ANGLE]
        others = [first + state[FIRST_ANGLE + i] if passed[i] else tip[i] for i in range(1, n)]
        angles = casadi.vertcat(first, *others)
        rates = state[-n:] / casadi.DM([tube.torsional_stiffness_n_mm2 for tube in self._tubes])
        rotation = about_z(angles[0]) @ rotation_of(state[ROTATION]).T
        return angles + beta * rates, -rotation @ state[POSITION], rotation

    def _step(self, passed: Sequence[int]) -> Any:
        """Return the Runge-Kutta step, state and mm -> state, of a piece with `passed` landmarks ahead."""
        state, length = casadi.SX.sym("state", FIRST_ANGLE + 2 * len(self._tubes)), casadi.SX.sym("step_mm")
        bending, rest = [], []
        for tube, marks, count in zip(self._tubes, self._marks, passed, strict=True):
            bending.append(bending_n_mm2(tube, marks, len(marks) - count))
            rest.append(rest_curvature_per_mm(tube, marks, len(marks) - count))
        twisting = [tube.torsional_stiffness_n_mm2 for tube in self._tubes]
        rate = casadi.Function("rate", [state], [state_rates(state, bending, twisting, rest)])
        return casadi.Function("step", [state, length], [runge_kutta(rate, state, length)])


class CasadiTubes:
    """The mechanics of concentric tubes, the innermost, longest first, whatever the order of their landmarks.

    Raises:
        SettingsError: If there is no tube or no step.
    """

    def __init__(self, tubes: Sequence[Tube], *, steps_per_piece: int = DEFAULT_STEPS) -> None:
        if not tubes or steps_per_piece < 1:
            raise SettingsError(
                f"{len(tubes)} tubes and {steps_per_piece} steps in a piece", expected="at least 1 of each"
            )
        self._tubes = tuple(tubes)
        self._steps = steps_per_piece
        self._ordered: dict[Order, OrderedTubes] = {}

    def order_at(self, beta_mm: ArrayLike) -> Order:
        """Return the order of the landmarks of tubes whose bases are at arc lengths `(n,)`, at most 0.

        Raises SettingsError if a base is ahead of the plate, an end is behind it, a tube ends ahead of one
        inside it, or numbers are missing or not finite.
        """
        beta = self._vector(beta_mm, "beta")
        ends = beta + [tube.length_mm for tube in self._tubes]
        if not ((beta <= 0.0).all() and (ends >= 0.0).all() and (np.diff(ends) <= 0.0).all()):
            raise SettingsError(
                f"The tubes' bases are at {beta.tolist()} mm and their ends at {ends.tolist()} mm",
                expected="bases at 0 or behind, ends at 0 or ahead, and none ahead of that of a tube inside",
            )
        ahead = [
            (-(beta[i] + mark), i, index)
            for i, tube in enumerate(self._tubes)
            for index, mark in enumerate(landmarks_mm(tube))
            if beta[i] + mark > 0.0
        ]
        return Order(landmarks=tuple((i, index) for _, i, index in sorted(ahead)))

    def ordered(self, order: Order) -> OrderedTubes:
        """Return the functions for one order; they are kept."""
        if order not in self._ordered:
            self._ordered[order] = OrderedTubes(self._tubes, order, steps_per_piece=self._steps)
        return self._ordered[order]

    def given_tip_angles(self, tip_angles_rad: ArrayLike, beta_mm: ArrayLike) -> CasadiEquilibrium:
        """Return the equilibrium with tip angles and bases `(n,)`; errors are those of `order_at`."""
        tip, beta = self._vector(tip_angles_rad, "tip angles"), self._vector(beta_mm, "beta")
        base, position, rotation, determinant = self.ordered(self.order_at(beta)).forward(tip, beta)
        base_from_tip = np.eye(4)
        base_from_tip[:3, :3], base_from_tip[:3, 3] = rotation.full(), position.full()[:, 0]
        return CasadiEquilibrium(
            tip_angles_rad=read_only(tip),
            base_angles_rad=read_only(base.full()[:, 0]),
            base_from_tip=read_only(base_from_tip),
            determinant=float(determinant),
        )

    def body(self, tip_angles_rad: ArrayLike, beta_mm: ArrayLike) -> Float:
        """Return arc lengths, points and relative angles `(N, 3 + n)` in mm and rad, from front plate to tip.

        The angles are those of all tubes but the innermost, relative to it, where they are.
        Parameters and errors are those of `given_tip_angles`; something has to be ahead of the plate.
        """
        tip, beta = self._vector(tip_angles_rad, "tip angles"), self._vector(beta_mm, "beta")
        return read_only(np.array(self.ordered(self.order_at(beta)).body(tip, beta).full()).T[::-1].copy())

    def solve(
        self, base_angles_rad: ArrayLike, beta_mm: ArrayLike, guess_rad: ArrayLike | None = None
    ) -> CasadiEquilibrium:
        """Return the equilibrium with base angles `(n,)` that Newton's method finds from guessed tip angles.

        The guess is the base angles if none is given.  Raises SettingsError as `order_at`, and
        ConvergenceError if the method does not converge from this guess.
        """
        base, beta = self._vector(base_angles_rad, "base angles"), self._vector(beta_mm, "beta")
        guess = base if guess_rad is None else self._vector(guess_rad, "guess")
        functions = self.ordered(self.order_at(beta))
        tip = functions.equilibrium(base, beta, guess)[0]
        residual = float(np.abs(functions.forward(tip, beta)[0].full()[:, 0] - base).max())
        if not residual <= LARGEST_RESIDUAL_RAD:
            raise ConvergenceError(
                f"Newton's method leaves base angles wrong by {residual:.3g} rad",
                expected=f"at most {LARGEST_RESIDUAL_RAD:g} rad",
                remedy="Begin nearer to an equilibrium",
            )
        return self.given_tip_angles(tip.full()[:, 0], beta)

    def _vector(self, values: ArrayLike, name: str) -> Float:
        found = np.array(values, dtype=np.float64)
        if found.shape != (len(self._tubes),) or not np.isfinite(found).all():
            raise SettingsError(
                f"The {name} are {found.tolist()}", expected=f"{len(self._tubes)} finite numbers, one a tube"
            )
        return found

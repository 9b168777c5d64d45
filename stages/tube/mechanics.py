"""The shape of nested precurved tubes: torsion, stability, tip, and how it moves with the joints.

Units mm, N, rad.  Tubes are listed from the innermost, which is the longest.  The base frame has its origin
at the front plate, which is the tip of the bronchoscope, and +z forward; a tube whose material is not turned,
and whose precurvature has direction 0, bends towards -y.  Behind the front plate tubes are held straight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicHermiteSpline

from anatomy.errors import SettingsError
from anatomy.grid import read_only
from anatomy.typed import Bool, Float
from stages.tube.device import Tube
from stages.tube.errors import ConvergenceError
from stages.tube.kernels import all_equilibria, assembly, equilibrium, jacobian, pose, torsion

STEP_RAD = 0.075
"""Angle of the fastest torsional oscillation that one step spans; tips are then right to about 1e-6 mm."""
LARGEST_COUNT = 64
"""Of equilibria that are looked for."""
SAME_MM = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Equilibria of M configurations of n tubes.

    Parameters
    ----------
    tip_angles_rad : (M, n) float64
    base_from_tip : (M, 4, 4) float64
        Tip frame of the innermost tube's material.
    converged, stable : (M,) bool
    least_determinant : (M,) float64
        See `Equilibrium.determinant`.
    residual_rad : (M,) float64
        Largest error of a rear end's angle.
    """

    tip_angles_rad: Float
    base_from_tip: Float
    converged: Bool
    stable: Bool
    least_determinant: Float
    residual_rad: Float


class TubeMechanics:
    """Nested tubes without external load, compliant in torsion [Rucker2010], [Dupont2010].

    Parameters
    ----------
    tubes : sequence of Tube
        One or more, the innermost first.
    step_rad : float
        Steps span at most this angle of the fastest torsional oscillation: a half of it makes errors 16
        times smaller.
    least_clearance_mm : float, optional
        By how much each tube must be thinner than the bore of the next; None for textbook tubes of any
        diameter.

    Raises
    ------
    SettingsError
        If there is no tube, a tube does not fit into the next one or is shorter than it, or the step is not
        between 0 and 1.
    """

    def __init__(
        self, tubes: Sequence[Tube], *, step_rad: float = STEP_RAD, least_clearance_mm: float | None = 0.0
    ) -> None:
        check_nesting(tubes, least_clearance_mm)
        if not 0.0 < step_rad <= 1.0:
            raise SettingsError(f"The step is {step_rad:g} rad", expected="above 0, at most 1")
        self.tubes = tuple(tubes)
        self.step_rad = float(step_rad)
        self.lengths_mm = read_only(np.array([tube.length_mm for tube in self.tubes]))
        stiffness = [[t.bending_stiffness_n_mm2, t.torsional_stiffness_n_mm2] for t in self.tubes]
        bends = [(float(i), *bend) for i, tube in enumerate(self.tubes) for bend in tube.bends]
        self._design = (np.array(stiffness), np.array(self.lengths_mm), np.array(bends).reshape(-1, 5))

    @property
    def count(self) -> int:
        """Number of tubes, n."""
        return len(self.tubes)

    def given_tip_angles(self, tip_angles_rad: ArrayLike, beta_mm: ArrayLike) -> Equilibrium:
        """Return the equilibrium with given rotations of the tubes' own ends: it always exists.

        Parameters
        ----------
        tip_angles_rad : (n,) float64
            Rotation of each tube's material at its end against the Bishop frame, not wrapped.
        beta_mm : (n,) float64
            Where the rear ends are: 0 at the front plate, negative behind it.

        Raises
        ------
        SettingsError
            If numbers are missing or not finite, a rear end is ahead of the front plate or of that of the
            next tube, or a tube ends behind the front plate or ahead of one that it encloses.
        """
        return Equilibrium(self, self._joints(tip_angles_rad, "tip angles"), self._shifts(beta_mm))

    def given_base_angles(
        self,
        base_angles_rad: ArrayLike,
        beta_mm: ArrayLike,
        *,
        guess_rad: ArrayLike | None = None,
        prefer_stable: bool = True,
    ) -> Equilibrium:
        """Return an equilibrium with given rotations of the rear ends.

        From the guess Newton's method is tried; if it fails or ends at an unstable equilibrium, the
        precurvature is raised from nothing, and then guesses all round are tried.  So what is returned is
        unstable only if no stable equilibrium was found, or it was not preferred.

        Parameters
        ----------
        base_angles_rad : (n,) float64
            Not wrapped: a full turn between tubes is another state.
        beta_mm : (n,) float64
            See `given_tip_angles`.
        guess_rad : (n,) float64, optional
            Tip angles to start from, such as those of a configuration nearby; by default the base angles.
        prefer_stable : bool
            If False, an unstable equilibrium next to the guess is as good.

        Raises
        ------
        ConvergenceError
            If no equilibrium is found.
        SettingsError
            See `given_tip_angles`.
        """
        base, beta = self._joints(base_angles_rad, "base angles"), self._shifts(beta_mm)
        tip = base.copy() if guess_rad is None else self._joints(guess_rad, "guess")
        results = np.zeros((1, equilibrium.RESULT_COLUMNS))
        tips = tip[None].copy()
        equilibrium.settle_many(
            self._design, base[None], beta[None], self.step_rad, prefer_stable, tips, results
        )
        if not results[0, equilibrium.CONVERGED]:
            raise ConvergenceError(
                f"No equilibrium was found for base angles {np.round(base, 4).tolist()} rad and rear ends at "
                f"{np.round(beta, 3).tolist()} mm",
                expected="an equilibrium; one exists, but Newton's method did not come near it",
                remedy="give tip angles of a configuration nearby as a guess",
            )
        return Equilibrium(self, tips[0], beta)

    def equilibria(self, base_angles_rad: ArrayLike, beta_mm: ArrayLike) -> tuple[Equilibrium, ...]:
        """Return all equilibria of one or two tubes with given rotations of the rear ends.

        They are sorted by the angle between the tips.  Of several, stable and unstable ones take turns.

        Raises
        ------
        SettingsError
            If there are more than two tubes; see `given_tip_angles` too.
        """
        base, beta = self._joints(base_angles_rad, "base angles"), self._shifts(beta_mm)
        if self.count == 1:
            return (self.given_base_angles(base, beta),)
        if self.count > 2:
            raise SettingsError(
                f"All equilibria of {self.count} tubes are asked for",
                expected="two tubes at most",
                remedy="use given_base_angles with several guesses",
            )
        cutting, n_steps = self._cut(beta)
        nodes, steps = _room(n_steps, 2, 1)
        found = np.zeros(LARGEST_COUNT)
        number = all_equilibria.all_of_two(
            self._design, cutting, beta, float(base[0] - base[1]), nodes, steps, found
        )
        out = []
        for between in found[: min(number, LARGEST_COUNT)]:
            there = Equilibrium(self, np.array([between, 0.0]), beta)
            turn = base[1] - there.base_angles_rad[1]
            out.append(Equilibrium(self, np.array([between + turn, turn]), beta))
        return tuple(out)

    def batch(
        self, base_angles_rad: ArrayLike, beta_mm: ArrayLike, *, guess_rad: ArrayLike | None = None
    ) -> Batch:
        """Return the equilibria of many configurations; see `given_base_angles`.

        Parameters
        ----------
        base_angles_rad, beta_mm : (M, n) float64
        guess_rad : (M, n) float64, optional

        Raises
        ------
        SettingsError
            See `given_tip_angles`.  What does not converge is marked, not raised.
        """
        base = np.array(base_angles_rad, dtype=np.float64, order="C", ndmin=2)
        beta = np.array(beta_mm, dtype=np.float64, order="C", ndmin=2)
        tips = base.copy() if guess_rad is None else np.array(guess_rad, dtype=np.float64, ndmin=2)
        for name, values in (("base angles", base), ("rear ends", beta), ("guess", tips)):
            if values.shape != (len(base), self.count) or not np.isfinite(values).all():
                raise SettingsError(
                    f"The {name} have the shape {values.shape}",
                    expected=f"({len(base)}, {self.count}), all finite",
                )
        self._check_shifts(beta)
        results = np.zeros((len(base), equilibrium.RESULT_COLUMNS))
        equilibrium.settle_many(self._design, base, beta, self.step_rad, True, tips, results)
        return Batch(
            tip_angles_rad=read_only(tips),
            base_from_tip=read_only(matrices(results[:, equilibrium.TIP :])),
            converged=read_only(results[:, equilibrium.CONVERGED] == 1.0),
            stable=read_only(results[:, equilibrium.STABLE] == 1.0),
            least_determinant=read_only(results[:, equilibrium.LEAST_DETERMINANT].copy()),
            residual_rad=read_only(results[:, equilibrium.RESIDUAL].copy()),
        )

    def _joints(self, values: ArrayLike, name: str) -> Float:
        found = np.array(values, dtype=np.float64)
        if found.shape != (self.count,) or not np.isfinite(found).all():
            raise SettingsError(
                f"The {name} are {found.tolist()}", expected=f"{self.count} finite numbers, one for each tube"
            )
        return found

    def _shifts(self, beta_mm: ArrayLike) -> Float:
        beta = self._joints(beta_mm, "rear ends")
        self._check_shifts(beta[None])
        return beta

    def _check_shifts(self, beta: Float) -> None:
        ends = beta + self.lengths_mm
        for wrong, what, expected in (
            (beta > 0.0, "A rear end is ahead of the front plate", "0 mm or less"),
            (ends < 0.0, "A tube ends behind the front plate", "-length_mm or more"),
            (np.diff(beta, axis=1) < -SAME_MM, "A rear end is ahead of the next one", "the innermost last"),
            (np.diff(ends, axis=1) > SAME_MM, "A tube ends ahead of one in it", "the innermost first"),
        ):  # fmt: skip
            if wrong.any():
                row = int(np.argwhere(wrong)[0, 0])
                raise SettingsError(f"{what}: rear ends at {beta[row].tolist()} mm", expected=expected)

    def _cut(self, beta: Float) -> tuple[tuple[Any, ...], int]:
        most = 1 + self.count + 2 * len(self._design[2])
        pieces = np.zeros((most, assembly.PIECE_COLUMNS))
        moments, directions = np.zeros((most, self.count)), np.zeros((most, self.count))
        count, n_steps = assembly.cut(self._design, beta, self.step_rad, pieces, moments, directions)
        return (pieces, moments, directions, count), int(n_steps)


class Equilibrium:
    """One equilibrium: shape, torsion, stability and the tip's motion.

    Made by `TubeMechanics`, which says what its parameters are.
    """

    def __init__(self, mechanics: TubeMechanics, tip_angles_rad: Float, beta_mm: Float) -> None:
        n = mechanics.count
        self.mechanics = mechanics
        self.tip_angles_rad = read_only(tip_angles_rad.copy())
        self.beta_mm = read_only(beta_mm.copy())
        self._cutting, n_steps = mechanics._cut(beta_mm)
        self._nodes, self._steps = _room(n_steps, n, 2 * n)
        owners = np.concatenate([-1 - np.arange(n), np.arange(n)])
        torsion.twist(mechanics._design, self._cutting, tip_angles_rad, owners, self._nodes, self._steps)
        self._poses = np.zeros((n_steps + 1, 12))
        pose.lay(self._cutting, self._nodes, self._steps, self._poses)

    @property
    def base_angles_rad(self) -> Float:
        """Rotation of the rear ends `(n,)`, rad, not wrapped."""
        return np.asarray(self._nodes[1][0] + self.beta_mm * self._nodes[2][0])

    @property
    def length_mm(self) -> float:
        """Arc length of the tip of the innermost tube from the front plate, mm."""
        return float(self._nodes[0][-1])

    @cached_property
    def base_from_tip(self) -> Float:
        """Tip frame `(4, 4)` of the innermost tube's material."""
        tip = matrices(self._poses[-1:])[0]
        cosine, sine = math.cos(self.tip_angles_rad[0]), math.sin(self.tip_angles_rad[0])
        tip[:3, :2] = tip[:3, :2] @ np.array([[cosine, -sine], [sine, cosine]])
        return read_only(tip)

    @property
    def tube_tips_mm(self) -> Float:
        """Where each tube ends, `(n, 3)` mm."""
        return self.backbone(self.beta_mm + self.mechanics.lengths_mm)

    @cached_property
    def least_determinant(self) -> float:
        """Least of the determinants along the tubes; -inf where two directions lose stability at once."""
        return float(equilibrium.least_determinant(self._relative_nodes(), self.beta_mm))

    @property
    def stable(self) -> bool:
        """Whether this is a minimum of elastic energy: the determinant is above 0 all along."""
        return self.least_determinant > 0.0

    def frames(self, arc_lengths_mm: ArrayLike) -> Float:
        """Return Bishop frames `(N, 4, 4)` at arc lengths `(N,)` from the front plate, straight behind it.

        Raises
        ------
        SettingsError
            If an arc length is not finite or beyond the tip.
        """
        s = self._arc_lengths(arc_lengths_mm)
        found = matrices(self._along(s)[0])
        found[s < 0.0, 2, 3] = s[s < 0.0]
        return found

    def backbone(self, arc_lengths_mm: ArrayLike) -> Float:
        """Return points `(N, 3)` mm of the centreline; see `frames`."""
        return np.asarray(self.frames(arc_lengths_mm)[:, :3, 3])

    def angles(self, arc_lengths_mm: ArrayLike) -> Float:
        """Return rotations `(N, n)` of the tubes' material against the Bishop frame, rad.

        NaN where a tube is not: ahead of its end and behind its rear end.
        """
        s = self._arc_lengths(arc_lengths_mm)
        _poses, psi, rates = self._along(s)
        behind = np.minimum(s, 0.0)[:, None]
        return np.where(self._there(s), psi + behind * rates, np.nan)

    def torsion(self, arc_lengths_mm: ArrayLike) -> Float:
        """Return torsion `(N, n)` of the tubes, rad/mm, NaN where a tube is not."""
        s = self._arc_lengths(arc_lengths_mm)
        return np.where(self._there(s), self._along(s)[2], np.nan)

    def determinant(self, arc_lengths_mm: ArrayLike) -> Float:
        """Return det d psi(s) / d psi_tip `(N,)`; see `least_determinant`."""
        s = self._arc_lengths(arc_lengths_mm)
        n = self.mechanics.count
        matrix, right = np.zeros((n - 1, n - 1)), np.zeros(n - 1)
        found = np.ones(len(s))
        for m, x in enumerate(s):
            dpsi, drate = self._derivatives_at(float(x))
            found[m] = equilibrium.determinant_at(
                dpsi, drate, self.beta_mm, min(float(x), 0.0), matrix, right
            )
        return found

    def _derivatives_at(self, s: float) -> tuple[Float, Float]:
        """Return the derivatives of angles and torsion by all tip angles but the last, `(n - 1, n)`."""
        arc_lengths, _psi, _rate, dpsi, drate = self._relative_nodes()
        if s <= 0.0 or len(arc_lengths) == 1:
            return dpsi[0], drate[0]
        at = min(int(np.searchsorted(arc_lengths, s, "right")) - 1, len(arc_lengths) - 2)
        h = float(arc_lengths[at + 1] - arc_lengths[at])
        share = (s - float(arc_lengths[at])) / h
        angles = CubicHermiteSpline([0.0, h], dpsi[at : at + 2], drate[at : at + 2])
        return angles(share * h), angles(share * h, 1)

    @cached_property
    def jacobian_of_tip_angles(self) -> Float:
        """The tip's motion `(6, 2 n)` by tip angles and by shifts of the rear ends, the others held.

        Rows: velocity of the tip in mm, then rotation in rad, in the base frame.
        """
        n = self.mechanics.count
        moved = np.zeros((2 * n, 6))
        jacobian.motions(self._cutting, self._nodes, self._steps, self._poses, moved)
        tip = self._poses[-1, 9:]
        rotation, translation = moved[:, :3], moved[:, 3:]
        velocity = translation + np.cross(rotation, tip)
        # The innermost tube's material turns with its own tip angle too.
        turned = rotation.copy()
        turned[0] += self._poses[-1, [2, 5, 8]]
        return read_only(np.concatenate([velocity, turned], axis=1).T.copy())

    @cached_property
    def base_angle_derivatives(self) -> tuple[Float, Float]:
        """Derivatives `(n, n)` of the base angles by tip angles and by shifts, rad/rad and rad/mm."""
        n = self.mechanics.count
        _s, _psi, rate, dpsi, drate = self._nodes
        found = dpsi[0].T + self.beta_mm[:, None] * drate[0].T
        found[:, n:] += np.diag(rate[0])
        return read_only(found[:, :n].copy()), read_only(found[:, n:].copy())

    @cached_property
    def jacobian(self) -> Float:
        """The tip's motion `(6, 2 n)` by base angles (rad) and by shifts of the rear ends (mm).

        Rows: velocity of the tip in mm, then rotation in rad, in the base frame [Rucker2011].

        Raises
        ------
        ConvergenceError
            If the equilibrium is just losing stability, so that it does not follow the base smoothly.
        """
        n = self.mechanics.count
        by_tip, by_shift = self.base_angle_derivatives
        free = self.jacobian_of_tip_angles
        try:
            through = np.linalg.solve(by_tip.T, free[:, :n].T).T
        except np.linalg.LinAlgError:
            raise ConvergenceError(
                "The tip's motion has no limit: the tubes are about to snap", expected="a stable equilibrium"
            ) from None
        return read_only(np.concatenate([through, free[:, n:] - through @ by_shift], axis=1))

    def _relative_nodes(self) -> tuple[Float, ...]:
        s, psi, rate, dpsi, drate = self._nodes
        n = self.mechanics.count
        return s, psi, rate, np.ascontiguousarray(dpsi[:, : n - 1]), np.ascontiguousarray(drate[:, : n - 1])

    def _arc_lengths(self, arc_lengths_mm: ArrayLike) -> Float:
        s = np.atleast_1d(np.array(arc_lengths_mm, dtype=np.float64))
        if s.ndim != 1 or not np.isfinite(s).all() or (s > self.length_mm + 1e-6).any():
            raise SettingsError(
                f"The arc lengths have the shape {s.shape} and reach {s.max(initial=-math.inf):g} mm",
                expected=f"finite numbers in a row, at most {self.length_mm:g} mm, where the tip is",
            )
        return s

    def _there(self, s: Float) -> Bool:
        ends = self.beta_mm + self.mechanics.lengths_mm
        return np.asarray((s[:, None] >= self.beta_mm - 1e-9) & (s[:, None] <= ends + 1e-9))

    def _along(self, s: Float) -> tuple[Float, Float, Float]:
        n = self.mechanics.count
        poses, psi, rates = np.zeros((len(s), 12)), np.zeros((len(s), n)), np.zeros((len(s), n))
        if len(self._steps[0]) == 0:
            # Nothing is ahead of the front plate.
            poses[:, [0, 4, 8]] = 1.0
            return poses, psi + self.tip_angles_rad, rates
        for m, x in enumerate(s):
            pose.frame_at(
                self._cutting, self._nodes, self._steps, self._poses, float(x), poses[m], psi[m], rates[m]
            )
        return poses, psi, rates


def check_nesting(tubes: Sequence[Tube], least_clearance_mm: float | None = 0.0) -> None:
    """Check that tubes, the innermost first, fit into each other and that none is longer than one inside.

    Parameters
    ----------
    tubes : sequence of Tube
    least_clearance_mm : float, optional
        Least difference of diameters, which must be more than 0 in any case; None: any will do.

    Raises
    ------
    SettingsError
        If there is none, or they do not nest.
    """
    if not tubes:
        raise SettingsError("There is no tube", expected="one tube or more, the innermost first")
    for m in range(len(tubes) - 1):
        inner, outer = tubes[m], tubes[m + 1]
        clearance = outer.inner_diameter_mm - inner.outer_diameter_mm
        if least_clearance_mm is not None and not clearance > max(least_clearance_mm - SAME_MM, 0.0):
            raise SettingsError(
                f"Tube {m + 1} has an outer diameter of {inner.outer_diameter_mm:g} mm",
                expected=f"less than the inner diameter of tube {m + 2}, {outer.inner_diameter_mm:g} mm, by "
                f"{least_clearance_mm:g} mm or more",
            )
        if inner.length_mm < outer.length_mm:
            raise SettingsError(
                f"Tube {m + 1} is {inner.length_mm:g} mm long",
                expected=f"at least the length of tube {m + 2}, {outer.length_mm:g} mm",
            )


def matrices(poses: Float) -> Float:
    """Return `(M, 4, 4)` matrices of poses `(M, 12)`, rotation by rows and then position."""
    found = np.zeros((len(poses), 4, 4))
    found[:, :3, :3] = poses[:, :9].reshape(-1, 3, 3)
    found[:, :3, 3] = poses[:, 9:]
    found[:, 3, 3] = 1.0
    return found


def _room(n_steps: int, n: int, columns: int) -> tuple[Any, Any]:
    """Return `nodes` and `steps` for `torsion.twist`."""
    nodes = (
        np.zeros(n_steps + 1), np.zeros((n_steps + 1, n)), np.zeros((n_steps + 1, n)),
        np.zeros((n_steps + 1, columns, n)), np.zeros((n_steps + 1, columns, n)),
    )  # fmt: skip
    return nodes, (np.zeros(n_steps), np.zeros((n_steps, columns)), np.zeros(n_steps, np.int64))

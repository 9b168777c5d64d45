"""The mechanics of nested precurved tubes: their equilibria, compliant in torsion.

Units mm, N, rad.  Tubes are listed from the innermost, which is the longest.  The base frame has its origin
at the front plate, which is the tip of the bronchoscope, and +z forward; a tube whose material is not turned,
and whose precurvature has direction 0, bends towards -y.  Behind the front plate tubes are held straight.
"""

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float
from anatomy.grid import read_only
from stages.tube.equilibrium import SAME_MM, Equilibrium, NestedTubes, matrices
from stages.tube.errors import ConvergenceError
from stages.tube.kernels import equilibrium


@frozen_record
class Batch:
    """Equilibria of M configurations of n tubes: their tip angles `(M, n)`, and what else is known `(M,)`.

    The tip frame `(M, 4, 4)` is that of the innermost tube's material; `residual_rad` is the largest error of
    a rear end's angle; see `Equilibrium.determinant` for the least determinant.
    """

    tip_angles_rad: Float
    base_from_tip: Float
    converged: Bool
    stable: Bool
    least_determinant: Float
    residual_rad: Float


class TubeMechanics(NestedTubes):
    """Nested tubes without external load, compliant in torsion [Rucker2010], [Dupont2010].

    Args:
        tubes: One or more, the innermost first.
        needle: A straight needle or wire in the innermost tube, of which only the bending stiffness matters.
            It ends where that tube does, or anywhere; what is beyond the tubes is no part of their shape.
        step_rad: Steps span at most this angle of the fastest torsional oscillation; errors go with its 4th
            power.
        least_clearance_mm: By how much each tube must be thinner than the next one's bore; None for any size.

    Raises:
        SettingsError: If there is no tube, a tube or needle does not fit into the next one or is shorter than
            it, the needle is bent, or the step is not between 0 and 1.
    """

    def given_tip_angles(
        self, tip_angles_rad: ArrayLike, beta_mm: ArrayLike, *, needle_mm: float | None = None
    ) -> Equilibrium:
        """Return the equilibrium with given rotations `(n,)` of the tubes' own ends: it always exists.

        The rotations are those of the material against the Bishop frame, not wrapped; `beta_mm` `(n,)` tells
        where the rear ends are: 0 at the front plate, negative behind it.  The needle's tip is where that of
        the innermost tube is if None; at 0 or behind it changes nothing.

        Raises:
            SettingsError: If numbers are missing or not finite, or `check_shifts` refuses them.
        """
        tips, beta = self._joints(tip_angles_rad, "tip angles"), self._shifts(beta_mm)
        return Equilibrium(self, tips, beta, self._needle(needle_mm, beta[None])[0])

    def given_base_angles(
        self,
        base_angles_rad: ArrayLike,
        beta_mm: ArrayLike,
        *,
        needle_mm: float | None = None,
        guess_rad: ArrayLike | None = None,
    ) -> Equilibrium:
        """Return an equilibrium with given rotations `(n,)` of the rear ends; see `given_tip_angles`.

        They are not wrapped: a full turn between tubes is another state.  From the guess of the tip angles,
        by default the base angles, Newton's method is tried; if it fails or ends at an unstable equilibrium,
        the precurvature is raised from nothing, and then guesses all round are tried.  So what is returned is
        unstable only if no stable equilibrium was found.

        Raises:
            ConvergenceError: If no equilibrium is found.
            SettingsError: See `given_tip_angles`.
        """
        base, beta = self._joints(base_angles_rad, "base angles"), self._shifts(beta_mm)
        tip = base.copy() if guess_rad is None else self._joints(guess_rad, "guess")
        results = np.zeros((1, equilibrium.RESULT_COLUMNS))
        tips, needle = tip[None].copy(), self._needle(needle_mm, beta[None])
        rear = self.rear_ends(beta[None], needle)
        equilibrium.settle_many(self.design, base[None], rear, self.step_rad, True, tips, results)
        if not results[0, equilibrium.CONVERGED]:
            raise ConvergenceError(
                f"No equilibrium was found for base angles {np.round(base, 4).tolist()} rad and rear ends at "
                f"{np.round(beta, 3).tolist()} mm",
                expected="an equilibrium; one exists, but Newton's method did not come near it",
                remedy="give tip angles of a configuration nearby as a guess",
            )
        return Equilibrium(self, tips[0], beta, needle[0])

    def batch(
        self, base_angles_rad: ArrayLike, beta_mm: ArrayLike, *, needle_mm: ArrayLike | None = None
    ) -> Batch:
        """Return the equilibria of M configurations `(M, n)`; see `given_base_angles`.

        Raises:
            SettingsError: See `given_tip_angles`.  What does not converge is marked, not raised.
        """
        base = np.array(base_angles_rad, dtype=np.float64, order="C", ndmin=2)
        beta = np.array(beta_mm, dtype=np.float64, order="C", ndmin=2)
        tips = base.copy()
        for name, values in (("base angles", base), ("rear ends", beta)):
            if values.shape != (len(base), self.count) or not np.isfinite(values).all():
                raise SettingsError(
                    f"The {name} have the shape {values.shape}",
                    expected=f"({len(base)}, {self.count}), all finite",
                )
        self.check_shifts(beta)
        results = np.zeros((len(base), equilibrium.RESULT_COLUMNS))
        rear = self.rear_ends(beta, self._needle(needle_mm, beta))
        equilibrium.settle_many(self.design, base, rear, self.step_rad, True, tips, results)
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

    def _needle(self, needle_mm: ArrayLike | None, beta: Float) -> Float:
        """Return where the needle's tip is in configurations of rear ends `(M, n)`."""
        if needle_mm is None:
            return np.asarray(beta[:, 0] + self.lengths_mm[0])
        found = np.array(np.broadcast_to(np.asarray(needle_mm, dtype=np.float64), (len(beta),)))
        farthest = 0.0 if self.needle is None else self.needle.length_mm
        if not np.isfinite(found).all() or (found > farthest).any():
            raise SettingsError(
                f"The needle's tip is at {found.max(initial=-np.inf):g} mm",
                expected=f"a finite number of at most {farthest:g} mm, the needle's length",
            )
        return found

    def _shifts(self, beta_mm: ArrayLike) -> Float:
        beta = self._joints(beta_mm, "rear ends")
        self.check_shifts(beta[None])
        return beta

    def check_shifts(self, beta: Float) -> None:
        """Raise SettingsError if rear ends `(M, n)` or the tubes' ends are out of order."""
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

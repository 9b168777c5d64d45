"""Nested tubes as the kernels take them, and one equilibrium of theirs: its shape, torsion and stability."""

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Bool, Float
from anatomy.grid import read_only
from stages.tube.device import Tube
from stages.tube.kernels import assembly, equilibrium, pose, torsion

STEP_RAD = 0.075
"""Angle of the fastest torsional oscillation that one step spans; tips are then right to about 1e-6 mm."""
SAME_MM = 1e-9
"""Lengths that differ by less are equal: rounding."""


class NestedTubes:
    """Nested tubes as for `TubeMechanics`, in pieces of constant stiffness and precurvature."""

    def __init__(
        self,
        tubes: Sequence[Tube],
        *,
        needle: Tube | None = None,
        step_rad: float = STEP_RAD,
        least_clearance_mm: float | None = 0.0,
    ) -> None:
        check_nesting(tubes, least_clearance_mm)
        if needle is not None:
            check_nesting((needle, *tubes), least_clearance_mm)
            if needle.bends:
                raise SettingsError(
                    f"The needle is bent at {len(needle.bends)} places at rest", expected="a straight needle"
                )
        if not 0.0 < step_rad <= 1.0:
            raise SettingsError(f"The step is {step_rad:g} rad", expected="above 0, at most 1")
        self.tubes = tuple(tubes)
        self.needle = needle
        self.step_rad = float(step_rad)
        self.lengths_mm = read_only(np.array([tube.length_mm for tube in self.tubes]))
        bodies = self.tubes if needle is None else (*self.tubes, needle)
        stiffness = [[t.bending_stiffness_n_mm2, t.torsional_stiffness_n_mm2] for t in bodies]
        bends = [(float(i), *bend) for i, body in enumerate(bodies) for bend in _stretches(body)]
        self.design = (
            np.array(stiffness),
            np.array([body.length_mm for body in bodies]),
            np.array(bends).reshape(-1, 6),
        )

    @property
    def count(self) -> int:
        """Number of tubes, n."""
        return len(self.tubes)

    def rear_ends(self, beta_mm: Float, needle_mm: Float) -> Float:
        """Return the rear ends `(M, b)`, mm, of tubes `(M, n)` and of a needle whose tip is at `(M,)`."""
        if self.needle is None:
            return beta_mm
        return np.column_stack([beta_mm, needle_mm - self.needle.length_mm])

    def cut(self, beta: Float) -> tuple[tuple[Any, ...], int]:
        """Return the pieces of constant stiffness and precurvature, and their steps; rear ends `(b,)` mm."""
        scratch = equilibrium.cutting_scratch(self.design, self.count)
        count, n_steps = assembly.cut(self.design, beta, self.step_rad, *scratch)
        return (*scratch, count), int(n_steps)


def _stretches(tube: Tube) -> Iterator[tuple[float, ...]]:
    """Yield begin and end from the rear end, precurvature, its direction and share of the plain stiffness."""
    parts = tube.parts
    shares = parts.stiffness_n_mm2 / tube.bending_stiffness_n_mm2
    for begin, end, curvature, direction, share in zip(
        parts.begin_mm, parts.end_mm, parts.curvature_per_mm, parts.direction_rad, shares, strict=True
    ):
        if curvature > 0.0 or share != 1.0:
            yield tube.length_mm - end, tube.length_mm - begin, curvature, direction, share


def check_nesting(tubes: Sequence[Tube], least_clearance_mm: float | None = 0.0) -> None:
    """Check that tubes, the innermost first, fit into each other and that none is longer than one inside.

    Their diameters differ by more than 0 and at least by the clearance, or by anything if that is None.

    Raises:
        SettingsError: If there is none, or they do not nest.
    """
    if not tubes:
        raise SettingsError(
            "There is no tube",
            expected="one tube or more, the innermost first",
            remedy="Give the tubes, the innermost first",
        )
    for number, (inner, outer) in enumerate(pairwise(tubes), start=1):
        clearance = outer.inner_diameter_mm - inner.outer_diameter_mm
        if least_clearance_mm is not None and not clearance > max(least_clearance_mm - SAME_MM, 0.0):
            raise SettingsError(
                f"Tube {number} has an outer diameter of {inner.outer_diameter_mm:g} mm",
                expected=f"less than the inner diameter of tube {number + 1}, {outer.inner_diameter_mm:g} "
                f"mm, by {least_clearance_mm:g} mm or more",
                remedy="Make the inner tube thinner, or list the tubes from the inside",
            )
        if inner.length_mm < outer.length_mm:
            raise SettingsError(
                f"Tube {number} is {inner.length_mm:g} mm long",
                expected=f"at least the length of tube {number + 1}, {outer.length_mm:g} mm",
                remedy="Make the inner tube longer, or list the tubes from the inside",
            )


class Equilibrium:
    """One equilibrium: shape, torsion and stability, made by `TubeMechanics`, which says what is given."""

    def __init__(self, tubes: NestedTubes, tip_angles_rad: Float, beta_mm: Float, needle_mm: float) -> None:
        self.mechanics = tubes
        self.tip_angles_rad = read_only(tip_angles_rad.copy())
        self.beta_mm = read_only(beta_mm.copy())
        # As the kernels of the search have it: for a read-only array they would be compiled once more.
        self._beta_mm = beta_mm.copy()
        rear_ends = tubes.rear_ends(beta_mm[None], np.array([needle_mm]))[0].copy()
        self._cutting, n_steps = tubes.cut(rear_ends)
        self._nodes, self._steps = equilibrium.scratch_for(n_steps, tubes.count, tubes.count - 1)
        self._scratch = equilibrium.solving_scratch(tubes.count)
        torsion.twist(tubes.design, self._cutting, tip_angles_rad, self._nodes, self._steps, self._scratch[3])
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

    @cached_property
    def least_determinant(self) -> float:
        """Least of the determinants along the tubes; -inf where two directions lose stability at once."""
        return float(equilibrium.least_determinant(self._nodes, self._beta_mm, self._scratch))

    @property
    def stable(self) -> bool:
        """Whether this is a minimum of elastic energy: the determinant is above 0 all along."""
        return self.least_determinant > 0.0

    def frames(self, arc_lengths_mm: ArrayLike) -> Float:
        """Return Bishop frames `(N, 4, 4)` at arc lengths `(N,)` from the front plate, straight behind it.

        Raises SettingsError if an arc length is not finite or beyond the tip.
        """
        s = self._arc_lengths(arc_lengths_mm)
        found = matrices(self._along(s)[0])
        found[s < 0.0, 2, 3] = s[s < 0.0]
        return found

    def backbone(self, arc_lengths_mm: ArrayLike) -> Float:
        """Return points `(N, 3)` mm of the centreline; see `frames`."""
        return np.asarray(self.frames(arc_lengths_mm)[:, :3, 3])

    def angles(self, arc_lengths_mm: ArrayLike) -> Float:
        """Return rotations `(N, n)` of tubes against the Bishop frame, rad; NaN where a tube is not."""
        s = self._arc_lengths(arc_lengths_mm)
        _poses, psi, rates = self._along(s)
        return np.where(self._there(s), psi + np.minimum(s, 0.0)[:, None] * rates, np.nan)

    def torsion(self, arc_lengths_mm: ArrayLike) -> Float:
        """Return torsion `(N, n)` of the tubes, rad/mm, NaN where a tube is not."""
        s = self._arc_lengths(arc_lengths_mm)
        return np.where(self._there(s), self._along(s)[2], np.nan)

    def determinant(self, arc_lengths_mm: ArrayLike) -> Float:
        """Return det d psi(s) / d psi_tip `(N,)`; see `least_determinant`."""
        s = self._arc_lengths(arc_lengths_mm)
        matrix, _before, right, _work = self._scratch
        found = np.ones(len(s))
        for m, x in enumerate(s):
            dpsi, drate = self._derivatives_at(float(x))
            found[m] = equilibrium.determinant_at(
                dpsi[None], drate[None], 0, self._beta_mm, min(float(x), 0.0), matrix, right
            )
        return found

    def _derivatives_at(self, s: float) -> tuple[Float, Float]:
        """Return the derivatives of angles and torsion by all tip angles but the last, `(n - 1, n)`."""
        from scipy.interpolate import CubicHermiteSpline

        arc_lengths, _psi, _rate, dpsi, drate = self._nodes
        if s <= 0.0 or len(arc_lengths) == 1:
            return dpsi[0], drate[0]
        at = min(int(np.searchsorted(arc_lengths, s, "right")) - 1, len(arc_lengths) - 2)
        h = float(arc_lengths[at + 1] - arc_lengths[at])
        share = (s - float(arc_lengths[at])) / h
        angles = CubicHermiteSpline([0.0, h], dpsi[at : at + 2], drate[at : at + 2])
        return angles(share * h), angles(share * h, 1)

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
        pose.frames_at(self._cutting, self._nodes, self._steps, self._poses, s, poses, psi, rates)
        return poses, psi, rates


def matrices(poses: Float) -> Float:
    """Return `(M, 4, 4)` matrices of poses `(M, 12)`, rotation by rows and then position."""
    found = np.zeros((len(poses), 4, 4))
    found[:, :3, :3] = poses[:, :9].reshape(-1, 3, 3)
    found[:, :3, 3] = poses[:, 9:]
    found[:, 3, 3] = 1.0
    return found

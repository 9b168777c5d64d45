"""Nested tubes: whether they fit into each other, and their numbers as the kernels take them."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float
from anatomy.grid import read_only
from stages.tube.device import Tube
from stages.tube.kernels import assembly, equilibrium

STEP_RAD = 0.075
"""Angle of the fastest torsional oscillation that one step spans; tips are then right to about 1e-6 mm."""
SAME_MM = 1e-9
"""Lengths that differ by less are equal: rounding."""


class NestedTubes:
    """Nested tubes, the innermost first, cut into pieces of constant stiffness and precurvature.

    Parameters and errors are those of `TubeMechanics`.
    """

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

    Args:
        least_clearance_mm: Least difference of diameters, which must be more than 0 in any case; None: any
            will do.

    Raises:
        SettingsError: If there is none, or they do not nest.
    """
    if not tubes:
        raise SettingsError(
            "There is no tube",
            expected="one tube or more, the innermost first",
            remedy="Give the tubes, the innermost first",
        )
    for m in range(len(tubes) - 1):
        inner, outer = tubes[m], tubes[m + 1]
        clearance = outer.inner_diameter_mm - inner.outer_diameter_mm
        if least_clearance_mm is not None and not clearance > max(least_clearance_mm - SAME_MM, 0.0):
            raise SettingsError(
                f"Tube {m + 1} has an outer diameter of {inner.outer_diameter_mm:g} mm",
                expected=f"less than the inner diameter of tube {m + 2}, {outer.inner_diameter_mm:g} mm, by "
                f"{least_clearance_mm:g} mm or more",
                remedy="Make the inner tube thinner, or list the tubes from the inside",
            )
        if inner.length_mm < outer.length_mm:
            raise SettingsError(
                f"Tube {m + 1} is {inner.length_mm:g} mm long",
                expected=f"at least the length of tube {m + 2}, {outer.length_mm:g} mm",
                remedy="Make the inner tube longer, or list the tubes from the inside",
            )

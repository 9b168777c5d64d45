"""Shapes between those of the grid: any joint values near a deployment, fast enough for local search."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from stages.tube.device import Tube
from stages.tube.equilibrium import matrices
from stages.tube.following import deploy
from stages.tube.kernels import shapes as kernel
from stages.tube.mechanics import TubeMechanics
from stages.tube.sequences import BEND_RAD, together

ROOM = 4 * kernel.MOST_ARCS
"""For arcs: more than designs of three tubes have pieces; it grows where that is too little."""


@frozen_record
class NearbyShape:
    """A deployment of any joint values; see `TubeShapes` for its fields.

    The least determinant is that of the way from the deployment nearby.
    """

    insertions_mm: Float
    rotations_rad: Float
    tip_angles_rad: Float
    arcs: Float
    scope_from_tip: Float
    least_determinant: float
    arc_error_mm: float


class Neighbourhood:
    """One deployment of tubes, from which others nearby are reached straight.

    Args:
        insertions_mm, rotations_rad, tip_angles_rad ((n,) float64): Of that deployment, the innermost first;
            see `TubeShapes`.
    """

    def __init__(
        self, mechanics: TubeMechanics, insertions_mm: Float, rotations_rad: Float, tip_angles_rad: Float
    ) -> None:
        self._mechanics, self._tips, self._turned = mechanics, tip_angles_rad, rotations_rad
        self._radii = np.array([tube.radius_mm for tube in mechanics.tubes])
        self._beta = self._rear_ends(insertions_mm)

    @classmethod
    def of(
        cls,
        tubes: Sequence[Tube],
        insertions_mm: ArrayLike,
        rotations_rad: ArrayLike,
        *,
        needle: Tube | None = None,
    ) -> "Neighbourhood":
        """Return that of a deployment which is reached by the sequence `together`.

        A needle's tip stays where that of the innermost tube is.

        Raises:
            SnapError: If the tubes snap on the way.
            SettingsError: If the insertions are impossible.
        """
        mechanics = TubeMechanics(tubes, needle=needle)
        turned = np.array(rotations_rad, dtype=np.float64)
        inserted = np.array(insertions_mm, dtype=np.float64)
        deployed = deploy(mechanics, together(tubes, turned + BEND_RAD, inserted), step_rad=math.pi)
        return cls(mechanics, inserted, turned, np.array(deployed.final.tip_angles_rad))

    def moved(self, shape: NearbyShape) -> "Neighbourhood":
        """Return the neighbourhood of a shape nearby."""
        return Neighbourhood(self._mechanics, shape.insertions_mm, shape.rotations_rad, shape.tip_angles_rad)

    def at(self, insertions_mm: ArrayLike, rotations_rad: ArrayLike) -> NearbyShape | None:
        """Return the shape of joint values, reached straight from that deployment; None if tubes snap.

        Args:
            insertions_mm, rotations_rad: (n,) float64.

        Raises:
            SettingsError: If numbers are missing or not finite, or the tubes get out of order.
        """
        mechanics = self._mechanics
        out, turned = (np.array(values, dtype=np.float64) for values in (insertions_mm, rotations_rad))
        for name, values in (("insertions", out), ("rotations", turned)):
            if values.shape != (mechanics.count,) or not np.isfinite(values).all():
                raise SettingsError(
                    f"The {name} are {values.tolist()}", expected=f"{mechanics.count} finite numbers"
                )
        mechanics.check_shifts((out - mechanics.lengths_mm)[None])
        end = self._rear_ends(out)
        result, tips = np.zeros(kernel.SHAPE_COLUMNS), self._tips.copy()
        room = ROOM
        while True:
            arcs = np.zeros((room, kernel.ARC_COLUMNS))
            count = kernel.arcs_near(
                mechanics.design, self._radii, self._turned + BEND_RAD, self._beta, turned - self._turned,
                end, mechanics.step_rad, tips, result, arcs,
            )  # fmt: skip
            if count >= 0:
                break
            room, tips = 2 * room, self._tips.copy()
        if count == 0:
            return None
        return NearbyShape(
            insertions_mm=read_only(out),
            rotations_rad=read_only(turned),
            tip_angles_rad=read_only(tips),
            arcs=read_only(arcs[:count].copy()),
            scope_from_tip=read_only(matrices(result[None, kernel.TIP :])[0]),
            least_determinant=float(result[kernel.LEAST]),
            arc_error_mm=float(result[kernel.ERROR]),
        )

    def _rear_ends(self, insertions_mm: Float) -> Float:
        """Return the rear ends `(b,)` of tubes and needle, mm."""
        beta = (insertions_mm - self._mechanics.lengths_mm)[None]
        return np.array(self._mechanics.rear_ends(beta, insertions_mm[:1])[0])

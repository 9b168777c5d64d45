"""What a needle path is to keep small, as the searches take it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from anatomy.errors import SettingsError
from anatomy.grid import Float

Arrays = tuple[Float, NDArray[np.float32]]

MAX_CLEARANCE_MM = 255.0
"""No clearance field holds more, so that 1 / clearance has a least value."""


@dataclass(frozen=True, kw_only=True)
class Objective:
    """A weighted sum of costs of a path.

    Parameters
    ----------
    inverse_clearance : float
        Weight of the integral of 1 / clearance over arc length [Kuntz2015, eq. 1].
    cost_map : float
        Weight of the line integral of the cost map, 1/mm.
    length : float
        Weight of the length, 1/mm.

    Raises
    ------
    SettingsError
        If a weight is negative or not finite, or all are 0.
    """

    inverse_clearance: float = 0.0
    cost_map: float = 0.0
    length: float = 0.0

    def __post_init__(self) -> None:
        weights = np.array([self.inverse_clearance, self.cost_map, self.length])
        if not (np.isfinite(weights).all() and (weights >= 0.0).all() and weights.any()):
            raise SettingsError(
                f"The weights of an objective are {weights.tolist()}",
                expected="weights of 0 or more, one of them more than 0",
            )

    def arrays(self, cost_map: NDArray[np.float32] | None) -> Arrays:
        """Return the weights and the map for the kernels, see `stages.needle.kernels.cost`."""
        if cost_map is None:
            if self.cost_map > 0.0:
                raise SettingsError(
                    "The objective weighs a cost map, but the patient has none",
                    expected="a patient with a cost map, or another objective",
                )
            cost_map = np.zeros((1, 1, 1), dtype=np.float32, order="F")
        finite = cost_map[np.isfinite(cost_map)] if self.cost_map > 0.0 else np.zeros(1)
        least = self.inverse_clearance / MAX_CLEARANCE_MM + self.cost_map * float(finite.min()) + self.length
        return np.array([self.inverse_clearance, self.cost_map, self.length, least]), cost_map


SHORTEST = Objective(length=1.0)

"""What a needle path is to keep small, as the searches take it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from anatomy.errors import SettingsError
from anatomy.grid import read_only
from anatomy.typed import Float, Float32
from stages.needle.kernels import cost as index

ObjectiveArrays = tuple[Float, Float32]

MAX_CLEARANCE_MM = 256.0
"""No clearance field holds more, so that 1 / clearance has a least value."""

NO_MAP = read_only(np.zeros((2, 2, 2), dtype=np.float32, order="F"))
"""Stands for a map that is not looked at, of the type of all maps: the kernels are compiled once."""


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
    voxel_sum : float
        Weight of the sum of the cost map over the set of voxels that the path crosses, each counted once
        [Fu2018, eq. 1].  The searches add it up arc by arc: a voxel that the path leaves and meets again
        on another arc counts again, which `stages.needle.costs.voxel_sum` does not.

    Raises
    ------
    SettingsError
        If a weight is negative or not finite, or all are 0.
    """

    inverse_clearance: float = 0.0
    cost_map: float = 0.0
    length: float = 0.0
    voxel_sum: float = 0.0

    def __post_init__(self) -> None:
        weights = np.array([self.inverse_clearance, self.cost_map, self.length, self.voxel_sum])
        if not (np.isfinite(weights).all() and (weights >= 0.0).all() and weights.any()):
            raise SettingsError(
                f"The weights of an objective are {weights.tolist()}",
                expected="weights of 0 or more, one of them more than 0",
            )

    @property
    def weighs_map(self) -> bool:
        """Whether it needs a cost map."""
        return self.cost_map > 0.0 or self.voxel_sum > 0.0

    @property
    def is_length(self) -> bool:
        """Whether it weighs nothing but length."""
        return self.inverse_clearance == 0.0 and not self.weighs_map

    def arrays(self, cost_map: Float32 | None) -> ObjectiveArrays:
        """Return the weights and the map for the kernels, see `stages.needle.kernels.cost`.

        The least cost of a mm is a proved lower bound.  The voxel sum adds nothing to it: however small the
        cost, an arc can be so short that it enters no other voxel.

        Parameters
        ----------
        cost_map : (ni, nj, nk) float32 or None
            Not negative; infinite is an obstacle.

        Raises
        ------
        SettingsError
            If the objective weighs a map, and there is none, or one with negative costs, NaN, or no finite
            cost.
        """
        least_of_map = 0.0
        if not self.weighs_map:
            cost_map = NO_MAP
        elif cost_map is None:
            raise SettingsError(
                "The objective weighs a cost map, but the patient has none",
                expected="a patient with a cost map, or another objective",
            )
        else:
            cost_map = read_only(np.asfortranarray(cost_map, dtype=np.float32))
            least_of_map = float(cost_map.min())
            if not 0.0 <= least_of_map < np.inf:
                raise SettingsError(
                    f"The least cost of the cost map is {least_of_map:g}",
                    expected="costs of 0 or more, some of them finite, and no NaN",
                )
        weights = np.zeros(index.N_WEIGHTS)
        weights[index.INVERSE_CLEARANCE] = self.inverse_clearance
        weights[index.MAP_INTEGRAL] = self.cost_map
        weights[index.LENGTH] = self.length
        weights[index.VOXEL_SUM] = self.voxel_sum
        weights[index.LEAST_RATE] = (
            self.inverse_clearance / MAX_CLEARANCE_MM + self.cost_map * least_of_map + self.length
        )
        return weights, cost_map


SHORTEST = Objective(length=1.0)
"""Needle paths as a person steers them: roll, then insert along an arc."""

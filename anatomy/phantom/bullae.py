"""Bullae of an emphysematous phantom: balls of air below the pleura, which tissue and vessels leave free."""

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from anatomy.lobes import LEFT_UPPER, RIGHT_UPPER
from anatomy.phantom.territory import Territory

FEWEST, MOST = 2, 8
"""How many bullae the mildest and the severest emphysema has."""
LEAST_RADIUS_MM, GREATEST_RADIUS_MM = 5.0, 16.0
"""Air spaces count as bullae from 10 mm across."""
UPPER_LOBES = (RIGHT_UPPER, LEFT_UPPER)
"""Where smokers have most of them."""
UPPER_SHARE = 0.75
GAP_MM = 4.0
"""Between a bulla and the next one, and from its surface to the pleura at most."""


@frozen_record
class Bulla:
    """A ball of air in the lung; its centre is LPS mm."""

    centre_lps: Float
    radius_mm: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_lps", read_only(np.asarray(self.centre_lps, dtype=np.float64)))


def place_bullae(
    territory: Territory, emphysema: float, scale: float, rng: np.random.Generator
) -> tuple[Bulla, ...]:
    """Choose bullae below the pleura, most of them in the upper lobes; none without emphysema (0 to 1)."""
    if emphysema == 0.0:
        return ()
    wanted = round(FEWEST + emphysema * (MOST - FEWEST))
    found: list[Bulla] = []
    for index in rng.permutation(len(territory.points_lps)):
        centre = territory.points_lps[index]
        upper = int(territory.lobe_of_point[index]) in UPPER_LOBES
        radius = scale * rng.uniform(LEAST_RADIUS_MM, GREATEST_RADIUS_MM)
        depth = float(territory.pleura_depth_mm[territory.index(centre)])
        fits = (
            rng.random() < (UPPER_SHARE if upper else 1.0 - UPPER_SHARE)
            and radius < depth < radius + scale * GAP_MM
            and all(
                float(np.linalg.norm(b.centre_lps - centre)) > b.radius_mm + radius + scale * GAP_MM
                for b in found
            )
        )
        if fits:
            found.append(Bulla(centre_lps=centre, radius_mm=float(radius)))
        if len(found) == wanted:
            break
    return tuple(found)

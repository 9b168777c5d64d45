"""Where nodules grow, in the outer lung, away from fissures and from airways of some size; and bullae.

Bullae are balls of air below the pleura of an emphysematous phantom, which tissue and vessels leave free.
"""

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import read_only
from anatomy.lobes import LEFT_UPPER, RIGHT_UPPER
from anatomy.phantom.territory import Territory

FEWEST, MOST = 2, 8
"""How many bullae the mildest and the severest emphysema has."""
LEAST_BULLA_MM, GREATEST_BULLA_MM = 5.0, 16.0
"""Air spaces count as bullae from 10 mm across."""
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
        # Smokers have most of their nodules in the upper lobes.
        upper = int(territory.lobe_of_point[index]) in (RIGHT_UPPER, LEFT_UPPER)
        radius = scale * rng.uniform(LEAST_BULLA_MM, GREATEST_BULLA_MM)
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


LEAST_PLEURA_MM, GREATEST_PLEURA_MM = 5.0, 30.0
"""Nodules of the outer third of the lung, which a bronchoscope cannot reach by itself."""
LEAST_RADIUS_MM, GREATEST_RADIUS_MM = 3.0, 8.0
"""From 6 mm across, where a nodule is followed up, to 16 mm."""


@frozen_record
class Nodule:
    """A ball of tissue in the lung; its centre is LPS mm, its lobe 1 to 5."""

    centre_lps: Float
    radius_mm: float
    lobe: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre_lps", read_only(np.asarray(self.centre_lps, dtype=np.float64)))


def place_nodules(
    territory: Territory,
    tube_points: Float,
    tube_radius_mm: Float,
    scale: float,
    rng: np.random.Generator,
    bullae: tuple[Bulla, ...] = (),
) -> tuple[Nodule, ...]:
    """Choose 3 to 6 nodules among the points of a territory.

    They keep clear of the tubes with centres `(M, 3)` LPS mm and radii `(M,)`, and of bullae.

    The surface of a nodule is at least 5 mm and its centre at most 30 mm (times `scale`) from the pleura.

    Raises:
        AnatomyError: If three do not fit.
    """
    from scipy.spatial import cKDTree

    wanted = int(rng.integers(3, 7))
    points = territory.points_lps
    # The tube with the nearest surface is among so many of the nearest centres, as radii differ little.
    distance, nearest = cKDTree(tube_points).query(points, k=8)
    clearance_mm = (distance - tube_radius_mm[nearest]).min(axis=1)
    found: list[Nodule] = []
    map_error = territory.spacing_mm
    for index in rng.permutation(len(points)):
        centre, lobe = points[index], int(territory.lobe_of_point[index])
        radius = rng.uniform(LEAST_RADIUS_MM, scale * GREATEST_RADIUS_MM)
        voxel = territory.index(centre)
        pleura = territory.pleura_depth_mm[voxel]
        fits = (
            radius + scale * LEAST_PLEURA_MM + map_error < pleura < scale * GREATEST_PLEURA_MM - map_error
            and territory.holds(centre, lobe, radius + 2 * map_error)
            # A needle passes between a nodule and the next tube.
            and clearance_mm[index] > radius + scale * 2.0
            # Nodules are far enough from each other to be targets of their own.
            and all(np.linalg.norm(n.centre_lps - centre) > scale * 25.0 for n in found)
            and all(
                np.linalg.norm(b.centre_lps - centre) > b.radius_mm + radius + scale * LEAST_PLEURA_MM
                for b in bullae
            )
        )
        if fits:
            found.append(Nodule(centre_lps=centre, radius_mm=float(radius), lobe=lobe))
        if len(found) == wanted:
            return tuple(found)
    if len(found) >= 3:
        return tuple(found)
    raise AnatomyError(
        "The synthetic lungs are too narrow for three nodules",
        expected="free tissue near the pleura",
        remedy="Use another seed",
    )

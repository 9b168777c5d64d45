"""Where trees and nodules grow: a map of the lobes, its depths, and points spread evenly in it; bullae."""

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Float32, UInt8
from anatomy.grid import read_only
from anatomy.lobes import LEFT_UPPER, RIGHT_UPPER
from anatomy.phantom.chest import LOBES, Chest

MAP_SPACING_MM = 3.0
"""Fine enough for the borders of lobes, whose exact place the drawing decides."""


@frozen_record
class Territory:
    """A coarse map of the lobes.

    Args:
        origin ((3,) float64): LPS mm of the centre of voxel 0, 0, 0.
        lobes ((ni, nj, nk) uint8): 1 to 5, 0 outside the lungs.
        lobe_depth_mm, pleura_depth_mm ((ni, nj, nk) float32): Distance to the border of the lobe and to the
            nearest position outside the lungs.
        points_lps ((N, 3) float64): Points spread evenly, each standing for the same volume of tissue.
        lobe_of_point: (N,) uint8.
    """

    origin: Float
    spacing_mm: float
    lobes: UInt8
    lobe_depth_mm: Float32
    pleura_depth_mm: Float32
    points_lps: Float
    lobe_of_point: UInt8

    def index(self, point: Float) -> tuple[int, int, int]:
        """Return the voxel of a point `(3,)`, clamped to the map."""
        i, j, k = (
            min(max(round((point[a] - self.origin[a]) / self.spacing_mm), 0), self.lobes.shape[a] - 1)
            for a in range(3)
        )
        return i, j, k

    def holds(self, point: Float, lobe: int, depth_mm: float) -> bool:
        """Tell whether a point `(3,)` lies in `lobe`, at least `depth_mm` from its border."""
        index = self.index(point)
        return bool(self.lobes[index] == lobe and self.lobe_depth_mm[index] >= depth_mm)

    def depth_mm(self, points: Float) -> Float:
        """Return how deep below the pleura points `(N, 3)` lie, mm, by linear interpolation."""
        from scipy.ndimage import map_coordinates

        at = ((points - self.origin) / self.spacing_mm).T
        # The map has the distance to the centre of a voxel outside, half a voxel beyond the pleura.
        found = map_coordinates(self.pleura_depth_mm, at, order=1, mode="nearest")
        return np.asarray(found, dtype=np.float64) - 0.5 * self.spacing_mm


def make_territory(chest: Chest, rng: np.random.Generator) -> Territory:
    """Map the lobes of a chest at `MAP_SPACING_MM` times its scale and spread points in them.

    Raises AnatomyError if a lobe is empty.
    """
    import edt

    spacing = MAP_SPACING_MM * chest.scale
    low, high = chest.bounds()
    x, y, z = (np.arange(low[a], high[a], spacing) for a in range(3))
    x, y, z = x[:, None, None], y[None, :, None], z[None, None, :]
    lobes = np.zeros((x.size, y.size, z.size), dtype=np.uint8)
    for side in chest.sides:
        inside = (chest.lung(side, x, y, z) < 0) & (side.sign * x > 0)
        lobes[inside] = np.broadcast_to(chest.lobe(side, x, y, z), lobes.shape)[inside]
    counts = np.bincount(lobes.ravel(), minlength=len(LOBES) + 1)
    if (np.delete(counts, [0, chest.fills[0]]) == 0).any():
        raise AnatomyError(
            "A lobe of the synthetic lungs is empty",
            expected="every lobe that was not resected",
            remedy="Use another seed",
        )
    anisotropy = (spacing,) * 3
    # Side of the cube that a point stands for: about as large as what a terminal branch of the tree supplies.
    step = 6.6 / MAP_SPACING_MM
    axes = [np.arange(0, n - 1, step) for n in lobes.shape]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    lattice += rng.uniform(0, step, lattice.shape)
    nearest = np.minimum(np.rint(lattice).astype(np.int64), np.array(lobes.shape) - 1)
    lobe_there = lobes[tuple(nearest.T)]
    return Territory(
        origin=low,
        spacing_mm=spacing,
        lobes=lobes,
        lobe_depth_mm=edt.edt(lobes, anisotropy=anisotropy),
        pleura_depth_mm=edt.edt(lobes > 0, anisotropy=anisotropy),
        points_lps=low + spacing * lattice[lobe_there > 0],
        lobe_of_point=lobe_there[lobe_there > 0],
    )


# Nodules grow in the outer lung, away from fissures and from airways of some size.  Bullae are balls of air
# below the pleura of an emphysematous phantom, which tissue and vessels leave free.
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
class Nodule(Bulla):
    """A ball of tissue in its place; its lobe is 1 to 5."""

    lobe: int


def place_nodules(
    territory: Territory,
    tube_points: Float,
    tube_radius_mm: Float,
    scale: float,
    rng: np.random.Generator,
    bullae: tuple[Bulla, ...] = (),
) -> tuple[Nodule, ...]:
    """Choose 3 to 6 nodules among the points of a territory.

    They keep clear of the tubes with centres `(M, 3)` LPS mm and radii `(M,)`, and of bullae.  The surface of
    a nodule is at least 5 mm and its centre at most 30 mm (times `scale`) from the pleura.  Raises
    AnatomyError if three do not fit.
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
        pleura = territory.pleura_depth_mm[territory.index(centre)]
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

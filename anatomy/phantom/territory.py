"""Where trees grow: a coarse map of the lobes, its depths, and points spread evenly in it."""

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Float32, UInt8
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


def _spread_points(
    lobes: UInt8, origin: Float, spacing_mm: float, rng: np.random.Generator
) -> tuple[Float, UInt8]:
    """Spread points `(N, 3)` LPS mm evenly over the lobes; return them and their lobes `(N,)`."""
    # Side of the cube that a point stands for: about as large as what a terminal branch of the tree supplies.
    step = 6.6 / MAP_SPACING_MM
    axes = [np.arange(0, n - 1, step) for n in lobes.shape]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    lattice += rng.uniform(0, step, lattice.shape)
    nearest = np.minimum(np.rint(lattice).astype(np.int64), np.array(lobes.shape) - 1)
    lobe = lobes[tuple(nearest.T)]
    return origin + spacing_mm * lattice[lobe > 0], lobe[lobe > 0]


def make_territory(chest: Chest, rng: np.random.Generator) -> Territory:
    """Map the lobes of a chest at `MAP_SPACING_MM` times its scale and spread points in them.

    Raises:
        AnatomyError: If a lobe is empty.
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
    points, lobe_of_point = _spread_points(lobes, low, spacing, rng)
    return Territory(
        origin=low,
        spacing_mm=spacing,
        lobes=lobes,
        lobe_depth_mm=edt.edt(lobes, anisotropy=anisotropy),
        pleura_depth_mm=edt.edt(lobes > 0, anisotropy=anisotropy),
        points_lps=points,
        lobe_of_point=lobe_of_point,
    )

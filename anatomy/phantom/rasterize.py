"""From shapes to voxels: body, lungs, lobes, fissures, trees and nodules drawn into one label image."""

from dataclasses import dataclass

import numpy as np

from anatomy.base.typed import Array, Float, Int16, Mask, UInt8
from anatomy.grid import Grid
from anatomy.phantom.chest import CAGE_CENTRE_Z, Chest, Side
from anatomy.phantom.kernels import NODULE_OWNER, paint_tree
from anatomy.phantom.plan import PlannedTree

LABELS = {
    "background": 0, "soft_tissue": 1, "lung": 2, "lumen": 3, "wall": 4, "artery": 5, "vein": 6, "fissure": 7,
    "nodule": 8, "mediastinum": 9, "heart": 10, "bone": 11, "bulla": 12,
}  # fmt: skip
SLAB = 4
"""Planes that are drawn at once: the arrays of a slab fit into the processor's cache."""
HILUM_LPS = {-1.0: (-20.0, 5.0, -32.0), 1.0: (36.0, 8.0, -32.0)}
"""Where bronchi and vessels enter the lungs of an adult, by the sign of x."""
RIB_DISTANCE_MM, RIB_HEIGHT_MM, RIB_SLOPE = 25.0, 9.0, 0.45
"""Distance, height and slope of ribs, about those of an adult."""


@dataclass(kw_only=True, eq=False)
class Canvas:
    """The images while they are drawn, all `(ni, nj, nk)` and Fortran-contiguous.

    `labels` uint8 by `LABELS`, `lobes` uint8, `owner` int16 of `paint_tree`, and the covers uint8: share
    (0 to 255) of a voxel within lungs, lumen, airways, and vessels or nodules.
    """

    grid: Grid
    labels: UInt8
    lobes: UInt8
    owner: Int16
    lung_cover: UInt8
    lumen_cover: UInt8
    airway_cover: UInt8
    solid_cover: UInt8

    @property
    def spacing_mm(self) -> float:
        """Edge of the cubic voxels."""
        return float(self.grid.spacing_mm[0])


def phantom_grid(chest: Chest, spacing_mm: float) -> Grid:
    """Return a grid of cubic voxels over the chest; the midline falls between two voxels."""
    low, high = chest.bounds()
    shape = np.round((high - low) / spacing_mm).astype(np.int64)
    shape[0] += shape[0] % 2
    origin = low.copy()
    origin[0] = -0.5 * (shape[0] - 1) * spacing_mm
    return Grid.from_spacing(shape, (spacing_mm,) * 3, origin)


def draw_body(chest: Chest, grid: Grid, open_fissures: float = 0.0, *, precise: bool = False) -> Canvas:
    """Draw everything but trees, nodules and bullae; a share of each lung's fissures is left out.

    In single precision, which is faster, a few voxels at the surfaces depend on the kind of processor.
    """
    shape = grid.shape
    names = ("labels", "lobes", "lung_cover", "lumen_cover", "airway_cover", "solid_cover")
    images = {name: np.zeros(shape, dtype=np.uint8, order="F") for name in names}
    canvas = Canvas(grid=grid, owner=np.zeros(shape, dtype=np.int16, order="F"), **images)
    half = shape[0] // 2
    first = grid.lps_from_ijk[:3, 3]
    real = np.float64 if precise else np.float32
    axes = [(first[a] + grid.spacing_mm[a] * np.arange(shape[a])).astype(real) for a in range(3)]
    for side, columns in zip(chest.sides, (slice(0, half), slice(half, None)), strict=True):
        for k in range(0, shape[2], SLAB):
            block = (columns, slice(None), slice(k, k + SLAB))
            # Arrays run [k, j, i] here, so that the writes below go along memory.
            x, y, z = axes[0][None, None, columns], axes[1][None, :, None], axes[2][k : k + SLAB, None, None]
            level = chest.lung(side, x, y, z)
            inside = level < 0
            canvas.labels[block] = np.where(inside, np.uint8(LABELS["lung"]), _around(chest, side, x, y, z)).T
            canvas.lobes[block] = np.where(inside, chest.lobe(side, x, y, z), np.uint8(0)).T
            share = np.clip(0.5 - level / grid.spacing_mm[0], 0, 1)
            canvas.lung_cover[block] = (255 * share).astype(np.uint8).T
    _draw_fissures(canvas, chest.scale, open_fissures)
    return canvas


def _around(chest: Chest, side: Side, x: Array, y: Array, z: Array) -> UInt8:
    s = chest.scale
    heart = chest.heart(x, y, z) < 0
    x, y, z = x / s, y / s, z / s
    shoulder = 1 - 0.18 / (1 + np.exp((70 - z) / 10))
    body = (np.abs(x) / (152 * shoulder)) ** 2.6 + (np.abs(y + 1) / (107 * shoulder)) ** 2.6 < 1
    cage = side.cage(x, y, z)
    lateral = side.sign * x
    ribs = (cage > 4) & (cage < 12) & (lateral > 26) & (z > CAGE_CENTRE_Z - 75)
    ribs &= np.mod(z - RIB_SLOPE * y, RIB_DISTANCE_MM) < RIB_HEIGHT_MM
    spine = (x / 19) ** 2 + ((y - 66) / 16) ** 2 < 1
    spinous = (np.abs(x) < 4) & (y > 84) & (y < 100) & (np.mod(z, 26) < 15)
    sternum = (np.abs(x) < 15) & (np.abs(y + 95) < 5) & (z < -10) & (z > -140)
    above = (z > side.diaphragm(x, y)) & (cage < 3) & (lateral < side.mediastinum(y, z) + 12)
    labels = np.where(body, np.uint8(LABELS["soft_tissue"]), np.uint8(LABELS["background"]))
    labels = np.where(above & body, np.uint8(LABELS["mediastinum"]), labels)
    labels = np.where(heart & body, np.uint8(LABELS["heart"]), labels)
    bone = (ribs | spine | spinous | sternum) & body & ~heart
    return np.where(bone, np.uint8(LABELS["bone"]), labels)


def _draw_fissures(canvas: Canvas, scale: float, open_share: float) -> None:
    """Label one layer of voxels between lobes, open at the hilum by a share, as fissures mostly are."""
    lobes = canvas.lobes
    found = np.zeros(lobes.shape, dtype=bool, order="F")
    for axis in range(3):
        here: list[slice] = [slice(None)] * 3
        there = here.copy()
        here[axis], there[axis] = slice(0, -1), slice(1, None)
        a, b = lobes[tuple(here)], lobes[tuple(there)]
        found[tuple(here)] |= (a != b) & (a > 0) & (b > 0)
    ijk = np.argwhere(found)
    lps = canvas.grid.lps(ijk)
    hila = np.where(lps[:, :1] > 0, np.array(HILUM_LPS[1.0]), np.array(HILUM_LPS[-1.0])) * scale
    distance = np.linalg.norm(lps - hila, axis=1)
    # Fissures end at the hilum, where the lobes hang together.
    closed = distance > 26.0 * scale
    if open_share:
        for side in (lps[:, 0] > 0, lps[:, 0] <= 0):
            if (closed & side).any():
                closed &= ~side | (distance > np.quantile(distance[closed & side], open_share))
    canvas.labels[tuple(ijk[closed].T)] = LABELS["fissure"]


def draw_tree(canvas: Canvas, tree: PlannedTree, base: int, kind: str) -> Mask:
    """Draw an "airway", "artery" or "vein" tree after `base` branches; return which `(B,)` were drawn."""
    sprouts = tree.sprouts
    allowed = np.zeros(len(LABELS), dtype=np.bool_)
    allowed[[LABELS[name] for name in ("lung", "fissure", "lumen", "wall", "artery", "vein")]] = True
    keep = np.zeros(len(sprouts.parent), dtype=np.bool_)
    # Children are thinner than their parents, so parents come first.
    order = np.argsort(-np.array(sprouts.diameter_mm), kind="stable").astype(np.int64)
    start = np.concatenate([[0], np.cumsum(sprouts.counts)])
    parents = np.array(sprouts.parent, dtype=np.int64)
    spacing, origin = canvas.spacing_mm, canvas.grid.lps_from_ijk[:3, 3].copy()
    if kind == "airway":
        cover, gap, slack, codes = canvas.airway_cover, spacing, 0.0, (LABELS["lumen"], LABELS["wall"])
    else:
        cover, gap, slack, codes = canvas.solid_cover, -1.0, 0.5 * spacing, (LABELS[kind], LABELS[kind])
    paint_tree(
        canvas.labels, canvas.owner, canvas.lumen_cover, cover, origin, spacing, np.vstack(sprouts.points),
        tree.inner_mm, tree.outer_mm, start, parents, order, tree.freedom, base, gap, slack, *codes, allowed,
        keep,
    )  # fmt: skip
    return keep


def draw_bulla(canvas: Canvas, centre_lps: Float, radius_mm: float) -> None:
    """Draw a bulla into the lung alone; later trees must leave it free."""
    block, distance = _around_ball(canvas, centre_lps, radius_mm)
    labels = canvas.labels[block]
    tissue = (labels == LABELS["lung"]) | (labels == LABELS["fissure"])
    labels[(distance <= radius_mm) & tissue] = LABELS["bulla"]


def draw_ball(canvas: Canvas, centre_lps: Float, radius_mm: float) -> None:
    """Draw a nodule, which later trees must leave free."""
    block, distance = _around_ball(canvas, centre_lps, radius_mm)
    share = (255 * np.clip((radius_mm - distance) / canvas.spacing_mm + 0.5, 0, 1)).astype(np.uint8)
    canvas.solid_cover[block] = np.maximum(canvas.solid_cover[block], share)
    canvas.labels[block][distance <= radius_mm] = LABELS["nodule"]
    canvas.owner[block][distance <= radius_mm] = NODULE_OWNER


def _around_ball(canvas: Canvas, centre_lps: Float, radius_mm: float) -> tuple[tuple[slice, ...], Float]:
    """Return the voxels around a ball, and the distances of their centres from its centre, mm."""
    block = canvas.grid.window(centre_lps, radius_mm + 1.5 * canvas.spacing_mm)
    ranges = [np.arange(axis.start, axis.stop) for axis in block]
    ijk = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1)
    return block, np.linalg.norm(canvas.grid.lps(ijk) - centre_lps, axis=-1)

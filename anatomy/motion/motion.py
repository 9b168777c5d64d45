"""The breathing of one patient: where each place of the masks is in each phase."""

import hashlib
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import Grid, freeze_arrays, read_only
from anatomy.kernels import motion as kernel

RIGHT, LEFT = 0, 1
"""Each lung slides along chest wall and mediastinum by itself, and has a displacement of its own."""


@frozen_record
class Motion:
    """Motion between end-exhale (phase 0) and end-inhale (phase 1), linear in the phase, in LPS mm.

    A place X of the masks is at `X + amplitude (phase - masks_phase) d(X)`, up to the hysteresis; d is
    trilinear between nodes.

    Args:
        grid: The nodes; axes along LPS, one spacing.
        nodes ((2, ni, nj, nk, 3) float64): d as the right and as the left lung has it, mm, at places of the
            masks; continued beyond that lung.
        middle_x_mm: x of the carina: what lies at larger x belongs to the left lung.
        masks_phase: The phase that the masks show, 0 to 1.
        amplitude: Share of the motion of the source.
        source: Where the motion came from, in words.
        warning_only: Whether it is a model of other people's lungs, which may warn but not promise.
        figures: What was measured of it, such as residuals; units are in the names.
        hysteresis: How far two places may be, against each other, from where the motion puts them, as a share
            of their distance: inhaling and exhaling take different ways.
    """

    grid: Grid
    nodes: Float
    middle_x_mm: float
    masks_phase: float
    amplitude: float
    source: str
    warning_only: bool
    figures: Mapping[str, float]
    warnings: tuple[str, ...] = ()
    hysteresis: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "nodes", np.ascontiguousarray(self.nodes, dtype=np.float64))
        freeze_arrays(self, "nodes")
        object.__setattr__(self, "figures", MappingProxyType(dict(self.figures)))

    @cached_property
    def frame(self) -> Float:
        """First node and spacing `(4,)`, for kernels."""
        return read_only(np.append(self.grid.lps_from_ijk[:3, 3], self.grid.spacing_mm[0]))

    @cached_property
    def cells(self) -> Float:
        """Bounds of the gradient on every cell `(2, ni - 1, nj - 1, nk - 1, 3)`; see `stretch`."""
        return read_only(np.stack([cell_bounds(nodes, float(self.frame[3])) for nodes in self.nodes]))

    @cached_property
    def key(self) -> str:
        """SHA-256 of all that places depend on."""
        digest = hashlib.sha256(np.ascontiguousarray(self.nodes).tobytes())
        numbers = [*self.frame, *self.nodes.shape, self.middle_x_mm, self.masks_phase, self.amplitude]
        numbers += [self.hysteresis] if self.hysteresis else []
        digest.update(np.array(numbers, dtype=np.float64).tobytes())
        return digest.hexdigest()

    def side_of(self, point_lps: ArrayLike) -> int:
        """Return the lung, RIGHT or LEFT, to which a point `(3,)` LPS mm belongs."""
        return int(np.asarray(point_lps)[0] > self.middle_x_mm)

    def share(self, phase: float) -> float:
        """Return which share of d places of the masks are moved by in a phase, negative before the masks'.

        Raises SettingsError if the phase is not from 0 to 1.
        """
        return self.amplitude * (require_phase(phase) - self.masks_phase)

    def displacements_mm(self, points_lps: ArrayLike, side: int) -> Float:
        """Return d `(N, 3)` of a lung at places of the masks `(N, 3)` LPS mm."""
        points, out = _plain(points_lps)
        kernel.displacements(self.nodes[side], self.frame, points, out)
        return out

    def moved(self, points_lps: ArrayLike, phase: float, side: int) -> Float:
        """Return where places of the masks `(N, 3)` LPS mm are in a phase."""
        points = _plain(points_lps)[0]
        return np.asarray(points + self.share(phase) * self.displacements_mm(points, side))

    def pulled_back(self, points_lps: ArrayLike, phase: float, side: int) -> Float:
        """Return the places of the masks that are at points `(N, 3)` LPS mm in a phase."""
        points, out = _plain(points_lps)
        kernel.points_pulled_back(self.nodes[side], self.frame, self.share(phase), points, out)
        return out

    def least_stretch(self, side: int) -> Float:
        """Return by what factor each cell shortens lengths at most, over all phases: `(ni - 1, ...)`."""
        low, high = self.cells[side, ..., 0], self.cells[side, ..., 1]
        begin, end = self.share(0.0), self.share(1.0)
        return np.asarray(np.minimum(1.0, np.minimum(1.0 + end * low, 1.0 + begin * high)))


def require_phase(phase: float) -> float:
    """Return a phase, or raise SettingsError if it is not from 0, end-exhale, to 1, end-inhale."""
    if not 0.0 <= phase <= 1.0:
        raise SettingsError(
            f"The phase is {phase}", expected="0 (end-exhale) to 1 (end-inhale)", remedy="Write 0.3 for 30 %"
        )
    return float(phase)


def _plain(points_lps: ArrayLike) -> tuple[Float, Float]:
    points = np.array(points_lps, dtype=np.float64, order="C").reshape(-1, 3)
    return points, np.zeros_like(points)


def cell_bounds(nodes: Float, spacing_mm: float) -> Float:
    """Return bounds of the gradient of a trilinear displacement on its cells.

    In a cell the derivative along an axis is a mean of those along its four edges of that axis; so the
    gradient is nowhere farther from the mean one than the edges are.  With G the gradient and S its
    symmetric part, `|v + share G v| >= v'(v + share G v) >= 1 + share v'S v` for unit vectors v: a segment
    that stays in cells is stretched by no less than `1 + share low` (share >= 0) or `1 + share high` (share
    < 0).

    Args:
        nodes ((ni, nj, nk, 3) float64): Displacements at nodes, mm.
        spacing_mm: Distance of nodes along all axes.

    Returns:
        (ni - 1, nj - 1, nk - 1, 3) float64: For each cell: low, a lower bound of the eigenvalues of S; high,
            an upper one; an upper bound of the norm of G.
    """
    ni, nj, nk, _ = nodes.shape
    out = np.zeros((ni - 1, nj - 1, nk - 1, 3))
    kernel.fill_cell_bounds(np.ascontiguousarray(nodes), float(spacing_mm), out)
    return out

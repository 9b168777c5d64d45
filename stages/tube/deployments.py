"""What the tubes can do from a scope tip: shape, tip pose, exit through the wall, why not."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses as frames
from anatomy.errors import SettingsError
from anatomy.grid import read_only
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.structures import obstacle_bits
from anatomy.typed import Bool, Float, Int, UInt16
from stages.tube.device import ConcentricTubes
from stages.tube.kernels import deployment as kernels

Scene = tuple[UInt16, UInt16, Float, int, UInt16, Float, Bool]

REASONS: dict[int, str] = {
    kernels.NO_EXIT: "the tube does not leave the airway",
    kernels.NEAR_VESSEL: "the tube comes too near a vessel",
    kernels.NEAR_PLEURA: "the tube comes too near the pleura or leaves the lung",
    kernels.NEAR_FISSURE: "the tube comes too near a fissure",
    kernels.NEAR_OTHER_BRANCH: "the tube comes too near another airway",
    kernels.REENTERS_LUMEN: "the tube enters an airway again",
    kernels.FLAT_EXIT: "the tube meets the airway wall at too flat an angle",
    kernels.SWEEPS: "the tube would sweep tissue sideways",
    kernels.TOO_LONG: "the tube would extend too far",
    kernels.PROTRUDES: "the inner tube is too short to protrude so far",
    kernels.LEAVES_MEDIASTINAL: "the tube would leave the trachea or a main bronchus, in the mediastinum",
}
"""Why a deployment is refused."""


DEFAULT_ROTATIONS = 24
DEFAULT_STOP_MM = 2.0
THREADS = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class Deployments:
    """Accepted deployments, E of them, and counts of the refused.

    Parameters
    ----------
    site : (E,) int64
        Index of the scope pose.
    rotation_rad, outer_mm, inner_mm : (E,) float64
        Rotation of both tubes; insertions beyond the scope tip.
    branch : (E,) int64
        Pierced branch.
    exit_mm, wall_angle_rad : (E,) float64
        Arc length at which the axis leaves the lumen, and its angle to the wall there.
    positions, tangents : (E, 3) float64
        Tip of the inner tube, LPS mm.
    candidates : int
        Deployments looked at.
    refused : dict of str to int
        Counts by reason.
    """

    site: Int
    rotation_rad: Float
    outer_mm: Float
    inner_mm: Float
    branch: Int
    exit_mm: Float
    wall_angle_rad: Float
    positions: Float
    tangents: Float
    candidates: int
    refused: dict[str, int]

    @property
    def count(self) -> int:
        """Number of accepted deployments, E."""
        return len(self.site)


@dataclass(frozen=True, kw_only=True, eq=False)
class Deployment:
    """One accepted deployment in full.

    Parameters
    ----------
    rotation_rad, outer_mm, inner_mm : float
    lps_from_tip : (4, 4) float64
        +z forward, +x towards the bend.
    branch : int
    exit_mm, wall_angle_rad : float
    lateral_sweep_mm : float
    """

    rotation_rad: float
    outer_mm: float
    inner_mm: float
    lps_from_tip: Float
    branch: int
    exit_mm: float
    wall_angle_rad: float
    lateral_sweep_mm: float

    @property
    def length_in_tissue_mm(self) -> float:
        """Length of tube beyond the lumen that it leaves."""
        return self.inner_mm - self.exit_mm


def scene_of(lung: Lung, *, with_fissures: bool) -> Scene:
    """Gather the arrays that the tube kernels look at."""
    field = lung.obstacle_field(with_fissures=with_fissures)
    bits = obstacle_bits(with_fissures)
    depth = lung.lumen_depth
    return (
        field.corners,
        lung.labels,
        field.geometry,
        bits,
        depth.corners,
        depth.geometry,
        lung.tree.mediastinal,
    )


def tube_constants(tubes: ConcentricTubes, margins: Margins) -> Float:
    """Return the `(10,)` array of `stages.tube.kernels.deployment`, lengths in mm, angles in rad."""
    constants = np.zeros(kernels.N_TUBES)
    inner, outer = tubes.inner, tubes.outer
    constants[kernels.OVERLAP_CURVATURE] = tubes.overlap_curvature_per_mm
    constants[kernels.INNER_CURVATURE] = inner.precurvature_per_mm
    constants[kernels.CURVED_LENGTH] = inner.curved_length_mm
    constants[kernels.OUTER_RADIUS] = outer.radius_mm
    constants[kernels.INNER_RADIUS] = inner.radius_mm
    constants[kernels.MARGIN] = margins.total_mm
    constants[kernels.MIN_WALL_ANGLE] = math.radians(tubes.min_wall_angle_deg)
    constants[kernels.MAX_SWEEP] = tubes.max_lateral_sweep_mm
    constants[kernels.MAX_EXTENSION] = tubes.max_extension_mm
    constants[kernels.MAX_PROTRUSION] = tubes.max_inner_protrusion_mm
    return constants


def tracking_length_mm(tubes: ConcentricTubes) -> float:
    """Return the greatest insertion in which the tubes follow their own track exactly.

    Curved tubes do so as long as the straight part of the inner one stays in the scope.
    """
    if tubes.inner.precurvature_per_mm == 0.0:
        return tubes.max_extension_mm
    return min(tubes.inner.curved_length_mm, tubes.max_extension_mm)


def insertion_stops(tubes: ConcentricTubes, spacing_mm: float = DEFAULT_STOP_MM) -> Float:
    """Return insertions from 0 to `tracking_length_mm`, about `spacing_mm` apart."""
    longest = tracking_length_mm(tubes)
    return np.linspace(0.0, longest, max(1, round(longest / spacing_mm)) + 1)


def enumerate_deployments(
    lung: Lung,
    tubes: ConcentricTubes,
    margins: Margins,
    scope_tips: ArrayLike,
    *,
    with_fissures: bool,
    rotations: int = DEFAULT_ROTATIONS,
    stop_spacing_mm: float = DEFAULT_STOP_MM,
    progress: Callable[[float], None] | None = None,
) -> Deployments:
    """Enumerate what the tubes can do from many scope tips.

    Only deployments without sideways sweep are enumerated: those whose tip stays within
    `tracking_length_mm` of the scope tip.

    Parameters
    ----------
    scope_tips : (S, 6) float64
        Point and unit tangent of each scope tip, LPS mm.
    with_fissures : bool
        Whether fissures are obstacles.
    rotations : int
        Evenly spaced rotations of the tubes.  Between two of them a further one is looked at where not the
        same insertions are accepted at both: there the tube or its exit is near a limit.
    stop_spacing_mm : float
        Spacing of the insertions of both tubes.
    progress : callable, optional
        Told the share of sites done.
    """
    tips = np.array(scope_tips, dtype=np.float64, order="C").reshape(-1, 6)
    coarse: Float = np.arange(rotations, dtype=np.float64) * (2 * math.pi / rotations)
    angles = np.concatenate([coarse, coarse + math.pi / rotations])
    stops = insertion_stops(tubes, stop_spacing_mm)
    scene = scene_of(lung, with_fissures=with_fissures)
    constants = tube_constants(tubes, margins)
    most = len(stops) * (len(stops) + 1) // 2
    done = 0

    def one_site(site: int) -> tuple[Float, Int, int]:
        nonlocal done
        frame = frames.pose(tips[site, :3], tips[site, 3:])
        refused = np.zeros(kernels.N_REASONS, dtype=np.int64)
        work = np.zeros((2, kernels.N_TRACE))

        def rows_of(turns: Int) -> Float:
            normals = frames.bending_directions(frame, angles[turns])
            rows = np.zeros((most * len(turns), kernels.ENTRY_COLUMNS))
            count = kernels.enumerate_site(
                scene, constants, tips[site], normals, site, stops, rows, refused, work
            )
            found = rows[:count].copy()
            found[:, 1] = turns[found[:, 1].astype(np.int64)]
            return found

        found = rows_of(np.arange(rotations))
        between = _between_unlike(found, rotations, stops)
        if len(between):
            found = np.concatenate([found, rows_of(rotations + between)])
        done += 1
        if progress and done % 50 == 0:
            progress(done / len(tips))
        return found, refused, (rotations + len(between)) * (most - 1)

    with ThreadPoolExecutor(THREADS) as pool:
        parts = list(pool.map(one_site, range(len(tips))))
    rows = np.concatenate([np.zeros((0, kernels.ENTRY_COLUMNS)), *(rows for rows, _, _ in parts)])
    refused = np.zeros(kernels.N_REASONS, dtype=np.int64)
    for _, counts, _ in parts:
        refused += counts
    return _as_deployments(rows, angles, refused, sum(candidates for _, _, candidates in parts))


def _between_unlike(rows: Float, rotations: int, stops: Float) -> Int:
    """Return the rotations between which and the next ones other insertions are accepted: a limit is near."""
    accepted = np.zeros((rotations, len(stops), len(stops)), dtype=bool)
    outer, inner = (np.rint(rows[:, column] / stops[1]).astype(np.int64) for column in (2, 3))
    accepted[rows[:, 1].astype(np.int64), outer, inner] = True
    unlike = (accepted != np.roll(accepted, -1, axis=0)).any(axis=(1, 2))
    return np.flatnonzero(unlike)


def joined(one: Deployments, other: Deployments, first_site: int) -> Deployments:
    """Return the deployments of two enumerations; the other's sites are counted from `first_site`."""
    arrays: dict[str, Any] = {
        f.name: read_only(np.concatenate([getattr(one, f.name), getattr(other, f.name)]))
        for f in fields(one)
        if isinstance(getattr(one, f.name), np.ndarray)
    }
    arrays["site"] = read_only(np.concatenate([one.site, other.site + first_site]))
    refused = {
        why: one.refused.get(why, 0) + other.refused.get(why, 0) for why in [*one.refused, *other.refused]
    }
    return Deployments(**arrays, candidates=one.candidates + other.candidates, refused=refused)


def _as_deployments(rows: Float, angles: Float, refused: Int, candidates: int) -> Deployments:
    tip = kernels.ENTRY_TIP
    return Deployments(
        site=read_only(rows[:, 0].astype(np.int64)),
        rotation_rad=read_only(angles[rows[:, 1].astype(np.int64)]),
        outer_mm=read_only(rows[:, 2].copy()),
        inner_mm=read_only(rows[:, 3].copy()),
        branch=read_only(rows[:, 4].astype(np.int64)),
        exit_mm=read_only(rows[:, 5].copy()),
        wall_angle_rad=read_only(rows[:, 6].copy()),
        positions=read_only(rows[:, tip : tip + 3].copy()),
        tangents=read_only(rows[:, tip + 3 : tip + 6].copy()),
        candidates=candidates,
        refused={REASONS[code]: int(refused[code]) for code in REASONS if refused[code]},
    )


class TubeJudge:
    """Judges single deployments of one pair of tubes in one lung."""

    def __init__(self, lung: Lung, tubes: ConcentricTubes, margins: Margins, *, with_fissures: bool) -> None:
        self._scene = scene_of(lung, with_fissures=with_fissures)
        self._constants = tube_constants(tubes, margins)
        self._trace = np.zeros(kernels.N_TRACE)
        self._tip = np.zeros(9)

    def judge(
        self, lps_from_scope_tip: Float, rotation_rad: float, outer_mm: float, inner_mm: float
    ) -> Deployment | str:
        """Return the deployment, or the reason why it is refused.

        Parameters
        ----------
        lps_from_scope_tip : (4, 4) float64
        rotation_rad : float
            Direction of the bend about +z of the scope tip, counted from its +x.
        outer_mm, inner_mm : float
            Insertions beyond the scope tip.

        Raises
        ------
        SettingsError
            If the outer tube would be ahead of the inner one.
        """
        if not 0.0 <= outer_mm <= inner_mm:
            raise SettingsError(
                f"The insertions of outer and inner tube are {outer_mm:g} and {inner_mm:g} mm",
                expected="0 <= outer <= inner",
            )
        base = np.concatenate([lps_from_scope_tip[:3, 3], lps_from_scope_tip[:3, 2]])
        normal = frames.bending_directions(lps_from_scope_tip, rotation_rad)[0]
        trace, tip = self._trace, self._tip
        reason = kernels.deploy(
            self._scene, self._constants, base, normal, float(outer_mm), float(inner_mm), trace, tip
        )
        if reason != kernels.ACCEPTED:
            return REASONS[reason]
        return Deployment(
            rotation_rad=float(rotation_rad),
            outer_mm=float(outer_mm),
            inner_mm=float(inner_mm),
            lps_from_tip=frames.pose(tip[:3], tip[3:6], tip[6:9]),
            branch=int(trace[kernels.BRANCH]),
            exit_mm=float(trace[kernels.LEFT_AT]),
            wall_angle_rad=float(trace[kernels.WALL_ANGLE]),
            lateral_sweep_mm=float(kernels.lateral_sweep(self._constants, float(outer_mm), float(inner_mm))),
        )

"""The enumeration of all deployments from many scope poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses as frames
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from anatomy.grid import read_only
from anatomy.lung import Lung
from anatomy.margins import Margins
from stages.tube import kernels
from stages.tube.design_shapes import coarser_shapes, shapes_of
from stages.tube.device import ConcentricTubes
from stages.tube.environment import (
    DEFAULT_ROTATIONS,
    THREADS,
    tracking_length_mm,
    tube_constants,
    tube_environment,
)
from stages.tube.placing import place_shapes
from stages.tube.validation import REASONS

DEFAULT_STOP_MM = 2.0
"""Spacing of insertions: small against the reach of needles, which start at the tips."""


@frozen_record
class Deployments:
    """Accepted deployments, E of them, and counts of the refused.

    Parameters
    ----------
    site : (E,) int64
        Index of the scope pose.
    rotation_rad, outer_mm, inner_mm : (E,) float64
        Rotation of all tubes together; insertions of the outermost and the innermost beyond the scope tip.
    shape : (E,) int64
        Index in `shapes_of(tubes)`; -1 for planar tubes.
    branch : (E,) int64
        Pierced branch.
    exit_mm, wall_angle_rad : (E,) float64
        Arc length at which the axis leaves the lumen for good, and its angle to the wall there.
    wall_run_mm : (E,) float64
        Length of body in the wall of the pierced branch, beyond the exit.
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
    shape: Int
    branch: Int
    exit_mm: Float
    wall_angle_rad: Float
    wall_run_mm: Float
    positions: Float
    tangents: Float
    candidates: int
    refused: dict[str, int]

    @property
    def count(self) -> int:
        """Number of accepted deployments, E."""
        return len(self.site)

    def only(self, chosen: Int) -> Deployments:
        """Return some of them, by their numbers `(N,)`."""
        arrays: dict[str, Any] = {
            f.name: read_only(getattr(self, f.name)[chosen])
            for f in fields(self)
            if isinstance(getattr(self, f.name), np.ndarray)
        }
        return replace(self, **arrays)

    def choice(self, entry: int) -> tuple[float, float, float, int]:
        """Return rotation, insertions and shape of one, as `DeploymentValidator.choose` takes them."""
        turned, outer, inner = self.rotation_rad[entry], self.outer_mm[entry], self.inner_mm[entry]
        return float(turned), float(outer), float(inner), int(self.shape[entry])


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
    worthwhile: Callable[[Float, Float], Bool] | None = None,
    progress: Callable[[float], None] | None = None,
) -> Deployments:
    """Enumerate what the tubes can do from many scope tips.

    Of planar tubes only deployments without sideways sweep are enumerated: those whose tip stays within
    `tracking_length_mm` of the scope tip.  Of any others, the shapes of the design at such stops are.

    Parameters
    ----------
    scope_tips : (S, 9) float64
        Point, direction and +x of the frame of each scope tip, LPS mm; rotations count from that +x.
    with_fissures : bool
        Whether fissures are obstacles.
    rotations : int
        Evenly spaced rotations of the tubes.  Between two of them a further one is looked at where not the
        same insertions are accepted at both: there the tube or its exit is near a limit.
    stop_spacing_mm : float
        Spacing of the insertions of both tubes.
    worthwhile : callable, optional
        Tells from positions and tangents `(N, 3)` of tips, LPS mm, which `(N,)` deployments are of use; of
        planar tubes no others are looked at, but those between two rotations always are.
    progress : callable, optional
        Told the share of sites done.
    """
    tips = np.array(scope_tips, dtype=np.float64, order="C").reshape(-1, 9)
    if not tubes.planar:
        return _enumerate_shapes(
            lung, tubes, margins, tips, with_fissures, rotations, stop_spacing_mm, progress
        )
    enumerator = SiteEnumerator(
        lung, tubes, margins, with_fissures=with_fissures, rotations=rotations,
        stop_spacing_mm=stop_spacing_mm,
    )  # fmt: skip
    done = 0

    def one_site(site: int) -> tuple[Float, Int, int]:
        nonlocal done
        found = enumerator.rows(tips[site], site, worthwhile)
        done += 1
        if progress and done % 50 == 0:
            progress(done / len(tips))
        return found

    with ThreadPoolExecutor(THREADS) as pool:
        parts = list(pool.map(one_site, range(len(tips))))
    rows = np.concatenate([np.zeros((0, kernels.ENTRY_COLUMNS)), *(rows for rows, _, _ in parts)])
    refused = np.zeros(kernels.N_REASONS, dtype=np.int64)
    for _, counts, _ in parts:
        refused += counts
    return _as_deployments(rows, enumerator.angles, refused, sum(candidates for *_, candidates in parts))


Enumerator = Callable[[Float, Callable[[Float, Float], Bool]], Deployments]
"""Returns the deployments from a scope tip `(9,)` that are of use; see `enumerate_deployments`."""


def one_site_enumerator(
    lung: Lung, tubes: ConcentricTubes, margins: Margins, *, with_fissures: bool, enough: int | None = None
) -> Enumerator:
    """Return what enumerates the deployments from one scope tip after another, prepared once for all.

    Where more than `enough` are of use, fewer rotations of planar tubes are looked at.
    """
    if tubes.planar:
        return SiteEnumerator(lung, tubes, margins, with_fissures=with_fissures, enough=enough).deployments
    return lambda tip, worthwhile: enumerate_deployments(
        lung, tubes, margins, tip[None], with_fissures=with_fissures, worthwhile=worthwhile
    )


class SiteEnumerator:
    """Enumerates what planar tubes can do from one scope tip after another; see `enumerate_deployments`.

    Attributes
    ----------
    angles : (T,) float64
        Rotations, rad: the even ones, then those between them.
    """

    def __init__(
        self,
        lung: Lung,
        tubes: ConcentricTubes,
        margins: Margins,
        *,
        with_fissures: bool,
        rotations: int = DEFAULT_ROTATIONS,
        stop_spacing_mm: float = DEFAULT_STOP_MM,
        enough: int | None = None,
    ) -> None:
        self._enough = enough
        self._rotations = rotations if tubes.inner.bends else 1
        coarse: Float = np.arange(self._rotations, dtype=np.float64) * (2 * math.pi / self._rotations)
        self.angles = np.concatenate([coarse, coarse + math.pi / self._rotations])
        self._stops = insertion_stops(tubes, stop_spacing_mm)
        self._environment = tube_environment(lung, with_fissures=with_fissures)
        self._constants = tube_constants(tubes, margins)
        self._outer, self._inner, self._ends = _ends_at_stops(tubes, stop_spacing_mm)
        self._every = np.zeros((len(self.angles), len(self._stops), len(self._stops)), dtype=np.bool_)
        self._every[:, self._outer, self._inner] = True

    def deployments(self, tip: Float, worthwhile: Callable[[Float, Float], Bool]) -> Deployments:
        """Return the deployments from one scope tip `(9,)` that are of use."""
        rows, refused, candidates = self.rows(tip, 0, worthwhile)
        return _as_deployments(rows, self.angles, refused, candidates)

    def rows(
        self, tip: Float, site: int, worthwhile: Callable[[Float, Float], Bool] | None
    ) -> tuple[Float, Int, int]:
        """Return entries as the kernel writes them, counts of the refused, and how many were looked at."""
        frame = frames.pose(tip[:3], tip[3:6], tip[6:])
        normals = frames.bending_directions(frame, self.angles)
        refused = np.zeros(kernels.N_REASONS, dtype=np.int64)
        work = np.zeros((2, kernels.N_TRACE))
        wanted = self._every
        if worthwhile:
            wanted = np.zeros_like(self._every)
            at, towards = np.zeros((2, len(self.angles) * len(self._outer), 3))
            kernels.turned_ends(self._ends, frame, normals, at, towards)
            wanted[:, self._outer, self._inner] = worthwhile(at, towards).reshape(len(self.angles), -1)
            if self._enough is not None:
                self._thin(wanted, self._enough)

        def rows_of(turns: Int) -> tuple[Float, int]:
            chosen = wanted[turns]
            most = int(np.count_nonzero(chosen))
            rows = np.zeros((most, kernels.ENTRY_COLUMNS))
            count = kernels.enumerate_site(
                self._environment, self._constants, tip[:6], normals[turns], site, self._stops, chosen, rows,
                refused, work,
            )  # fmt: skip
            found = rows[:count].copy()
            found[:, 1] = turns[found[:, 1].astype(np.int64)]
            return found, most

        if worthwhile:
            found, candidates = rows_of(np.arange(len(self.angles)))
            return found, refused, candidates
        found, candidates = rows_of(np.arange(self._rotations))
        between = _between_unlike(found, self._rotations, self._stops)
        if len(between):
            further, more = rows_of(self._rotations + between)
            found, candidates = np.concatenate([found, further]), candidates + more
        return found, refused, candidates

    def _thin(self, wanted: Bool, enough: int) -> None:
        """Drop rotations evenly until no more than enough deployments are left: those between come last."""
        counts = np.count_nonzero(wanted, axis=(1, 2))
        turn = np.arange(len(self.angles)).reshape(-1, 2).T.ravel()
        step = 1
        while counts[turn % step == 0].sum() > enough and step < self._rotations:
            step *= 2
        wanted[turn % step != 0] = False


@lru_cache(maxsize=8)
def _ends_at_stops(tubes: ConcentricTubes, stop_spacing_mm: float) -> tuple[Int, Int, Float]:
    """Return which stops `(K,)` outer and inner planar tube stand at, and where the tip then is `(K, 4)`.

    Position and tangent of the tip are each aside and ahead, in the plane of the bend.  One tube has the same
    shape wherever an outer one would end: its outer stops are its inner ones.
    """
    stops = insertion_stops(tubes, stop_spacing_mm)
    outer, inner = (each[1:] for each in np.triu_indices(len(stops)))
    if tubes.outer is None:
        outer = inner = np.arange(1, len(stops))
    base, normal = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    constants = tube_constants(tubes, Margins())
    poses = [
        kernels.tip_pose(constants, base, normal, *ends)
        for ends in zip(stops[outer].tolist(), stops[inner].tolist(), strict=True)
    ]
    return outer, inner, np.array(poses).reshape(-1, 6)[:, [0, 2, 3, 5]]


def _enumerate_shapes(
    lung: Lung,
    tubes: ConcentricTubes,
    margins: Margins,
    tips: Float,
    with_fissures: bool,
    rotations: int,
    stop_spacing_mm: float,
    progress: Callable[[float], None] | None,
) -> Deployments:
    """Place shapes of a design at scope tips."""
    members, shapes, tree = coarser_shapes(shapes_of(tubes), stop_spacing_mm)
    placed = place_shapes(
        lung,
        shapes,
        margins,
        [frames.pose(tip[:3], tip[3:6], tip[6:]) for tip in tips],
        min_wall_angle_rad=math.radians(tubes.min_wall_angle_deg),
        max_wall_run_mm=tubes.max_wall_run_mm,
        with_fissures=with_fissures,
        rotations=rotations if any(tube.bends for tube in tubes.nested) else 1,
        tree=tree,
        progress=progress,
    )
    return Deployments(
        site=placed.site,
        rotation_rad=placed.rotation_rad,
        outer_mm=read_only(shapes.insertions_mm[placed.shape, -1]),
        inner_mm=read_only(shapes.insertions_mm[placed.shape, 0]),
        shape=read_only(members[placed.shape]),
        branch=placed.branch,
        exit_mm=placed.exit_mm,
        wall_angle_rad=placed.wall_angle_rad,
        wall_run_mm=placed.wall_run_mm,
        positions=placed.positions,
        tangents=placed.tangents,
        candidates=placed.candidates,
        refused=placed.refused,
    )


def _between_unlike(rows: Float, rotations: int, stops: Float) -> Int:
    """Return the rotations between which and the next ones other insertions are accepted: a limit is near."""
    accepted = np.zeros((rotations, len(stops), len(stops)), dtype=bool)
    outer, inner = (np.rint(rows[:, column] / stops[1]).astype(np.int64) for column in (2, 3))
    accepted[rows[:, 1].astype(np.int64), outer, inner] = True
    unlike = (accepted != np.roll(accepted, -1, axis=0)).any(axis=(1, 2))
    return np.flatnonzero(unlike)


def join_deployments(one: Deployments, other: Deployments, first_site: int) -> Deployments:
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
        shape=read_only(np.full(len(rows), -1)),
        branch=read_only(rows[:, 4].astype(np.int64)),
        exit_mm=read_only(rows[:, 5].copy()),
        wall_angle_rad=read_only(rows[:, 6].copy()),
        wall_run_mm=read_only(rows[:, 7].copy()),
        positions=read_only(rows[:, tip : tip + 3].copy()),
        tangents=read_only(rows[:, tip + 3 : tip + 6].copy()),
        candidates=candidates,
        refused={REASONS[code]: int(refused[code]) for code in REASONS if refused[code]},
    )

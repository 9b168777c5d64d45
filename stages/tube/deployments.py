"""The enumeration of all deployments from many scope poses: shapes of a design, placed in a lung."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy import poses as frames
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from anatomy.grid import read_only
from anatomy.lung import Lung
from anatomy.margins import Margins
from anatomy.poses import pose
from stages.tube import kernels
from stages.tube.arcs import points_on_arcs
from stages.tube.design_shapes import ShapeTree, coarser_shapes, shapes_of
from stages.tube.device import ConcentricTubes
from stages.tube.kernels import placing
from stages.tube.one_shape import DEFAULT_ROTATIONS, THREADS, tube_constants, tube_environment
from stages.tube.shapes import TubeShapes
from stages.tube.validation import REASONS

DEFAULT_STOP_MM = 2.0
"""Spacing of insertions: small against the reach of needles, which start at the tips."""


@frozen_record
class Deployments:
    """Accepted deployments, E of them, from S scope poses, and counts of the refused.

    Args:
        site ((E,) int64): Index of the scope pose.
        rotation_rad, outer_mm, inner_mm ((E,) float64): Rotation of all tubes together; insertions of the
            outermost and the innermost beyond the scope tip.
        shape ((E,) int64): Index in `shapes_of(tubes)`.
        branch ((E,) int64): Pierced branch.
        exit_mm, wall_angle_rad ((E,) float64): Arc length at which the axis leaves the lumen for good, and
            its angle to the wall there.
        wall_run_mm ((E,) float64): Length of body in the wall of the pierced branch, beyond the exit.
        positions, tangents ((E, 3) float64): Tip of the inner tube, LPS mm.
        looked_at ((S,) int64): How many were looked at from each scope pose.
        refused_at ((S, N_REASONS) int64): How many of them were refused, by reason.
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
    looked_at: Int
    refused_at: Int

    @property
    def candidates(self) -> int:
        """Number of deployments looked at."""
        return int(self.looked_at.sum())

    @property
    def refused(self) -> dict[str, int]:
        """How many were refused, by reason."""
        counts = self.refused_at.sum(axis=0)
        return {why: int(counts[code]) for code, why in REASONS.items() if counts[code]}

    @property
    def count(self) -> int:
        """Number of accepted deployments, E."""
        return len(self.site)

    def only(self, chosen: Int) -> "Deployments":
        """Return some of them, by their numbers `(N,)`."""
        arrays: dict[str, Any] = {name: read_only(getattr(self, name)[chosen]) for name in _OF_EACH}
        return replace(self, **arrays)

    def with_sites(self, sites: Int, others: "Deployments") -> "Deployments":
        """Return these, but from some scope poses, by their numbers `(N,)`, those of another enumeration."""
        kept = np.flatnonzero(~np.isin(self.site, sites))
        site = np.concatenate([self.site[kept], sites[others.site]])
        order = np.argsort(site, kind="stable")
        arrays: dict[str, Any] = {
            name: read_only(np.concatenate([getattr(self, name)[kept], getattr(others, name)])[order])
            for name in _OF_EACH
        }
        arrays["site"] = read_only(site[order])
        for name in _OF_SITES:
            counts = getattr(self, name).copy()
            counts[sites] = getattr(others, name)
            arrays[name] = read_only(counts)
        return Deployments(**arrays)

    def choice(self, entry: int) -> tuple[float, int]:
        """Return rotation and shape of one, as `DeploymentValidator.choose` takes them."""
        return float(self.rotation_rad[entry]), int(self.shape[entry])


_OF_SITES = ("looked_at", "refused_at")
_OF_EACH = tuple(each.name for each in fields(Deployments) if each.name not in _OF_SITES)


def enumerate_deployments(
    lung: Lung,
    tubes: ConcentricTubes,
    margins: Margins,
    scope_tips: ArrayLike,
    *,
    with_fissures: bool,
    rotations: int = DEFAULT_ROTATIONS,
    stop_spacing_mm: float = DEFAULT_STOP_MM,
    worthwhile: "OfUse | None" = None,
    progress: Callable[[float], None] | None = None,
    enumerator: "SiteEnumerator | None" = None,
) -> Deployments:
    """Enumerate what the tubes can do from many scope tips: the shapes of the design that leave safely.

    Args:
        scope_tips ((S, 9) float64): Point, direction and +x of scope tips, LPS mm; rotations count from +x.
        rotations: Evenly spaced rotations of the tubes.  Where no tube is turned against another, a further
            one is looked at between two of them where not the same shapes are accepted at both: there the
            tube or its exit is near a limit.
        worthwhile: No others are looked at, but those between two rotations always are.
        progress: Told the share of sites done.
        enumerator: Made of the others if None.
    """
    tips = np.array(scope_tips, dtype=np.float64, order="C").reshape(-1, 9)
    enumerator = enumerator or SiteEnumerator(
        lung, tubes, margins, with_fissures=with_fissures, rotations=rotations,
        stop_spacing_mm=stop_spacing_mm,
    )  # fmt: skip
    done = 0

    def one_site(tip: Float) -> Deployments:
        nonlocal done
        found = enumerator.deployments(tip, worthwhile)
        done += 1
        if progress and done % 50 == 0:
            progress(done / len(tips))
        return found

    with ThreadPoolExecutor(THREADS) as pool:
        parts = list(pool.map(one_site, tips))
    return _joined([enumerator.none, *parts], np.arange(-1, len(tips)))


OfUse = Callable[[Float, Float], Bool]
"""Tells from positions and tangents `(N, 3)` of tips, LPS mm, which `(N,)` deployments are of use."""
Enumerator = Callable[[Float, OfUse], Deployments]
"""Returns the deployments from a scope tip `(9,)` that are of use; see `enumerate_deployments`."""


class SiteEnumerator:
    """Enumerates what tubes can do from one scope tip after another, prepared once for all.

    A stretch that many shapes share is followed once; where it is refused, so are all of them.  What a shape
    sweeps, and what its arcs and the sharing are off by, is added to its clearance.  The arc length at the
    exit, the angle and the run there are those of the shape that shares the beginning, which is within the
    tolerance of the tree.  `angles` `(T,)` are the rotations in rad: the even ones, then those between them,
    if there are any.

    Args:
        enough: Where more deployments are of use, fewer rotations are looked at.
        at_stops: Numbers, set and tree of the shapes that are placed; by default the design's, made coarser.
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
        at_stops: tuple[Int, TubeShapes, ShapeTree] | None = None,
    ) -> None:
        self._enough = enough
        self._rotations = rotations if any(tube.bends for tube in tubes.nested) else 1
        self._members, self._shapes, tree = at_stops or coarser_shapes(shapes_of(tubes), stop_spacing_mm)
        self._tree, self._depth = tree.with_margin(margins.total_mm), int(tree.depth.max(initial=0))
        even: Float = np.arange(self._rotations, dtype=np.float64) * (2 * math.pi / self._rotations)
        self._between = not self._shapes.rotations_rad.any()
        self.angles = np.concatenate([even, even + math.pi / self._rotations]) if self._between else even
        self._turns = _about_z(self.angles)
        self._environment = tube_environment(lung, with_fissures=with_fissures)
        self._constants = tube_constants(tubes, margins)
        empty = np.zeros((0, placing.PLACED_COLUMNS)), np.zeros(0, dtype=np.int64)
        refused = np.zeros((0, kernels.N_REASONS), dtype=np.int64)
        self.none = self._placed(np.eye(4), *empty, refused, np.zeros(0, dtype=np.int64))

    def deployments(self, tip: Float, worthwhile: OfUse | None = None) -> Deployments:
        """Return the deployments from one scope tip `(9,)`, those of use alone where that can be told."""
        frame = frames.pose(tip[:3], tip[3:6], tip[6:])
        refused = np.zeros(kernels.N_REASONS, dtype=np.int64)
        traces = np.zeros((self._depth + 1, kernels.N_TRACE))
        wanted = np.ones((len(self.angles), self._shapes.count), dtype=np.bool_)
        if worthwhile:
            wanted = self._of_use(frame, worthwhile)

        def placed(turns: Int) -> tuple[Float, Int]:
            rows = np.zeros((len(turns) * self._shapes.count, placing.PLACED_COLUMNS))
            counts = np.zeros(len(turns), dtype=np.int64)
            placing.place_tree(
                self._environment, self._constants, frame @ self._turns[turns], self._tree, wanted[turns],
                refused, traces, rows, counts,
            )  # fmt: skip
            return rows[: counts.sum()].copy(), np.repeat(turns, counts)

        turns = np.arange(len(self.angles) if worthwhile else self._rotations)
        rows, turn_of = placed(turns)
        if self._between and not worthwhile:
            further = self._rotations + self._between_unlike(rows, turn_of)
            more, of_more = placed(further)
            rows, turn_of = np.concatenate([rows, more]), np.concatenate([turn_of, of_more])
            turns = np.concatenate([turns, further])
        looked_at = np.array([np.count_nonzero(wanted[turns])], dtype=np.int64)
        return self._placed(frame, rows, turn_of, refused[None], looked_at)

    def _of_use(self, frame: Float, worthwhile: OfUse) -> Bool:
        """Return which shapes `(T, S)` are of use, from few enough rotations: those between come last."""
        tips = (frame @ self._turns)[:, None] @ self._shapes.scope_from_tip
        at, towards = (np.ascontiguousarray(tips[..., :3, column].reshape(-1, 3)) for column in (3, 2))
        wanted = worthwhile(at, towards).reshape(len(self.angles), -1)
        counts, step = np.count_nonzero(wanted, axis=1), 1
        turn = np.arange(len(self.angles)).reshape(-1, 1 + self._between).T.ravel()
        while self._enough and counts[turn % step == 0].sum() > self._enough and step < self._rotations:
            step *= 2
        wanted[turn % step != 0] = False
        return np.ascontiguousarray(wanted)

    def _between_unlike(self, rows: Float, turn_of: Int) -> Int:
        """Return the rotations between which and the next ones other shapes are accepted: a limit is near."""
        accepted = np.zeros((self._rotations, self._shapes.count), dtype=bool)
        accepted[turn_of, rows[:, placing.PLACED_SHAPE].astype(np.int64)] = True
        return np.flatnonzero((accepted != np.roll(accepted, -1, axis=0)).any(axis=1))

    def _placed(self, frame: Float, rows: Float, turn_of: Int, refused: Int, looked_at: Int) -> Deployments:
        shape = rows[:, placing.PLACED_SHAPE].astype(np.int64)
        lps = frame @ self._turns[turn_of] @ self._shapes.scope_from_tip[shape]
        return Deployments(
            site=read_only(np.zeros(len(rows), dtype=np.int64)),
            rotation_rad=read_only(self.angles[turn_of]),
            outer_mm=read_only(self._shapes.insertions_mm[shape, -1]),
            inner_mm=read_only(self._shapes.insertions_mm[shape, 0]),
            shape=read_only(self._members[shape]),
            branch=read_only(rows[:, placing.PLACED_BRANCH].astype(np.int64)),
            exit_mm=read_only(rows[:, placing.PLACED_EXIT].copy()),
            wall_angle_rad=read_only(rows[:, placing.PLACED_ANGLE].copy()),
            wall_run_mm=read_only(rows[:, placing.PLACED_RUN].copy()),
            positions=read_only(lps[:, :3, 3].copy()),
            tangents=read_only(lps[:, :3, 2].copy()),
            looked_at=read_only(looked_at),
            refused_at=read_only(refused),
        )


def _about_z(angles_rad: Float) -> Float:
    turned = np.zeros((len(angles_rad), 4, 4))
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(angles_rad)
    turned[:, 1, 0] = np.sin(angles_rad)
    turned[:, 0, 1] = -turned[:, 1, 0]
    turned[:, 2, 2] = turned[:, 3, 3] = 1.0
    return turned


def join_deployments(one: Deployments, other: Deployments, first_site: int) -> Deployments:
    """Return the deployments of two enumerations; the other's sites are counted from `first_site`."""
    return _joined([one, other], np.array([0, first_site]))


def _joined(parts: list[Deployments], first_site: Int) -> Deployments:
    """Return the deployments of several enumerations, whose sites are counted from `first_site` (P,)."""
    arrays: dict[str, Any] = {
        name: read_only(np.concatenate([getattr(part, name) for part in parts]))
        for name in (*_OF_EACH, *_OF_SITES)
    }
    arrays["site"] = read_only(arrays["site"] + np.repeat(first_site, [part.count for part in parts]))
    return Deployments(**arrays)


def exit_points(tubes: ConcentricTubes, scope_tips: Float, deployments: Deployments, chosen: Int) -> Float:
    """Return points `(N, 3)` LPS mm where deployments leave the lumen for good, from scope tips `(S, 9)`."""
    tips, at_mm = scope_tips[deployments.site[chosen]], deployments.exit_mm[chosen]
    rotations = deployments.rotation_rad[chosen]
    shapes, points = shapes_of(tubes), np.zeros((len(chosen), 3))
    for row, (tip, shape) in enumerate(zip(tips, deployments.shape[chosen].tolist(), strict=True)):
        frame = pose(tip[:3], tip[3:6], tip[6:])
        points[row] = points_on_arcs(shapes.arcs_of(shape), frame, float(rotations[row]), at_mm[row])[0]
    return points

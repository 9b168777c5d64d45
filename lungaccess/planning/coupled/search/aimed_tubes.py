"""Tubes aimed at a target from the scope tips of an atlas: what a system without a needle can do."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from anatomy.base.typed import Bool, Float, Int
from anatomy.lung import Lung
from anatomy.poses import poses_on_pieces
from anatomy.structures import obstacle_bits
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kernels import aimed_tubes as kernel
from lungaccess.planning.coupled.search import base
from lungaccess.plans.candidate import Candidate, tubes_in_tissue
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.system import System
from lungaccess.problem.task import Task
from stages.needle import ArcPath, Objective, Obstacles
from stages.scope import ScopeTip, evenly
from stages.tube import (
    REASONS,
    ConcentricTubes,
    Deployment,
    ManyShapes,
    TubeShape,
    copies,
    deployed,
    design_arrays,
    many_shapes,
    shape_arrays,
    shape_of_arrays,
    shapes_of,
    tube_constants,
    tube_environment,
)

STOPS_MM = 3.0
TURN_RAD = math.pi / 12.0
"""The tubes are aimed from deployments that end near the target: as near as one of the same scope tip ends to
every point that the tubes can come to.  Stops of turned tips are 4 mm apart, 2.8 mm in both insertions from
the middle between them, and their rotations 30 degrees apart."""
NO_WAY = "on their way to the target the tubes would snap, sweep tissue or be strained too much"
NO_SOLUTION = "no insertions bring the tip of the tubes to the target"


def starts_of(atlas: Atlas, entries: Int) -> ManyShapes:
    """Return the shapes of entries (N,) of an atlas, from which the tubes are aimed."""
    return many_shapes(shapes_of(atlas.system.tubes), atlas.deployments.shape[entries])


def aim_starts(tubes: ConcentricTubes, joints: Float, count: int) -> ManyShapes | None:
    """Return `count` times the shape of joints (2 n,), see `TubeShape`; None if the tubes refuse it."""
    made = deployed(design_arrays(tubes), *np.split(joints, 2))
    return None if made is None else copies(made, count)


class TubeAiming:
    """Aims the tubes of a system at points in a lung."""

    def __init__(self, lung: Lung, system: System, objective: Objective, *, with_fissures: bool) -> None:
        self._environment = tube_environment(lung, with_fissures=with_fissures)
        self._constants = tube_constants(system.tubes, system.margins)
        self._design = design_arrays(system.tubes)
        field, bits = lung.obstacle_field(with_fissures=with_fissures), obstacle_bits(with_fissures)
        self._obstacles = Obstacles(field.corners, lung.labels, field.geometry, bits)
        weighed = objective.without_map if lung.cost is None else objective
        cost_map = None if lung.cost is None else lung.cost.array
        arrays = weighed.arrays(cost_map, width_mm=0.0)
        of_map = arrays._replace(inverse_clearance=0.0, length=0.0)
        of_tubes = weighed.arrays_of_tubes(cost_map)
        self._weights = arrays._replace(map_integral=0.0, voxel_sum=0.0), of_map, of_tubes

    def aim(
        self, ends: Float, tips: Float, allowed: Bool, row_of: Int, starts: ManyShapes, enough: int = 0
    ) -> tuple[Float, Int]:
        """Aim the tubes at a point from scope tips, or from each at its own.

        Args:
            ends ((3,) or (K, 3) float64, LPS mm): Where they are to end.
            tips, allowed ((K, 9) float64 and (K,) bool): Scope tips, and which of them the scope can take.
            row_of ((N,) int64): The tip of each attempt.
            enough: So many deployments end the attempts; 0 to make all of them.

        Returns:
            - found ((N, JOINTS + 2 n) float64) - Rotation in rad, estimated cost, which is infinite where
              there is nothing, and all joints.
            - why ((N,) int64) - 0 for a deployment that ends at the point, MISSES, SPOILT_WAY, NOT_TRIED, or
              why tubes refuse it.
        """
        scratch = shape_arrays(self._design), shape_arrays(self._design)
        found = np.zeros((len(row_of), kernel.JOINTS + len(scratch[0].joints)))
        why = np.zeros(len(row_of), dtype=np.int64)
        tube = (self._environment, self._constants, self._design, *scratch)
        points = np.ascontiguousarray(np.broadcast_to(ends, (len(tips), 3)))
        kernel.aim_tubes(
            tube, self._obstacles, *self._weights, tips, allowed, row_of.astype(np.int64), starts,
            points, enough or len(row_of), found, why,
        )  # fmt: skip
        return found, why


def near_mm(atlas: Atlas, ends: Float) -> Float:
    """Return how near to their ends deployments have to come to be aimed there, by their scope tips (S,).

    The ends are one point (3,) for all, or one for each scope tip (S, 3).
    """
    tips = atlas.motions.tips
    aside = np.linalg.norm(np.cross(ends - tips[:, :3], tips[:, 3:6]), axis=1)
    return np.asarray(STOPS_MM + TURN_RAD * aside)


def nearest_of_each_tip(atlas: Atlas, entries: Int, away_mm: Float) -> Int:
    """Return of entries (N,) of an atlas the nearest of each scope tip, the nearest first.

    Where tubes are turned one against the other, it is the nearest of each tip and relative rotation.
    """
    ordered = entries[np.argsort(away_mm, kind="stable")]
    turns = np.unique(shapes_of(atlas.system.tubes).rotations_rad, axis=0, return_inverse=True)[1].ravel()
    kinds = atlas.deployments.site[ordered] * (turns.max(initial=0) + 1)
    kinds += turns[atlas.deployments.shape[ordered]]
    _kinds, first = np.unique(kinds, return_index=True)
    return ordered[np.sort(first)]


def tips_of(atlas: Atlas, entries: Int) -> tuple[Int, Float, Int]:
    """Return the scope tips of entries (N,) of an atlas, numbers (K,) and rows (K, 9), and that of each."""
    sites, row_of = np.unique(atlas.deployments.site[entries], return_inverse=True)
    return sites, np.ascontiguousarray(atlas.motions.tips[sites]), row_of.ravel()


class AimedFromPose:
    """The tubes aimed at the target of a task from one pose of the scope."""

    def __init__(self, evaluator: CandidateEvaluator, lps_from_scope_tip: Float) -> None:
        self._evaluator, self._frame = evaluator, lps_from_scope_tip
        self.reasons: dict[str, int] = {}
        self.why = NO_SOLUTION

    def best(self) -> tuple[Deployment, ArcPath] | None:
        """Return the cheapest proved deployment to the target, and its tubes in tissue."""
        task, frame = self._evaluator.task, self._frame
        aiming = TubeAiming(task.lung, task.system, task.objective, with_fissures=task.with_fissures)
        starts = self._starts()
        count = len(starts.joints)
        row = np.concatenate([frame[:3, 3], frame[:3, 2], frame[:3, 0]])[None]
        found, why = aiming.aim(
            task.target.lps_mm, row, np.ones(1, dtype=np.bool_), np.zeros(count, dtype=np.int64), starts
        )
        reasons = _reasons_of(why)
        self.reasons = {f"tube, aimed at the target: {name}": n for name, n in reasons.items()}
        for n in np.argsort(found[:, kernel.COST], kind="stable").tolist():
            if not np.isfinite(found[n, kernel.COST]):
                break
            made = self._evaluator.tubes.choose(frame, *chosen_of(task.system.tubes, found[n]))
            if isinstance(made, str):
                continue
            path = tubes_in_tissue(frame, made)
            if self._evaluator.proves(made, path):
                return made, path
        stopped = {name: n for name, n in reasons.items() if name != NO_SOLUTION}
        if stopped:
            self.why = max(stopped, key=stopped.__getitem__)
        return None

    def _starts(self) -> ManyShapes:
        """Return the shapes that, turned, end nearest to the target."""
        tubes, target = self._evaluator.task.system.tubes, self._evaluator.task.target.lps_mm
        shapes, seen = shapes_of(tubes), (target - self._frame[:3, 3]) @ self._frame[:3, :3]
        tips = shapes.scope_from_tip[:, :3, 3]
        aside = np.hypot(tips[:, 0], tips[:, 1]) - np.hypot(seen[0], seen[1])
        # Shapes from which the tubes are aimed from one pose, half a millisecond each at most.
        near = np.argsort(np.hypot(aside, tips[:, 2] - seen[2]), kind="stable")[:60]
        return many_shapes(shapes, near)


def chosen_of(tubes: ConcentricTubes, found: Float) -> tuple[float, TubeShape]:
    """Return a row of what was found as `DeploymentValidator.choose` takes it."""
    made = deployed(design_arrays(tubes), *np.split(found[kernel.JOINTS :], 2))
    if made is None:
        raise ValueError("the way to a shape that was found keeps the limits of its design")
    return float(found[kernel.ROTATION]), shape_of_arrays(made)


def _reasons_of(why: Int) -> dict[str, int]:
    """Return how many attempts (N,) each reason refused, in words."""
    codes, counts = np.unique(why, return_counts=True)
    names = {kernel.MISSES: NO_SOLUTION, kernel.SPOILT_WAY: NO_WAY, **REASONS}
    return {names[c]: n for c, n in zip(codes.tolist(), counts.tolist(), strict=True) if c in names}


class AimedTubes:
    """The deployments, from the scope tips of an atlas, that end at the target of a task or beside it.

    Parameters are those of `DirectArcs`.

    Attributes:
        promising ((N,) int64): Entries of the atlas from which the tubes are aimed, one for each scope tip,
            the nearest first.
        nearest_mm: Distance of the target from the nearest tip of the tubes in the atlas, or infinite.
    """

    def __init__(
        self, task: Task, atlas: Atlas, evaluator: CandidateEvaluator | None = None, aims: Float | None = None
    ) -> None:
        self.task, self.atlas = task, atlas
        self.evaluator = evaluator or CandidateEvaluator(task)
        entries, target = atlas.deployments, task.target.lps_mm
        self._aims = np.broadcast_to(target, (atlas.motions.count, 3)) if aims is None else aims
        away = np.linalg.norm(entries.positions - self._aims[entries.site], axis=1)
        away[np.isnan(away)] = math.inf
        self.nearest_mm = float(away.min(initial=math.inf))
        near = np.flatnonzero(away <= near_mm(atlas, self._aims)[entries.site])
        self.promising: Int = nearest_of_each_tip(atlas, near, away[near])
        self._aiming = TubeAiming(task.lung, task.system, task.objective, with_fissures=task.with_fissures)

    def aim(self, entries: Int) -> tuple[Float, Int]:
        """Aim from entries (N,) of the atlas at the aims of their scope tips; see `TubeAiming.aim`."""
        sites, tips, row_of = tips_of(self.atlas, entries)
        ends, starts = self._aims[sites], starts_of(self.atlas, entries)
        return self._aiming.aim(ends, tips, np.isfinite(ends[:, 0]), row_of, starts)

    def aim_from(self, tips: Float, allowed: Bool, starts: ManyShapes) -> tuple[Float, Int]:
        """Aim once from each of other scope tips (N, 9); see `TubeAiming.aim`."""
        ends = np.array([self.evaluator.aim(tip) for tip in tips[:, :3]]).reshape(-1, 3)
        return self._aiming.aim(ends, tips, allowed, np.arange(len(tips)), starts)

    reasons = staticmethod(_reasons_of)
    """Returns how many attempts (N,) each reason refused, in words."""

    def evaluate(self, chosen: Int, slack: float) -> tuple[Int, Float, float]:
        """Return for entries (E,) why they are refused, 0 if not, their estimated costs, and the least."""
        found, why = self.aim(chosen)
        return why, found[:, kernel.COST], float(found[:, kernel.COST].min(initial=math.inf))

    def clear(self) -> Int:
        """Return the entries (C,) with a deployment that ends there, the cheapest first."""
        return self.promising[_cheapest_first(self.aim(self.promising)[0])]

    def candidate(self, entry: int) -> Candidate | None:
        """Return the deployment from the scope tip of an entry, None if the tubes are refused."""
        return self.made(self.tip(entry), self.aim(np.array([entry]))[0][0])

    def proved(self, entry: int) -> Candidate | None:
        """Return the deployment from the scope tip of an entry, None if its proof fails."""
        candidate = self.candidate(entry)
        return candidate if candidate is not None and self.evaluator.accepts(candidate) else None

    def lines(self, chosen: Int, samples: int) -> Float:
        """Return points (E, samples, 3) of the tubes in tissue from the scope tips of entries."""
        lines = np.zeros((len(chosen), samples, 3))
        for line, entry, row in zip(lines, chosen.tolist(), self.aim(chosen)[0], strict=True):
            candidate = self.made(self.tip(entry), row)
            if candidate is not None:
                path = candidate.path
                poses, _mm = poses_on_pieces(path.lps_from_start, path.arcs, path.length_mm / samples)
                line[:] = poses[np.linspace(0, len(poses) - 1, samples).round().astype(int), :3, 3]
        return lines

    def tip(self, entry: int) -> ScopeTip:
        """Return the scope tip of an entry."""
        return self.atlas.motions.tip(int(self.atlas.deployments.site[entry]))

    def made(self, tip: ScopeTip, found: Float) -> Candidate | None:
        """Return a row of what was found as a candidate, None if the tubes are refused."""
        if not np.isfinite(found[kernel.COST]):
            return None
        return self.evaluator.aimed(tip, *chosen_of(self.task.system.tubes, found))


def _cheapest_first(found: Float) -> Int:
    """Return the rows (C,) of what was found (N, ...) that have a deployment, the cheapest first."""
    clear = np.flatnonzero(np.isfinite(found[:, kernel.COST]))
    return clear[np.argsort(found[clear, kernel.COST], kind="stable")]


CHUNK = 200
"""Scope tips from which the tubes are aimed in one call, some 10 ms: then the caller may end the search."""
ROWS_MM = (evenly(0.25, 4.0), evenly(0.02, 0.26))
"""How much farther the scope may stop: a fraction of the 1 mm between the tips of an atlas and several times
as far as the next, then between the best of these and its neighbours."""


class TubeSearch(base.ParallelSearch):
    """Aims the tubes at the target from the tips of the atlas, then from tips along the motions of the best.

    It ends when it has looked along the motions of all tips with a deployment to the target that differ.
    After the direct steps `clear` (C,) has the entries with a deployment to the target, the cheapest first.
    """

    def __init__(self, task: Task, atlas: Atlas, aimed: AimedTubes | None = None) -> None:
        self.task, self.atlas = task, atlas
        self.arcs = aimed or AimedTubes(task, atlas)
        self.evaluator = self.arcs.evaluator
        super().__init__(self.evaluator.blocked)
        self.clear: Int = np.zeros(0, dtype=np.int64)

    def direct_steps(self) -> Iterator[base.Step]:
        """Aim from the tips of the atlas, those first from which a deployment ends nearest."""
        clear, costs = [self.clear], [np.zeros(0)]
        near, phase = self.arcs.promising, "aiming the tubes"
        for begin in range(0, len(near), CHUNK):
            chunk = near[begin : begin + CHUNK]
            found, why = self.arcs.aim(chunk)
            self.blocked.update(self.arcs.reasons(why))
            order = _cheapest_first(found)
            yield base.Step(iteration=0, phase=phase)
            yield from self._finalists(phase, chunk[order], found[order])
            clear.append(chunk[order])
            costs.append(found[order, kernel.COST])
        self.clear = np.concatenate(clear)[np.argsort(np.concatenate(costs), kind="stable")]

    def _finalists(self, phase: str, entries: Int, found: Float) -> Iterator[base.Step]:
        """Evaluate the cheapest in full, as long as one may be better than all before."""
        # Proved deployments of a chunk: the estimated costs by which they are chosen may be in the wrong
        # order.
        left = 3
        for entry, row in zip(entries.tolist(), found, strict=True):
            if not left or row[kernel.COST] > base.ESTIMATE_SLACK * self.incumbent.cost:
                return
            step = base.evaluated_step(self.evaluator, phase, self.arcs.made(self.arcs.tip(entry), row))
            left -= step.candidate is not None
            yield self.incumbent.improved(step)

    def further_steps(self) -> Iterator[base.Step]:
        """Look along the motions, the cheapest first; each motion is an iteration."""
        number, parts = self.share
        ordered = base.different(self.atlas.deployments, self.clear)[number::parts]
        for iteration, entry in enumerate(ordered.tolist(), start=1):
            yield self.incumbent.improved(replace(self._shifted(int(entry)), iteration=iteration))

    def _shifted(self, entry: int) -> base.Step:
        """Return the best deployment from tips along the motion to that of an entry."""
        phase, tubes = "looking along the motion of the scope", self.task.system.tubes
        first = self.arcs.aim(np.array([entry]))[0][0]
        tip, best = self.arcs.tip(entry), first
        for shifts_mm in ROWS_MM:
            row = self.evaluator.tip_rows.along(tip, shifts_mm)
            starts = aim_starts(tubes, best[kernel.JOINTS :], len(shifts_mm))
            if starts is None:
                break
            rows, why = self.arcs.aim_from(row.tips, row.proved, starts)
            self.blocked.update(self.arcs.reasons(why))
            order = _cheapest_first(rows)
            if len(order) and rows[order[0], kernel.COST] < best[kernel.COST]:
                best, tip = rows[order[0]], self.evaluator.tip_rows.tip(row, int(order[0]))
        if best is first or best[kernel.COST] > base.ESTIMATE_SLACK * self.incumbent.cost:
            return base.Step(iteration=0, phase=phase)
        return base.evaluated_step(self.evaluator, phase, self.arcs.made(tip, best))

"""The numbers of the refinement's program for one candidate."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from anatomy.base.typed import Float
from anatomy.structures import obstacle_bits
from lungaccess.planning.refinement import boxes as fields
from lungaccess.planning.refinement import layout
from lungaccess.plans.candidate import Candidate, TipRows
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.problem.task import Task
from stages.needle import ArcPath, arc_transform, bend_direction
from stages.scope import ScopeTip, evenly
from stages.tube import TubeShape, design_arrays, longest_mm
from stages.tube import kernels as index

PROBE = 1e-6
"""Step of the central differences in scaled variables: their error is then some 1e-10."""
LENGTH_SCALE_MM = 5.0
"""What a mm of length counts against a share of the greatest curvature where an aim is corrected."""


def carried(frame: Float, length_mm: float, kx: float, ky: float) -> Float:
    """Return a frame (4, 4) carried along an arc without roll; `kx`, `ky` in 1/mm towards its x and y."""
    roll = math.atan2(ky, kx)
    back = arc_transform(0.0, -roll, 0.0)
    return np.asarray(frame @ arc_transform(length_mm, roll, math.hypot(kx, ky)) @ back)


def rows_of(path: ArcPath) -> Float:
    """Return length in mm and curvature towards x and y in 1/mm of each arc, `(A, 3)`."""
    carried_frame = path.lps_from_start
    rows = []
    for frame, (length, roll, curvature) in zip(path.frames(), path.arcs.tolist(), strict=False):
        towards = curvature * bend_direction(frame, roll)
        kx, ky = (float(towards @ carried_frame[:3, axis]) for axis in (0, 1))
        rows.append((length, kx, ky))
        carried_frame = carried(carried_frame, length, kx, ky)
    return np.array(rows)


def path_of(lps_from_start: Float, rows: Float) -> ArcPath:
    """Return the path of such rows."""
    rolls = np.diff(np.arctan2(rows[:, 2], rows[:, 1]), prepend=0.0)
    rolls = np.remainder(rolls + math.pi, 2 * math.pi) - math.pi
    return ArcPath(
        lps_from_start=lps_from_start,
        arcs=np.stack([rows[:, 0], rolls, np.hypot(rows[:, 1], rows[:, 2])], axis=1),
    )


def split(rows: Float, arcs: int, first_mm: float) -> Float:
    """Halve the longest arcs until there are `arcs`; the first stays longer than `first_mm`."""
    out = [row.copy() for row in rows]
    while len(out) < arcs:
        spare = [row[0] - (first_mm if n == 0 else 0.0) for n, row in enumerate(out)]
        longest = int(np.argmax(spare))
        behind = out[longest].copy()
        behind[0] = 0.5 * spare[longest]
        out[longest][0] -= behind[0]
        out.insert(longest + 1, behind)
    return np.array(out)


def aimed(lps_from_start: Float, rows: Float, target: Float, max_curvature_per_mm: float) -> Float | None:
    """Return the rows changed as little as needed to end at the target; None if that fails.

    Gauss-Newton steps of least norm, lengths counted by LENGTH_SCALE_MM, curvatures as shares of the
    greatest.
    """
    scale = np.tile([LENGTH_SCALE_MM, max_curvature_per_mm, max_curvature_per_mm], len(rows))
    values = rows.ravel() / scale
    # Newton steps converge quadratically: what has not arrived after these does not.
    for _ in range(6):
        miss = target - _end(lps_from_start, values * scale)
        # Largest distance of an aimed path from the target: far below what a plan states, above rounding.
        if np.linalg.norm(miss) <= 1e-10:
            return np.asarray((values * scale).reshape(-1, 3), dtype=np.float64)
        jacobian = np.zeros((3, len(values)))
        for n in range(len(values)):
            step = np.zeros(len(values))
            step[n] = PROBE
            ends = [_end(lps_from_start, (values + sign * step) * scale) for sign in (1.0, -1.0)]
            jacobian[:, n] = (ends[0] - ends[1]) / (2.0 * PROBE)
        values = values + np.linalg.lstsq(jacobian, miss, rcond=None)[0]
    return None


def _end(lps_from_start: Float, numbers: Float) -> Float:
    frame = lps_from_start
    for length, kx, ky in numbers.reshape(-1, 3).tolist():
        frame = carried(frame, length, kx, ky)
    return np.asarray(frame[:3, 3])


ARC_COUNTS = (3, 5, 8)
"""A program is built for each; shorter paths are split."""
NEEDLE_MARGIN_MM = 10.0
TUBE_MARGIN_MM = 8.0
"""The boxes of field values reach so far beyond needle and tubes of the candidate: so far these may move."""
MAX_TURN_RAD = 1.2
"""The tubes turn by no more than this, so that they stay within the boxes."""
SHORTEST_ARC_MM = 1.0
"""Shorter arcs are not made: the direction of their curvature would hardly matter."""
NEEDLE_SLACK_MM = 0.02
CURVATURE_SLACK = 1e-3
ANGLE_SLACK_RAD = math.radians(2.0)
"""The program keeps so far from the limits of curvature and wall angle, for the same reason."""


class Weights(NamedTuple):
    """The weights of a program: of 1 / clearance, length and cost map along the needle, and along the tubes.

    That of the tubes counts for each mm of their width, for 1 / clearance and the cost map alike.
    """

    clear: float
    length: float
    mapped: float
    tubes: float = 0.0


def program_weights(task: Task) -> Weights | None:
    """Return the weights in the program of a task.

    The program has no sum over voxels.  Where nothing else is weighed, the map's line integral stands for
    it.  Where it is one cost of several, the program cannot express the objective; where only a map is
    weighed and there is none, there is nothing to improve: then None is returned.
    """
    weighed = task.objective
    if weighed.voxel_sum > 0.0:
        if len(weighed.weighed) > 1:
            return None
        weights = Weights(0.0, 0.0, weighed.voxel_sum)
    else:
        by_width = weighed.tissue * task.system.require_needle("The joint refinement").diameter_mm
        weights = Weights(
            weighed.inverse_clearance + by_width, weighed.length, weighed.cost_map + by_width, weighed.tissue
        )
    if task.lung.cost is None:
        weights = weights._replace(mapped=0.0)
    return weights if any(weights) else None


class Problem:
    """The program's numbers for one candidate, which has at most as many arcs as the last of ARC_COUNTS.

    `start` is the candidate as variables.
    """

    def __init__(self, evaluator: CandidateEvaluator, candidate: Candidate, weights: Weights) -> None:
        self.task = evaluator.task
        self._candidate, self._weights = candidate, weights
        self._needle = needle = self.task.system.require_needle("The joint refinement")
        deployment = candidate.deployment
        rows = rows_of(candidate.path)
        arcs = next(count for count in ARC_COUNTS if count >= len(rows))
        self._exempt_mm = min(needle.exit_exemption_mm, 0.8 * candidate.path.length_mm)
        rows = split(rows, arcs, self._exempt_mm)
        self.design = design = design_arrays(self.task.system.tubes)
        self.model = self._model(deployment.shape)
        self.layout = layout.Layout(
            arcs=arcs,
            with_map=weights.mapped > 0.0,
            weighs_tubes=weights.tubes > 0.0,
            tubes=len(design.radii),
            turned=int(design.turned.sum()),
        )
        self.axis = LocalAxis(evaluator.tip_rows, candidate.tip)
        tubes = [deployment.rotation_rad, deployment.outer_mm, deployment.inner_mm, deployment.exit_mm]
        bends = rows[:, 1:].T / needle.max_curvature_per_mm
        further = np.zeros(self.layout.n_variables - 5 - 3 * arcs)
        self.start = np.concatenate([[0.0], tubes, rows[:, 0], *bends, further])
        self.start[self.layout.joints] = self.model.centre
        self.boxes = self._cut_boxes()
        lower, upper = self._variable_bounds()
        least, most = self._constraint_bounds()
        self.numbers = layout.Numbers(
            parameters=self._parameters(self.axis.points, self.axis.tangents, self.model),
            lower=lower,
            upper=upper,
            least=least,
            most=most,
        )

    def eased(self, values: Float) -> layout.Numbers:
        """Return the numbers with the clearances of the start, `values` (m,), allowed where they are less.

        So the program starts from where it may be, though its fields are not exact.
        """
        least = self.numbers.least.copy()
        # Constraints on field values, which the candidate may break in the program though it is proved.
        for name in ("zone", "needle", "tube", "wall", "slope"):
            place = self.layout.constraints[name]
            # The candidate lies so far inside the eased constraints, so that it is a strictly feasible start.
            least[place] = np.minimum(least[place], values[place] - 1e-4)
        return replace(self.numbers, least=least)

    def for_needle(self, x: Float, tip: ScopeTip, shape: TubeShape) -> layout.Numbers:
        """Return the numbers for the needle alone, from the tubes of `x` and a tip that stay as they are."""
        rows, numbers = self.layout.constraints, self.numbers
        lower, upper = numbers.lower.copy(), numbers.upper.copy()
        least, most = numbers.least.copy(), numbers.most.copy()
        tubes = np.r_[: self.layout.variables["lengths"].start, self.layout.joints]
        lower[tubes] = upper[tubes] = x[tubes]
        for name in ("order", "in_tissue", "exit", "slope", "tube", "wall", "beside", "middle"):
            if name in rows:
                least[rows[name]], most[rows[name]] = -np.inf, np.inf
        parameters = self._parameters(*_one_tip(tip), self._model(shape, constant=True))
        return layout.Numbers(parameters=parameters, lower=lower, upper=upper, least=least, most=most)

    def _model(self, shape: TubeShape, *, constant: bool = False) -> layout.ShapeModel:
        return layout.ShapeModel(self.design, shape, self.longest_mm, constant=constant)

    @property
    def sideways(self) -> Float:
        """The +x of the candidate's tip, from which rotations count."""
        return np.asarray(self._candidate.tip.lps_from_scope_tip[:3, 0])

    @property
    def longest_mm(self) -> float:
        """The greatest insertion of the shapes of the design, or that of the candidate."""
        return max(longest_mm(self.task.system.tubes), self._candidate.deployment.inner_mm)

    def _cut_boxes(self) -> tuple[fields.FieldBox, ...]:
        lung, fissures = self.task.lung, self.task.with_fissures
        deployment, margin = self._candidate.deployment, self.task.system.margins.total_mm
        bits = obstacle_bits(fissures)
        leaves = deployment.exit_mm
        outside = self._tube_points(np.linspace(leaves, deployment.inner_mm, 12))
        inside = self._tube_points(np.linspace(max(leaves - layout.WALL_CONTACT_MM, 0.0), leaves, 6))
        needle, lengths = self._candidate.path.sample(1.0)
        near = np.concatenate([outside, needle[lengths <= self._exempt_mm]])
        costed = np.concatenate([needle, outside]) if self.layout.weighs_tubes else needle
        boxes = [
            fields.clearance_box(lung, costed, NEEDLE_MARGIN_MM, with_fissures=fissures),
            fields.spared_box(lung, near, TUBE_MARGIN_MM, bits=bits, branch=deployment.branch),
            fields.wall_box(lung, inside, TUBE_MARGIN_MM, with_fissures=fissures, kept_mm=margin),
            fields.lumen_box(lung, inside[-1:], TUBE_MARGIN_MM),
        ]
        if self.layout.with_map and lung.cost is not None:
            boxes.append(fields.map_box(lung.cost, costed, NEEDLE_MARGIN_MM))
        return tuple(boxes)

    def _tube_points(self, arc_lengths: Float) -> Float:
        return self._candidate.deployment.points(self._candidate.tip.lps_from_scope_tip, arc_lengths)

    def _lumen_at_exit(self) -> tuple[float, float]:
        """Return the share of lumen at the exit, and its greatest slope there, per mm."""
        box = self.boxes[fields.LUMEN_SHARE]
        exit_point = self._tube_points(np.array([self._candidate.deployment.exit_mm]))
        places = exit_point + layout.SLOPE_MM * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)])
        lattice = places @ box.lattice_from_lps[:, :3].T + box.lattice_from_lps[:, 3]
        values = box.values.reshape(box.shape, order="F")
        share = ndimage.map_coordinates(values, lattice.T, order=3, prefilter=False, mode="nearest")
        return float(share[0]), float(np.linalg.norm(share[1:4] - share[4:]) / (2.0 * layout.SLOPE_MM))

    def _parameters(self, points: Float, tangents: Float, model: layout.ShapeModel) -> Float:
        """Return the parameters for an axis of the scope's tip given by coefficients and a model."""
        tubes = self.task.system.tubes
        steps = -np.diff(
            [each.radius_mm for each in (tubes.outermost, tubes.middle or tubes.inner, tubes.inner)]
        )
        clear, length, mapped, by_width = self._weights
        values: dict[str, object] = {
            "axis_points": points,
            "axis_tangents": tangents,
            "sideways": self.sideways,
            "target": self.task.target.lps_mm,
            "max_curvature_per_mm": self._needle.max_curvature_per_mm,
            "outer_radius_step_mm": steps[0],
            "middle_radius_step_mm": steps[1],
            "model_centre": model.centre,
            "model": model.matrix,
            "exempt_mm": self._exempt_mm,
            "weigh_clear": clear,
            "weigh_length": length,
            "weigh_map": mapped,
            "weigh_tubes": by_width,
            "inner_width_mm": tubes.inner.outer_diameter_mm,
            "wall_mm": self._candidate.deployment.wall_run_mm,
        }
        for n, box in enumerate(self.boxes):
            values[f"affine{n}"] = box.lattice_from_lps.T
            values[f"shape{n}"] = box.shape
        out = np.zeros(self.layout.n_parameters)
        for name, place in self.layout.parameters.items():
            out[place] = np.asarray(values[name], dtype=np.float64).ravel()
        return out

    def _variable_bounds(self) -> tuple[Float, Float]:
        at = self.layout.variables
        lower, upper = np.full(self.layout.n_variables, -1.0), np.full(self.layout.n_variables, 1.0)
        rotation = self._candidate.deployment.rotation_rad
        bounds = {
            "site": (self.axis.low_mm, self.axis.high_mm),
            "rotation": (rotation - MAX_TURN_RAD, rotation + MAX_TURN_RAD),
            "outer": (0.0, self.longest_mm),
            "inner": (0.0, self.longest_mm),
            "exit": (0.0, self.longest_mm),
            "lengths": (SHORTEST_ARC_MM, self._needle.max_length_mm),
        }
        for name, (low, high) in bounds.items():
            lower[at[name]], upper[at[name]] = low, high
        lower[at["lengths"].start] += self._exempt_mm
        joints = self.layout.joints
        lower[joints], upper[joints] = self.model.lower, self.model.upper
        inserted = joints[: self.layout.tubes]
        lower[inserted] = np.maximum(lower[inserted], 0.0)
        upper[inserted] = np.minimum(upper[inserted], self.longest_mm)
        return lower, upper

    def _constraint_bounds(self) -> tuple[Float, Float]:
        system, deployment = self.task.system, self._candidate.deployment
        needle, tubes, margin = self._needle, system.tubes, system.margins.total_mm
        level, slope = self._lumen_at_exit()
        # The program keeps so far from the limit of the sweep, which its model knows to a few hundredths.
        allowed = max(tubes.max_lateral_sweep_mm - 0.02, deployment.lateral_sweep_mm)
        # The program demands so much more clearance, for what lies between samples and between lattice
        # points.
        thick = tubes.inner.radius_mm + 0.1
        clear = needle.radius_mm + margin + NEEDLE_SLACK_MM
        steep = math.sin(math.radians(tubes.min_wall_angle_deg) + ANGLE_SLACK_RAD)
        bounds = {
            "end": (0.0, 0.0),
            "curvature": (-np.inf, (1.0 - CURVATURE_SLACK) ** 2),
            "length": (-np.inf, needle.max_length_mm),
            "turn": (-np.inf, math.radians(needle.max_accumulated_turn_deg)),
            "cosine": (math.cos(math.radians(needle.max_angle_from_start_deg)), np.inf),
            "order": (0.0, tubes.max_inner_protrusion_mm),
            "in_tissue": (index.WALL_ZONE_MM + NEEDLE_SLACK_MM, np.inf),
            "exit": (level, level),
            "slope": (slope * steep, np.inf),
            "zone": (clear, np.inf),
            "needle": (clear, np.inf),
            "tube": (thick + margin, np.inf),
            "wall": (thick, np.inf),
            "beside": (-np.inf, allowed + deployment.shape.arc_error_mm),
            "middle": (0.0, np.inf),
        }
        least, most = np.zeros(self.layout.n_constraints), np.zeros(self.layout.n_constraints)
        for name, place in self.layout.constraints.items():
            least[place], most[place] = bounds[name]
        return least, most


class LocalAxis:
    """The way of a scope's tip as its base goes on or stops earlier, AXIS_SCALE_MM each way.

    Attributes:
        low_mm, high_mm: How far the base can be moved, back (negative) and on, with a proved motion
            everywhere between.
        points, tangents ((3, AXIS_DEGREE + 1) float64): Coefficients of the tip's point and direction, LPS
            mm, in powers of the shift by AXIS_SCALE_MM.
    """

    def __init__(self, rows: TipRows, tip: ScopeTip) -> None:
        self._rows, self._tip = rows, tip
        # Step in which poses of the tip are proved and fitted; a voxel is several times as large.
        shifts = evenly(0.125, layout.AXIS_SCALE_MM)
        row = rows.along(tip, shifts)
        home = len(shifts) // 2
        refused = np.flatnonzero(~row.proved)
        low = int(refused[refused < home].max(initial=-1)) + 1
        high = int(refused[refused > home].min(initial=len(shifts))) - 1
        self.low_mm, self.high_mm = float(shifts[low]), float(shifts[high])
        self.points, self.tangents = _fit(shifts[low : high + 1], row.tips[low : high + 1], home - low)

    def tip(self, shift_mm: float) -> ScopeTip | None:
        """Return the tip with the base moved by `shift_mm`, None if that motion is not proved."""
        return self._rows.moved(self._tip, min(max(shift_mm, self.low_mm), self.high_mm))


def _one_tip(tip: ScopeTip) -> tuple[Float, Float]:
    """Return the coefficients of an axis that is one tip."""
    points, tangents = np.zeros((3, layout.AXIS_DEGREE + 1)), np.zeros((3, layout.AXIS_DEGREE + 1))
    points[:, 0], tangents[:, 0] = tip.lps_from_scope_tip[:3, 3], tip.lps_from_scope_tip[:3, 2]
    return points, tangents


def _fit(shifts: Float, tips: Float, home: int) -> tuple[Float, Float]:
    """Return the coefficients `(3, AXIS_DEGREE + 1)` of point and tangent; exact at no shift."""
    powers = (shifts[:, None] / layout.AXIS_SCALE_MM) ** np.arange(1, layout.AXIS_DEGREE + 1)
    fitted = []
    for values in (tips[:, :3], tips[:, 3:6]):
        rest = np.linalg.lstsq(powers, values - values[home], rcond=1e-9)[0]
        fitted.append(np.vstack([values[home], rest]).T)
    return fitted[0], fitted[1]

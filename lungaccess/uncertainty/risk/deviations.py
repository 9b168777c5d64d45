"""Deviations from a plan, the deviated devices as arcs, and the random numbers that deviations are made of.

Numbers are drawn once and scaled to any error model: the same luck for every plan and every model.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import Any

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.problem import errors
from lungaccess.uncertainty.risk.kernels import deviation as kernel
from lungaccess.uncertainty.risk.kernels.chain import TUBE_PIECES, Devices
from lungaccess.uncertainty.risk.kernels.outcomes import N_START, Judging, find_pieces, find_starts
from lungaccess.uncertainty.risk.patient_errors import PatientMotion, phase
from stages.tube import ConcentricTubes, Neighbourhood, pieces_of_arcs

COLUMNS = (
    "scope_mm",
    "tilt_rad",
    "rotation_rad",
    "factor",
    "target_mm",
    "border_mm",
    "insertion_mm",
    "roll_rad",
    "stop_mm",
)
"""The fields of `Deviations` that become the row of a draw, in the order of `kernels.chain`."""


@frozen_record
class Deviations:
    """N sets of errors of a plan whose needle has A arcs, 0 where there is none.

    Args:
        scope_mm ((N, 3) float64, LPS mm): Shift of the scope tip.
        tilt_rad ((N, 2) float64): Rotation vector of the scope tip's tilt, along +x and +y of its frame.
        rotation_rad ((N,) float64): Added to the rotation of all tubes; it leaves the roll of the needle
            where it is.
        relative_rad ((N, n) float64): Added to the rotation of each of n tubes that are not planar, the
            outermost first; n is 0 for planar.
        insertion_mm ((N, 2 or n) float64): Added to the insertions of outer and inner tube, or of n tubes
            that are not planar.
        factor ((N,) float64): Multiplies the curvature of all arcs.
        roll_rad, stop_mm ((N, A) float64): Added to the needle's angle in each arc, and to its insertion
            where the arc ends.
        target_mm ((N, 3) float64, LPS mm): Shift of the target.
        border_mm ((N,) float64): How far all vessels reach out of their masks.
        further (tuple of Deviations): Those of the passes after the first.
    """

    scope_mm: Float
    tilt_rad: Float
    rotation_rad: Float
    relative_rad: Float
    insertion_mm: Float
    factor: Float
    roll_rad: Float
    stop_mm: Float
    target_mm: Float
    border_mm: Float
    further: Any = ()

    @property
    def count(self) -> int:
        """Number of sets, N."""
        return len(self.factor)


def no_deviations(count: int, n_arcs: int, n_twisted: int = 0) -> dict[str, Float]:
    """Return the fields of `Deviations` for so many sets without error; `n_twisted` tubes are not planar."""
    return {
        "scope_mm": np.zeros((count, 3)),
        "tilt_rad": np.zeros((count, 2)),
        "rotation_rad": np.zeros(count),
        "relative_rad": np.zeros((count, n_twisted)),
        "insertion_mm": np.zeros((count, n_twisted or 2)),
        "factor": np.ones(count),
        "roll_rad": np.zeros((count, n_arcs)),
        "stop_mm": np.zeros((count, n_arcs)),
        "target_mm": np.zeros((count, 3)),
        "border_mm": np.zeros(count),
    }


FIELD_OF: dict[str, str] = {
    "scope_position": "scope_mm",
    "scope_direction": "tilt_rad",
    "tube_rotation": "rotation_rad",
    "tube_insertion": "insertion_mm",
    "needle_roll": "roll_rad",
    "needle_insertion": "stop_mm",
    "target_position": "target_mm",
    errors.VESSEL_BORDER: "border_mm",
}
"""The field of `Deviations` that holds each kind of error."""


def deviated_starts(plan: Plan, lung: Lung, deviations: Deviations) -> Float:
    """Return point, tangent and +x axis `(N, 9)` of the deviated scope tips, LPS mm.

    The scope tip stands where the lumen is as deep as the scope's radius, or as deep as at the planned tip if
    that is less: a shift ends where it would come out of that.
    """
    devices, rows, _which = DeviatedPlan(plan).kernel_inputs(deviations)
    starts = np.zeros((deviations.count, N_START))
    find_starts(devices, rows, judging(plan, lung), starts)
    return starts


def deviated_pieces(plan: Plan, deviations: Deviations) -> Float:
    """Return the arcs `(N, T + A, 4)` of tubes and needle, as `kernels.deviation` makes them.

    Planar tubes have T = 4 arcs.  The radius of the tubes includes the sideways sweep of the plan.  No tube
    goes back behind the scope tip, nor one behind that around it, nor the needle behind the end of an arc;
    and nothing goes farther than the device can.
    """
    devices, rows, which = DeviatedPlan(plan).kernel_inputs(deviations)
    pieces = np.zeros((deviations.count, devices.n_tube + devices.needle.shape[0], kernel.N_PIECE))
    find_pieces(devices, rows, which, pieces)
    return pieces


def judging(plan: Plan, lung: Lung) -> Judging:
    """Return what decides about a deviated plan in its lung."""
    depth = lung.lumen_depth
    planned = float(depth.lower_bound_mm(np.asarray(plan.scope.lps_from_scope_tip)[:3, 3])[0])
    # The planned tip itself stands in the lumen, however its depth is rounded.
    return Judging(
        depth.corners,
        depth.geometry,
        min(plan.system.scope.radius_mm, planned) - 1e-9,
        lung.tree.mediastinal,
        float(plan.exemption.needle_length_mm),
    )


class DeviatedPlan:
    """A plan as kernels take it that deviate from it."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._frame = np.array(plan.scope.lps_from_scope_tip)
        arcs = () if plan.needle is None else plan.needle.arcs
        self._needle = np.zeros((len(arcs), kernel.N_PIECE))
        self._needle[:, 0] = np.cumsum([arc.length_mm for arc in arcs])
        self._needle[:, 1] = np.cumsum([arc.roll_rad for arc in arcs])
        self._needle[:, 2] = [arc.curvature_per_mm for arc in arcs]
        self._needle[:, 3] = plan.system.track_radius_mm
        self._tubes, tubes, tube = np.zeros(0), plan.system.tubes, plan.tube
        if tubes.planar:
            inserted = tube.outer_insertion_mm, tube.inner_insertion_mm
            self._tubes = tube_values(tubes, tube.rotation_rad, *inserted, tube.lateral_sweep_mm)

    def kernel_inputs(self, deviations: Deviations) -> tuple[Devices, Float, Int]:
        """Return the devices, the errors in rows, and the number of each draw's shape; see `Devices`."""
        which, n_tube = np.zeros(deviations.count, dtype=np.int64), TUBE_PIECES
        shapes, rolled = np.zeros((0, 0, kernel.N_PIECE)), np.zeros(0)
        if not self.plan.system.tubes.planar:
            shapes, rolled, which = twisted_shapes(
                self.plan, deviations.insertion_mm, deviations.relative_rad
            )
            n_tube = shapes.shape[1]
        needle = self.plan.system.needle
        longest = 0.0 if needle is None else needle.max_length_mm
        devices = Devices(self._frame, self._tubes, self._needle, shapes, rolled, n_tube, longest)
        return devices, in_rows(deviations), which


def in_rows(deviations: Deviations) -> Float:
    """Return deviations as the kernels take them, `(N, E)`."""
    return np.column_stack([getattr(deviations, name) for name in COLUMNS])


def tube_values(
    tubes: ConcentricTubes, rotation_rad: float, outer_mm: float, inner_mm: float, sweep_mm: float = 0.0
) -> Float:
    """Return what a kernel has to know of planar tubes `(11,)`, see `chain.Devices`."""
    longest = tubes.max_extension_mm
    return np.array(
        [
            rotation_rad,
            outer_mm,
            inner_mm,
            longest,
            tubes.max_inner_protrusion_mm,
            tubes.inner.curved_length_mm,
            tubes.overlap_curvature_per_mm,
            tubes.free_curvature_per_mm,
            tubes.outermost.radius_mm + sweep_mm,
            tubes.inner.radius_mm + sweep_mm,
            longest if tubes.outer is None else min(longest, tubes.outer.length_mm),
        ]
    )


def twisted_shapes(plan: Plan, insertion_mm: Float, relative_rad: Float) -> tuple[Float, Float, Int]:
    """Return the shapes that deviated tubes take, and which of them each deviation has.

    The deviations are those of `Deviations`.

    Each distinct deviation is solved once.  No tube goes farther than the device can: not behind the scope
    tip, nor behind one around it, nor so far that its rear end passes that of one around it.  Where tubes
    snap they have no length, so that they stay in the airway.

    Returns:
        - shapes ((S, T, 4) float64) - As the first pieces of a chain, see
          `lungaccess.uncertainty.risk.kernels.deviation`.
        - rolled_rad ((S,) float64) - By how much too far the end of the tubes is rolled.
        - which ((N,) int64)
    """
    tube, tubes = plan.tube, plan.system.tubes
    turned, inserted = np.array(tube.rotations_rad(tubes)), np.array(tube.insertions_mm(tubes))
    lengths = np.array([each.length_mm for _name, each in tubes.named])
    n = len(inserted)
    out = _within_limits(inserted + insertion_mm, lengths, tubes.max_extension_mm)
    joints, which = np.unique(np.hstack([out, relative_rad]), axis=0, return_inverse=True)
    around = Neighbourhood.of(
        tubes.nested, inserted[::-1], turned[::-1] - tube.rotation_rad, needle=tubes.needle_shaft
    )
    shapes = []
    for each in joints:
        lengths_mm, angles = each[:n], turned - tube.rotation_rad + each[n:]
        found = around.at(lengths_mm[::-1], angles[::-1]) if lengths_mm[-1] > 0.0 else None
        shapes.append(np.zeros((0, 4)) if found is None else np.asarray(found.arcs))
    pieces = np.zeros((len(shapes), max(1, *(len(arcs) for arcs in shapes)), kernel.N_PIECE))
    rolled = np.zeros(len(shapes))
    for number, arcs in enumerate(shapes):
        kept = arcs[arcs[:, 0] > 0.0]
        laid = pieces_of_arcs(kept, tube.rotation_rad)
        pieces[number, : len(laid), [kernel.LENGTH, kernel.ROLL, kernel.CURVATURE]] = laid.T
        pieces[number, : len(laid), kernel.RADIUS] = kept[-len(laid) :, 3] + tube.clearance_loss_mm
        rolled[number] = laid[:, 1].sum() - tube.rotation_rad if len(laid) else 0.0
    return pieces, rolled, which.ravel()


def _within_limits(out_mm: Float, lengths_mm: Float, most_mm: float) -> Float:
    """Return insertions `(N, n)`, the outermost first, as the device can have them."""
    kept = np.clip(out_mm, 0.0, np.minimum(lengths_mm, most_mm))
    kept = np.maximum.accumulate(kept, axis=1)
    ahead = np.concatenate([[np.inf], np.diff(lengths_mm)])
    for tube in range(1, kept.shape[1]):
        kept[:, tube] = np.minimum(kept[:, tube], kept[:, tube - 1] + ahead[tube])
    return kept


PATIENT, ATTEMPT = 0, 1
"""Levels at which errors are drawn."""
OF_PASS = 10
"""Streams of the levels of one pass and the next are so far apart."""
DOWN = np.array([0.0, 0.0, -1.0])
"""Towards the feet, LPS."""


class Draws:
    """Standard normal numbers for N attempts, made where a model needs them.

    Each kind of error has two streams of its own, one number for each patient and one for each attempt, so
    that neither the model nor what was asked before changes a number.  Errors of the needle that are drawn
    for each patient are the same in all its arcs.  SettingsError is raised if there are to be none.

    Args:
        count, n_arcs: N and A of `Deviations`.
        n_twisted: See `no_deviations`.
        stretch: By how much of the patient's motion by breathing the target moves farther than the scope's
            tip, where the patient's own motion is not known.
        attempt: Number of the attempt on the same N patients: what is drawn for each attempt has other
            numbers.
        further: Of each pass after the first the number of its arcs, and the pass whose numbers it has by the
            kinds of which it has not those of the first.
        lps_from_scope_tip ((4, 4) float64): The axes along which a bias of the scope's position is stated; by
            default those of LPS.
    """

    def __init__(
        self,
        count: int,
        n_arcs: int,
        seed: int,
        n_twisted: int = 0,
        *,
        stretch: float = 0.0,
        motion: PatientMotion | None = None,
        attempt: int = 0,
        further: Sequence[tuple[int, Mapping[str, int]]] = (),
        lps_from_scope_tip: Float | None = None,
    ) -> None:
        if count < 1:
            raise SettingsError(
                f"The number of samples is {count}",
                expected="at least 1",
                remedy="Choose a count such as 10000",
            )
        self.count = count
        self._seed, self._n_arcs, self._n_twisted = seed, n_arcs, n_twisted
        self._stretch, self._motion, self._attempt = stretch, motion, attempt
        self._axes = np.eye(3) if lps_from_scope_tip is None else np.asarray(lps_from_scope_tip)[:3, :3]
        self._made: dict[tuple[str, int], Float] = {}
        self._further, self._pass_of = tuple(further), dict[str, int]()

    def deviations(self, model: errors.ErrorModel) -> Deviations:
        """Return the deviations of all attempts under a model."""
        values = no_deviations(self.count, self._n_arcs, self._n_twisted)
        for kind, field in FIELD_OF.items():
            # Each tube that is not planar is held by itself: none turns with another.
            own = "relative_rad" if kind == "tube_rotation" and self._n_twisted else field
            term = model.term(kind)
            if (term.size or term.bias) and values[own].size:
                error = self._error(kind, values[own].shape, term.distribution, term.patient, term.attempt)
                if term.bias:
                    bias = np.array(term.bias)
                    error = error + (self._axes @ bias if kind == "scope_position" else bias)
                values[own] = np.radians(error) if errors.UNITS[kind] == "deg" else error
        values["factor"] = self._factors(model)
        if model.breathing.size and (self._motion or self._stretch):
            values["target_mm"] = values["target_mm"] + self._breathed_mm(model)
        made = Deviations(**values)
        return replace(made, further=tuple(self.of_pass(*each).deviations(model) for each in self._further))

    def of_pass(self, n_arcs: int, pass_of: Mapping[str, int]) -> "Draws":
        """Return the draws of a further pass; numbers are kept with those of all others."""
        own = copy(self)
        own._n_arcs, own._pass_of, own._further = n_arcs, dict(pass_of), ()
        return own

    def numbers(self, model: errors.ErrorModel) -> dict[tuple[str, int], Float]:
        """Return the standard normal numbers `(N, ...)` that a model uses, by kind and level."""
        own = self.with_numbers({})
        own.deviations(model)
        return own._made

    def with_numbers(self, made: dict[tuple[str, int], Float]) -> "Draws":
        """Return draws with other numbers, by kind and level as `numbers` returns them."""
        own = copy(self)
        own._made = made
        return own

    def _error(
        self, kind: str, shape: tuple[int, ...], distribution: str, patient: float, attempt: float
    ) -> Float:
        if distribution == errors.RESTING:
            raise SettingsError(
                f"Errors of {kind} are about the resting shaft of a plan, which is not known here",
                expected="an error model of `lungaccess.uncertainty.risk.patient_errors.model_for`",
            )
        # One number for all arcs of a patient: what is wrong with tissue or drive stays wrong.
        shared = (len(shape) > 1) and kind.startswith("needle")
        total = np.zeros(shape)
        for level, size in ((PATIENT, patient), (ATTEMPT, attempt)):
            if size:
                drawn = self._normal(kind, level, (shape[0], 1) if shared and level == PATIENT else shape)
                total += size * (drawn if distribution != errors.BOUNDED else 2.0 * _uniform(drawn) - 1.0)
        return total

    def _factors(self, model: errors.ErrorModel) -> Float:
        """Return the factors of the curvature, `(N,)`."""
        term = model.needle_curvature
        error = self._error(errors.CURVATURE, (self.count,), term.distribution, term.patient, term.attempt)
        factors = term.median * np.exp(error)
        if term.straight_share:
            # Stream of the numbers that decide which needles go straight.
            straight = _uniform(self._normal(errors.CURVATURE, 2, (self.count,))) < term.straight_share
            factors[straight] = 0.0
        return factors

    def _breathed_mm(self, model: errors.ErrorModel) -> Float:
        """Return how the target moves away from the scope, `(N, 3)`."""
        term, shape = model.breathing, (self.count,)
        motion_mm = term.median_mm * np.exp(term.patient_ln * self._normal(errors.BREATHING, PATIENT, shape))
        luck = _uniform(self._normal(errors.BREATHING, ATTEMPT, shape))
        in_window = term.distribution == errors.IN_WINDOW
        if self._motion is not None and (self._motion.has_window or not in_window):
            return self._motion.shifts_mm(motion_mm, luck, in_window=in_window)
        if in_window:
            raise SettingsError(
                f"Errors of breathing are {errors.IN_WINDOW!r}, but no motion of the patient or no window is "
                "known",
                expected="a plan with a window of breathing",
                remedy="Give the patient a [motion], or write distribution = 'lognormal'",
            )
        return np.asarray((self._stretch * motion_mm * phase(luck))[:, None] * DOWN)

    def _normal(self, kind: str, level: int, shape: tuple[int, ...]) -> Float:
        """Return the numbers of a kind at a level, the same at each call."""
        level += OF_PASS * self._pass_of.get(kind, 0) * (level != PATIENT)
        if (kind, level) not in self._made:
            key = (list(errors.UNITS).index(kind), level, 0 if level == PATIENT else self._attempt)
            rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(self._seed, spawn_key=key)))
            # By columns: a further arc leaves the numbers of those before alone.
            columns = rng.standard_normal((*shape[1:], self.count))
            self._made[kind, level] = np.asarray(np.moveaxis(columns, -1, 0))
        return self._made[kind, level]


def _uniform(normal: Float) -> Float:
    """Return standard normal numbers as numbers uniform from 0 to 1."""
    from scipy.special import ndtr

    return np.asarray(ndtr(normal))

"""Random numbers drawn once and scaled to any error model: the same luck for every plan and every model."""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float
from lungaccess.problem.errors import BOUNDED, BREATHING, CURVATURE, IN_WINDOW, RESTING, UNITS, ErrorModel
from lungaccess.uncertainty.risk.breathing import PatientMotion, phase
from lungaccess.uncertainty.risk.deviations import FIELD_OF, Deviations, no_deviations

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
    for each patient are the same in all its arcs.

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

    Raises:
        SettingsError: If there are to be none.
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

    def deviations(self, model: ErrorModel) -> Deviations:
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
                values[own] = np.radians(error) if UNITS[kind] == "deg" else error
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

    def numbers(self, model: ErrorModel) -> dict[tuple[str, int], Float]:
        """Return the standard normal numbers `(N, ...)` that a model uses, by kind and level."""
        own = self._again()
        own.deviations(model)
        return own._made

    def with_numbers(self, made: dict[tuple[str, int], Float]) -> "Draws":
        """Return draws with other numbers, by kind and level as `numbers` returns them."""
        own = self._again()
        own._made = made
        return own

    def _again(self) -> "Draws":
        own = copy(self)
        own._made = {}
        return own

    def _error(
        self, kind: str, shape: tuple[int, ...], distribution: str, patient: float, attempt: float
    ) -> Float:
        if distribution == RESTING:
            raise SettingsError(
                f"Errors of {kind} are about the resting shaft of a plan, which is not known here",
                expected="an error model of `lungaccess.uncertainty.risk.breathing.model_for`",
            )
        # One number for all arcs of a patient: what is wrong with tissue or drive stays wrong.
        shared = (len(shape) > 1) and kind.startswith("needle")
        total = np.zeros(shape)
        for level, size in ((PATIENT, patient), (ATTEMPT, attempt)):
            if size:
                drawn = self._normal(kind, level, (shape[0], 1) if shared and level == PATIENT else shape)
                total += size * (drawn if distribution != BOUNDED else 2.0 * _uniform(drawn) - 1.0)
        return total

    def _factors(self, model: ErrorModel) -> Float:
        """Return the factors of the curvature, `(N,)`."""
        term = model.needle_curvature
        error = self._error(CURVATURE, (self.count,), term.distribution, term.patient, term.attempt)
        factors = term.median * np.exp(error)
        if term.straight_share:
            # Stream of the numbers that decide which needles go straight.
            straight = _uniform(self._normal(CURVATURE, 2, (self.count,))) < term.straight_share
            factors[straight] = 0.0
        return factors

    def _breathed_mm(self, model: ErrorModel) -> Float:
        """Return how the target moves away from the scope, `(N, 3)`."""
        term, shape = model.breathing, (self.count,)
        motion_mm = term.median_mm * np.exp(term.patient_ln * self._normal(BREATHING, PATIENT, shape))
        luck, in_window = _uniform(self._normal(BREATHING, ATTEMPT, shape)), term.distribution == IN_WINDOW
        if self._motion is not None and (self._motion.has_window or not in_window):
            return self._motion.shifts_mm(motion_mm, luck, in_window=in_window)
        if in_window:
            raise SettingsError(
                f"Errors of breathing are {IN_WINDOW!r}, but no motion of the patient or no window is known",
                expected="a plan with a window of breathing",
                remedy="Give the patient a [motion], or write distribution = 'lognormal'",
            )
        return np.asarray((self._stretch * motion_mm * phase(luck))[:, None] * DOWN)

    def _normal(self, kind: str, level: int, shape: tuple[int, ...]) -> Float:
        """Return the numbers of a kind at a level, the same at each call."""
        level += OF_PASS * self._pass_of.get(kind, 0) * (level != PATIENT)
        if (kind, level) not in self._made:
            attempt = 0 if level == PATIENT else self._attempt
            key = (list(UNITS).index(kind), level, attempt)
            rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(self._seed, spawn_key=key)))
            # By columns: a further arc leaves the numbers of those before alone.
            columns = rng.standard_normal((*shape[1:], self.count))
            self._made[kind, level] = np.asarray(np.moveaxis(columns, -1, 0))
        return self._made[kind, level]


def _uniform(normal: Float) -> Float:
    """Return standard normal numbers as numbers uniform from 0 to 1."""
    from scipy.special import ndtr

    return np.asarray(ndtr(normal))

"""What really happens to a needle and its target, as opposed to what the planner assumes."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np

from anatomy.base.settings import quantity, settings
from anatomy.base.typed import Float
from stages.needle import Query, bend_direction, tilt

KNOT_MM = 1.0
"""Spacing of the random walks; between two knots they are linear."""

REFERENCE_MM = 100.0
"""Insertion after which walks and drift have the size that the settings state."""


@settings
class Errors:
    """How far the needle, the tracker and the target are from what the planner assumes.

    Numbers called `sd` and `noise` are standard deviations of normal distributions.

    Parameters
    ----------
    curvature_bias : float
        Mean relative error of the curvature; -0.1 is a needle that bends a tenth too little.
    curvature_sd : float
        Relative error of the curvature, constant in a run.
    curvature_wander_sd, curvature_wander_mm : float
        Relative error of the curvature along the way, and the insertion over which it is forgotten.
    roll_sd_deg : float
        Error of the bevel's direction each time the needle is rolled, replacing the one before.
    roll_wander_deg : float
        Further error of the direction after 100 mm, a random walk.
    pull_per_mm : float
        Curvature by which tissue pulls the needle towards a direction drawn for the run, 1/mm.
    measure_every_mm : float
        Insertion between two measurements.
    replan_every_mm : float
        Least insertion between two replans; measurements between them only correct where the tip is taken to
        be.
    latency_mm : float
        Insertion between a measurement and its use; what was commanded meanwhile is added to it.
    lost_share : float
        Share of the measurements that are lost.
    position_noise_mm, direction_noise_deg : float
        Error of the measured tip, for each coordinate and about each of two axes.
    target_drift_mm : float
        Steady motion of the target in 100 mm, in a direction drawn for the run.
    target_walk_mm : float
        Further motion of the target after 100 mm in each coordinate, a random walk.
    target_noise_mm : float
        Error of the measured target in each coordinate.

    Raises
    ------
    SettingsError
        If a value is not finite or outside its range.
    """

    curvature_bias: Annotated[
        float, quantity("mean relative error of the curvature", at_least=-0.9, at_most=1.0)
    ] = 0.0
    curvature_sd: Annotated[
        float, quantity("relative error of the curvature, constant in a run", at_least=0.0, at_most=0.5)
    ] = 0.0
    curvature_wander_sd: Annotated[
        float, quantity("relative error of the curvature along the way", at_least=0.0, at_most=0.5)
    ] = 0.0
    curvature_wander_mm: Annotated[
        float, quantity("insertion over which the curvature's error is forgotten", above=0.0, at_most=1000.0)
    ] = 20.0
    roll_sd_deg: Annotated[
        float, quantity("error of the bevel's direction at each roll", at_least=0.0, at_most=90.0)
    ] = 0.0
    roll_wander_deg: Annotated[
        float, quantity("random walk of the bevel's direction in 100 mm", at_least=0.0, at_most=180.0)
    ] = 0.0
    pull_per_mm: Annotated[
        float, quantity("curvature by which tissue pulls the needle aside", at_least=0.0, at_most=0.1)
    ] = 0.0
    measure_every_mm: Annotated[
        float, quantity("insertion between two measurements", above=0.0, at_most=500.0)
    ] = 5.0
    replan_every_mm: Annotated[
        float, quantity("least insertion between two replans", at_least=0.0, at_most=500.0)
    ] = 0.0
    latency_mm: Annotated[
        float, quantity("insertion between a measurement and its use", at_least=0.0, at_most=100.0)
    ] = 0.0
    lost_share: Annotated[
        float, quantity("share of the measurements that are lost", at_least=0.0, at_most=1.0)
    ] = 0.0
    position_noise_mm: Annotated[
        float, quantity("error of the measured tip in each coordinate", at_least=0.0, at_most=20.0)
    ] = 0.0
    direction_noise_deg: Annotated[
        float, quantity("error of the measured direction about each axis", at_least=0.0, at_most=45.0)
    ] = 0.0
    target_drift_mm: Annotated[
        float, quantity("steady motion of the target in 100 mm", at_least=0.0, at_most=50.0)
    ] = 0.0
    target_walk_mm: Annotated[
        float, quantity("random walk of the target in 100 mm", at_least=0.0, at_most=50.0)
    ] = 0.0
    target_noise_mm: Annotated[
        float, quantity("error of the measured target in each coordinate", at_least=0.0, at_most=20.0)
    ] = 0.0


class Truth:
    """One patient and one needle, drawn from the errors; a function of the insertion alone.

    Parameters
    ----------
    errors : Errors
    query : Query
        For the first place of the target, and the insertion at the start.
    length_mm : float
        Longest insertion.
    seed : int
    """

    def __init__(self, errors: Errors, query: Query, length_mm: float, seed: int) -> None:
        streams = np.random.SeedSequence(seed).spawn(4)
        body, bevel, tracker, self._losses = (np.random.default_rng(each) for each in streams)
        self._errors, self._bevel, self._tracker = errors, bevel, tracker
        self._target = query.target
        self._knots = query.inserted_mm + KNOT_MM * np.arange(math.ceil(length_mm / KNOT_MM) + 2)
        count = len(self._knots)
        self._scale = 1.0 + errors.curvature_bias + errors.curvature_sd * body.standard_normal()
        kept = math.exp(-KNOT_MM / errors.curvature_wander_mm)
        wander = body.standard_normal(count)
        for n in range(1, count):
            wander[n] = kept * wander[n - 1] + math.sqrt(1.0 - kept * kept) * wander[n]
        self._wander = errors.curvature_wander_sd * wander
        a_knot = math.sqrt(KNOT_MM / REFERENCE_MM)
        self._twist = math.radians(errors.roll_wander_deg) * a_knot * _walk(body.standard_normal((count, 1)))
        self._pull = errors.pull_per_mm * _direction(body)
        drift = errors.target_drift_mm * (KNOT_MM / REFERENCE_MM) * _direction(body)
        steps = _walk(body.standard_normal((count, 3)))
        self._motion = np.arange(count)[:, None] * drift + errors.target_walk_mm * a_knot * steps
        self._lag = 0.0

    def roll(self) -> None:
        """Turn the bevel: it does not end where it should."""
        self._lag = math.radians(self._errors.roll_sd_deg) * self._bevel.standard_normal()

    def bend(self, frame: Float, curvature: float, inserted_mm: float) -> tuple[float, float]:
        """Return direction (rad about +z from +x of a frame) and amount (1/mm) of the true curvature.

        Parameters
        ----------
        frame : (4, 4) float64
            The tip, rolled as commanded.
        curvature : float
            What was commanded: towards +x.
        inserted_mm : float
        """
        scale = max(self._scale + np.interp(inserted_mm, self._knots, self._wander), 0.0)
        twist = self._lag + float(np.interp(inserted_mm, self._knots, self._twist[:, 0]))
        total = scale * curvature * bend_direction(frame, twist) + self._pull
        x, y = float(total @ frame[:3, 0]), float(total @ frame[:3, 1])
        return math.atan2(y, x), math.hypot(x, y)

    def target(self, inserted_mm: float) -> Float:
        """Return where the target really is."""
        moved = [np.interp(inserted_mm, self._knots, column) for column in self._motion.T]
        return np.asarray(self._target + moved)

    def measure(self, frame: Float, inserted_mm: float) -> tuple[Float, Float] | None:
        """Return tip frame and target as the tracker sees them, None if the measurement is lost.

        The tracker sees no roll: it is what was commanded.
        """
        if self._losses.random() < self._errors.lost_share:
            return None
        noise = self._tracker.standard_normal(8)
        a, b = math.radians(self._errors.direction_noise_deg) * noise[:2]
        seen = frame @ tilt(math.hypot(a, b), math.atan2(b, a))
        seen[:3, 3] += self._errors.position_noise_mm * noise[2:5]
        return seen, self.target(inserted_mm) + self._errors.target_noise_mm * noise[5:]


def _walk(steps: Float) -> Float:
    steps[0] = 0.0
    return np.asarray(np.cumsum(steps, axis=0))


def _direction(rng: np.random.Generator) -> Float:
    vector = rng.standard_normal(3)
    return np.asarray(vector / np.linalg.norm(vector))


def assumed_errors(size: float, **changes: float) -> Errors:
    """Return all errors together, and some changed; those of size 1 are an assumption, not measured."""
    stated = {
        "curvature_sd": 0.08 * size,
        "curvature_wander_sd": 0.05 * size,
        "roll_sd_deg": 5.0 * size,
        "roll_wander_deg": 10.0 * size,
        "pull_per_mm": 0.0003 * size,
        "position_noise_mm": 0.4 * size,
        "direction_noise_deg": 0.6 * size,
        "target_drift_mm": 2.0 * size,
        "target_walk_mm": 1.0 * size,
        "target_noise_mm": 0.4 * size,
    }
    return Errors(**(stated | changes))

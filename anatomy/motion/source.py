"""What is known of a patient's breathing, as it was read: a field, landmark pairs, or other people's."""

from typing import Literal

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.grid import Grid, Volume


@frozen_record
class MotionSource:
    """Motion between end-exhale (phase 0) and end-inhale (phase 1) of quiet breathing, in LPS mm.

    One of three kinds: a displacement field (`grid` and `vectors`), landmark pairs (`exhale_lps` and
    `inhale_lps`), or the model of a population (`population_motion_mm`).

    Args:
        description: Where it came from, in words.
        masks_phase: The phase that the patient's masks show.
        amplitude: Motion from phase 0 to 1 as a share of that of the source.
        maps_from ("end-exhale" or "end-inhale"): Where the points of a displacement field lie; the vectors
            lead to the other end.
        vectors ((ni, nj, nk, 3) float64): Displacements at the voxel centres of `grid`.
        exhale_lps, inhale_lps ((N, 3) float64): The same places of tissue at both ends.
        population_motion_mm: 95 % motion of the patient.
        hysteresis: See `Motion`.
        other_lungs: The lungs at the end of the breath that is farther from the phase of the masks, to
            compare with.
    """

    description: str
    masks_phase: float
    amplitude: float = 1.0
    maps_from: Literal["end-exhale", "end-inhale"] = "end-exhale"
    grid: Grid | None = None
    vectors: Float | None = None
    exhale_lps: Float | None = None
    inhale_lps: Float | None = None
    population_motion_mm: float | None = None
    hysteresis: float = 0.0
    other_lungs: Volume | None = None

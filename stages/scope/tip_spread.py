"""Where the tip of a resting shaft lies and looks, over what is not known of scope, wall and friction."""

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from stages.scope.motion import BEND, ScopeMotion
from stages.scope.resting import Circumstances, RestingShaft, RestingShape, WallContact

PATIENTS, ATTEMPTS = 6, 6
"""Choices of the stiffness of scope and wall, and of friction for each of them."""
SAME_MM, SAME_DEG = 0.5, 1.0
"""Two shapes whose tips differ by less are one."""


@frozen_record
class TipSpread:
    """The distribution of a resting tip about a pose, in the frame of that pose.

    Args:
        nominal: Scope and wall as stiff as stated, and no friction.
        nominal_off ((5,) float64): How its tip is off the pose, see `off_pose`.
        other: Where the shaft rests if its section is bent only where it stands, and not on the way; None if
            it is the same.
        bias_mm ((3,) float64): Mean of the tip's place less that of the pose, along its x, y and z.
        bias_deg ((2,) float64): Mean of the turn of the tip's direction about the x and y of the pose.
        patient_mm, patient_deg: Standard deviation along an axis, or about one, over the stiffness of scope
            and wall.
        attempt_mm, attempt_deg: The same over friction.
        wall_force_n, give_mm ((D,) float64): Largest force on the wall and how far it yields, of all choices
            that came to rest.
        held_share: Share of the choices in which the shaft came to rest with its tip at its depth; of none,
            the bias is that of `nominal`.
    """

    nominal: RestingShape
    nominal_off: Float
    other: RestingShape | None
    bias_mm: Float
    bias_deg: Float
    patient_mm: float
    attempt_mm: float
    patient_deg: float
    attempt_deg: float
    wall_force_n: Float
    give_mm: Float
    held_share: float


def off_pose(lps_from_pose: Float, lps_from_tip: Float) -> Float:
    """Return how a tip is off a pose, `(5,)`: along its x, y, z in mm, and about its x and y in degrees."""
    place = lps_from_pose[:3, :3].T @ (lps_from_tip[:3, 3] - lps_from_pose[:3, 3])
    x, y, z = lps_from_pose[:3, :3].T @ lps_from_tip[:3, 2]
    aside = float(np.hypot(x, y))
    angle = np.degrees(np.arctan2(aside, z)) / max(aside, 1e-12)
    return np.array([*place, -y * angle, x * angle])


def choices(contact: WallContact) -> list[list[Circumstances]]:
    """Return what is not known, for some patients in some attempts each, from the stated ranges."""
    # The choices are the same for all motions: what differs between two of them is not luck.
    rng = np.random.Generator(np.random.PCG64(1))
    wide = np.log([contact.scope_stiffness_range, contact.wall_stiffness_range])
    made = []
    for _ in range(PATIENTS):
        stiffer, wall = np.exp(rng.uniform(-wide, wide)).tolist()
        frictions = rng.uniform(0.0, contact.max_friction, ATTEMPTS).tolist()
        slid = rng.uniform(-np.pi, np.pi, ATTEMPTS).tolist()
        pairs = zip(frictions, slid, strict=True)
        made.append(
            [Circumstances(stiffer=stiffer, wall_stiffer=wall, friction=f, slid_rad=s) for f, s in pairs]
        )
    return made


def spread_of_tip(
    shaft: RestingShaft, motion: ScopeMotion, contact: WallContact, lps_from_pose: Float
) -> TipSpread:
    """Return the distribution of the resting tip of a motion about a pose, such as the planned one."""
    nominal, other = _two_starts(shaft, motion)
    off: list[list[Float]] = []

    def at_rest(chosen: Circumstances) -> RestingShape:
        shape = shaft.rest(motion, chosen, start=nominal)
        return shape if shape.settled else shaft.rest(motion, chosen)

    # The kernels leave the interpreter alone, so that threads share the processors.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        rested = [list(pool.map(at_rest, attempts)) for attempts in choices(contact)]
    settled = [[shape for shape in shapes if shape.settled] for shapes in rested]
    held = [shape for shapes in settled for shape in shapes]
    for shapes in settled:
        if len(shapes) > 1:
            off.append([off_pose(lps_from_pose, shape.lps_from_scope_tip) for shape in shapes])
    if other is not None and other.settled:
        off.append([off_pose(lps_from_pose, other.lps_from_scope_tip)])
    lost = off_pose(lps_from_pose, nominal.lps_from_scope_tip)
    means = np.array([np.mean(group, axis=0) for group in off] or [lost])
    within = np.array([np.var(group, axis=0, ddof=1) for group in off if len(group) > 1] or [np.zeros(5)])
    within = within.mean(axis=0)
    between = means.var(axis=0, ddof=1) if len(means) > 1 else np.zeros(5)
    between = np.maximum(between - within / ATTEMPTS, 0.0)
    bias = means.mean(axis=0)
    return TipSpread(
        nominal=nominal,
        nominal_off=lost,
        other=other,
        bias_mm=bias[:3],
        bias_deg=bias[3:],
        patient_mm=float(np.sqrt(between[:3].mean())),
        attempt_mm=float(np.sqrt(within[:3].mean())),
        patient_deg=float(np.sqrt(between[3:].mean())),
        attempt_deg=float(np.sqrt(within[3:].mean())),
        wall_force_n=np.array([shape.wall_force_n for shape in held]),
        give_mm=np.array([shape.most_give_mm for shape in held]),
        held_share=len(held) / (PATIENTS * ATTEMPTS),
    )


def _two_starts(shaft: RestingShaft, motion: ScopeMotion) -> tuple[RestingShape, RestingShape | None]:
    """Return the resting shape from that as laid, and the one from a relaxed section if it differs."""
    states = motion.states.copy()
    states[-1, BEND] = 0.0
    nominal = shaft.rest(motion)
    other = shaft.rest(motion, start=shaft.rest(replace(motion, states=states), as_advanced=True))
    apart = off_pose(nominal.lps_from_scope_tip, other.lps_from_scope_tip)
    same = np.linalg.norm(apart[:3]) < SAME_MM and np.linalg.norm(apart[3:]) < SAME_DEG
    return nominal, None if same else other

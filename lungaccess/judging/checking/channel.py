"""Own look at the working channel: strain of tubes and needle on their way, and what straightens it."""

from collections.abc import Iterator, Sequence

import numpy as np

from anatomy.base.typed import Float
from anatomy.shafts import SlottedSegment
from lungaccess.judging.checking.findings import Findings
from lungaccess.judging.checking.scope_motion import motion_of
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System
from stages.tube.device import AIRWAY_MM, Tube

STEP_MM = 0.5
"""Spacing of the places of channel and tube that are looked at; what is between two is counted with both."""


def check_channel(plan: Plan, found: Findings) -> None:
    """Record strain of tubes and needle all along the channel, and the bend that the handle must set."""
    scope, device, tubes = plan.scope, plan.system.scope, plan.system.tubes
    motion = motion_of(scope.lps_from_entry, scope.states, device.bending_length_mm)
    which, lengths_mm = motion.body_pieces()
    behind_mm, bent = np.cumsum(lengths_mm[::-1])[::-1], np.linalg.norm(motion.bends[which], axis=1)
    tightest = float(bent.max(initial=0.0))
    limit = tubes.max_channel_curvature_per_mm
    if limit is not None:
        detail = "curvature of the channel that the tubes pass"
        found.at_most("tube.channel", tightest, limit, "1/mm", detail, 1e-9)
    inserted = plan.tube.insertions_mm(tubes)
    for (name, tube), length in zip(tubes.named, inserted, strict=True):
        strain = max(_strains(tube, behind_mm, bent, length))
        detail = f"largest strain of the {name} tube on its way through the channel"
        found.at_most(f"tube.strain.{name}", strain, tubes.max_strain, "", detail, 1e-9)
    needle = plan.system.needle
    if needle is not None:
        # Tubes that share a bend are bent by no more than the most bent of them is at rest.
        at_rest = max(curvature for tube in tubes.nested for _begin, _end, curvature in bent_at_rest(tube))
        strain = 0.5 * needle.diameter_mm * _largest_factor(plan.system) * max(tightest, at_rest)
        detail = "largest strain of the needle on its way through channel and tubes"
        found.at_most("needle.strain", strain, needle.max_strain, "", detail, 1e-9)
    _check_handle(plan, inserted, found)


def _strains(tube: Tube, behind_mm: Float, bent: Float, inserted_mm: float) -> Iterator[float]:
    """Yield the strain of every part of a tube in the most bent place that it comes to, and held straight."""
    for at in np.arange(0.0, inserted_mm + float(behind_mm[0]) + STEP_MM, STEP_MM):
        # A part `at` mm from the tube's tip comes to every place that is so far behind the scope's tip.
        passed = bent[behind_mm >= at - inserted_mm - STEP_MM]
        most = float(passed.max(initial=0.0))
        for end in (max(at - STEP_MM, 0.0), at):
            rest, factor = _bend_at_rest(tube, end), slots_at(tube.slotted_segments, end)[1]
            yield 0.5 * tube.outer_diameter_mm * factor * (most + rest)


def _bend_at_rest(tube: Tube, from_tip_mm: float) -> float:
    """Return the precurvature at a place of a tube, 1/mm."""
    return max(k for begin, end, k in bent_at_rest(tube) if begin <= from_tip_mm <= end)


def bent_at_rest(tube: Tube) -> list[tuple[float, float, float]]:
    """Return the parts of a tube: begin and end in mm from its tip, and precurvature in 1/mm."""
    parts, begin = [], 0.0
    for piece in reversed(tube.bent_pieces):
        parts.append((begin, begin + piece.length_mm, piece.precurvature_per_mm))
        begin += piece.length_mm
    if tube.curved_length_mm > 0.0:
        parts.append((0.0, tube.curved_length_mm, tube.precurvature_per_mm))
        begin = tube.curved_length_mm
    return [*parts, (begin, np.inf, 0.0)]


def slots_at(segments: Sequence[SlottedSegment], from_tip_mm: float) -> tuple[float, float]:
    """Return how stiff and how strained a shaft is at a place, as shares of a plain one's."""
    for segment in segments:
        if segment.from_tip_mm <= from_tip_mm <= segment.from_tip_mm + segment.length_mm:
            return segment.stiffness_factor, segment.strain_factor
    return 1.0, 1.0


def _largest_factor(system: System) -> float:
    """Return the largest factor of strain along all of the needle that can come to a bend."""
    needle = system.require_needle("The strain of a needle")
    segments = needle.slotted_segments
    passing_mm = AIRWAY_MM + system.tubes.max_extension_mm + needle.max_length_mm
    covered = sum(max(min(segment.to_mm, passing_mm) - segment.from_tip_mm, 0.0) for segment in segments)
    factors = [segment.strain_factor for segment in segments if segment.from_tip_mm < passing_mm]
    return max([*factors, 1.0] if covered < passing_mm - 1e-9 else factors)


def _check_handle(plan: Plan, inserted_mm: tuple[float, ...], found: Findings) -> None:
    """Section, tubes and needle share the bending moment that the handle sets: it must bend them all."""
    device, tubes = plan.system.scope, plan.system.tubes
    stiffness = device.bending_stiffness_n_mm2
    for tube, inserted in zip(reversed(tubes.nested), inserted_mm, strict=True):
        plain = 1e3 * tube.youngs_modulus_gpa * np.pi / 64.0
        plain *= tube.outer_diameter_mm**4 - tube.inner_diameter_mm**4
        inside = np.append(np.arange(inserted, inserted + device.bending_length_mm, STEP_MM), inserted)
        stiffness += plain * max(slots_at(tube.slotted_segments, float(at))[0] for at in inside)
    shaft = plan.system.needle
    if shaft is not None and plan.system.needle_preloaded:
        passes = inserted_mm[-1] + shaft.max_length_mm + device.bending_length_mm
        plain = 1e3 * shaft.youngs_modulus_gpa * np.pi / 64.0
        plain *= shaft.diameter_mm**4 - shaft.inner_diameter_mm**4
        places = np.arange(0.0, passes, STEP_MM)
        stiffness += plain * max(slots_at(shaft.slotted_segments, float(at))[0] for at in places)
    bend = float(plan.scope.states[-1, 2])
    limit = np.deg2rad(device.bend_up_deg if bend >= 0.0 else device.bend_down_deg)
    detail = "bend that the handle sets so that section, tubes and needle bend as planned"
    wanted = abs(bend) * stiffness / device.bending_stiffness_n_mm2
    found.at_most("scope.handle", wanted, float(limit), "rad", detail, 1e-6)

"""Pairs of tubes that several tests use."""

from __future__ import annotations

from stages.tube.device import ConcentricTubes, Tube

WIDE = ConcentricTubes(
    outer=Tube(outer_diameter_mm=1.9, inner_diameter_mm=1.65, length_mm=640.0),
    inner=Tube(
        outer_diameter_mm=1.5,
        inner_diameter_mm=1.3,
        length_mm=680.0,
        curved_length_mm=40.0,
        precurvature_per_mm=0.025,
    ),
)


def thin_pair(curved_mm: float) -> ConcentricTubes:
    """Return a pair for a channel of 2 mm or less, whose inner tube has a curved part of a given length."""
    inner = Tube(
        outer_diameter_mm=1.2,
        inner_diameter_mm=1.05,
        length_mm=680.0,
        curved_length_mm=curved_mm,
        precurvature_per_mm=0.025 if curved_mm else 0.0,
    )
    return ConcentricTubes(
        outer=Tube(outer_diameter_mm=1.6, inner_diameter_mm=1.38, length_mm=640.0), inner=inner
    )

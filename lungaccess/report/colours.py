"""Colours of what explains a missing plan, in pictures and pages alike."""

from __future__ import annotations

from types import MappingProxyType

MISS, NEAREST, OTHER = "#8E24AA", "#2F8FD0", "#009E73"
"""The path that violates least, the plan to the nearest point, plans of other systems; on light and dark."""

START_COLOURS = MappingProxyType(
    {
        "clear": "#009E73",
        "a vessel": "#D81B60",
        "a fissure": "#785EF0",
        "an airway": "#1E88E5",
        "the pleura": "#B8860B",
        "needs several arcs": "#E69F00",
        "out of reach": "#B0B0B0",
    }
)
"""By the keys of `lungaccess.explanation.FAILS`; those of structures are theirs in the charts of a page."""

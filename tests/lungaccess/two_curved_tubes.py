"""A system with two curved tubes for the small synthetic patient."""

from __future__ import annotations

from dataclasses import replace

from lungaccess.problem.system import System, load_system

COARSE = {"rotations": 4, "site_spacing_mm": 4.0}
"""Of its atlas."""


def two_curved_tubes() -> System:
    """Return the preset with two curved tubes, a scope for a child's airways and a short reach."""
    loaded = load_system("curved-outer")
    tubes = replace(loaded.tubes, max_extension_mm=24.0)
    needle = replace(loaded.needle, max_curvature_per_mm=1.0 / 50.0)
    scope = replace(loaded.scope, outer_diameter_mm=2.0)
    return replace(
        loaded, name="two curved tubes", scope=scope, tubes=tubes, needle=needle, fissures_allowed=True
    )

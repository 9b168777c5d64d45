"""How invasive a system is, from the sizes of its devices: the order in which systems are tried."""

import math
from collections.abc import Iterable
from typing import NamedTuple

from lungaccess.problem.system import System, load_system, preset_names, with_tool
from lungaccess.problem.tools import Tool


class Invasiveness(NamedTuple):
    """What a system does to the tissue; of two systems the smaller one is the less invasive.

    The fields are compared one after the other, the worst injury first.

    Args:
        fissures_allowed: Whether a fissure may be crossed, which pierces the pleura twice.
        hole_mm2: Cross-section of the outer tube: the hole in the airway wall.
        track_mm2: Cross-section of what goes to the target, the needle or the inner tube: its track through
            the lung.
        scope_diameter_mm: Outer diameter of the bronchoscope, which stays in the airways and injures least.
        track_curvature_per_mm: Greatest curvature of what goes to the target.
    """

    fissures_allowed: bool
    hole_mm2: float
    track_mm2: float
    scope_diameter_mm: float
    track_curvature_per_mm: float


def invasiveness(system: System) -> Invasiveness:
    """Return how invasive a system is.

    Examples:
        >>> invasiveness(load_system("ultrathin")) < invasiveness(load_system("therapeutic-scope"))
        True
    """
    needle, inner = system.needle, system.tubes.inner
    bent_per_mm = inner.max_precurvature_per_mm if needle is None else needle.max_curvature_per_mm
    return Invasiveness(
        fissures_allowed=system.fissures_allowed,
        hole_mm2=_area_mm2(system.tubes.outermost.outer_diameter_mm),
        track_mm2=_area_mm2(2.0 * system.track_radius_mm),
        scope_diameter_mm=float(system.scope.outer_diameter_mm),
        track_curvature_per_mm=float(bent_per_mm),
    )


def least_invasive_first(systems: Iterable[System]) -> tuple[System, ...]:
    """Return systems in the order of their invasiveness, equal ones by their names."""
    return tuple(sorted(systems, key=lambda system: (*invasiveness(system), system.name)))


def presets_by_invasiveness(
    *, fissures_allowed: bool | None = None, tool: Tool | None = None
) -> tuple[System, ...]:
    """Return the systems that ship, the least invasive first; with a tool, those that have a needle."""
    systems = (load_system(name, fissures_allowed=fissures_allowed) for name in preset_names())
    able = (each for each in systems if tool is None or each.needle is not None)
    return least_invasive_first(with_tool(each, tool) for each in able)


def _area_mm2(diameter_mm: float) -> float:
    return 0.25 * math.pi * float(diameter_mm) ** 2

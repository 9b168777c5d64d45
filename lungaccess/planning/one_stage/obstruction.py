"""What stands in the way of a needle, in words and as plain values."""

import math
from functools import cache
from typing import Any

from anatomy.base.words import point_in_words
from anatomy.structures import AIRWAY, BRANCH_SHIFT, FISSURE, OUTSIDE, VESSEL
from lungaccess.problem.system import load_system, needle_preset_names, preset_names
from stages.needle import Obstruction

NAMES = ((VESSEL, "a vessel"), (FISSURE, "a fissure"), (OUTSIDE, "the outside of the organ"))
LIMITS = {
    "angle": "lies too far aside of straight ahead for the limit of the angle from the start",
    "turn": "lies too far aside of straight ahead for the limit of all turning",
    "length": "is farther than the needle is long",
}


def structure_in_words(label: int) -> str:
    """Return the structure that a voxel label stands for, with the branch of an airway."""
    if label & AIRWAY:
        branch = (label >> BRANCH_SHIFT) - 1
        return "an airway" if branch < 0 else f"the airway (branch {branch})"
    return next((name for bit, name in NAMES if label & bit), "nothing")


def reason_in_words(found: Obstruction) -> str:
    """Return in a few words what is blocked, by what, and by how much."""
    if found.place == "reach":
        if found.limit != "radius":
            return f"target out of reach: it {LIMITS[found.limit]}"
        if found.radius_mm is None:
            return "target out of reach, whatever the radius of curvature"
        # Rounded down, so that the radius named does reach it.
        radius_mm = math.floor(10.0 * found.radius_mm) / 10.0
        return f"target out of reach of this radius: needs R <= {radius_mm:.1f} mm{_needle_with(radius_mm)}"
    what = {"start": "start blocked", "target": "target blocked"}.get(found.place, "path blocked")
    return (
        f"{what} by {structure_in_words(found.label)}: "
        f"{found.distance_mm:.2f} mm away, needs {found.needed_mm:.2f} mm"
    )


@cache
def _bundled_radii_mm() -> dict[str, float]:
    """Return the least radius of curvature of the needle of each system that ships, by its name."""
    systems = [load_system(name) for name in (*preset_names(), *needle_preset_names())]
    return {each.name: each.needle.min_radius_of_curvature_mm for each in systems if each.needle is not None}


def _needle_with(radius_mm: float) -> str:
    """Name the system with the gentlest needle that turns within a radius; "" if none that ships does."""
    radii = _bundled_radii_mm()
    name = max((each for each in radii if radii[each] <= radius_mm), key=lambda each: radii[each], default="")
    return f", which --system {name} has ({radii[name]:g} mm)" if name else ""


def obstruction_rows(found: Obstruction, proved: bool, lobe: str = "") -> list[tuple[str, str]]:
    """Return what a table says of an obstruction, the reason first."""
    rows = [("reason", reason_in_words(found))]
    if found.place == "reach":
        direction = f"{math.degrees(found.direction_rad):.1f} deg off straight ahead"
        rows.append(("target seen from the start", f"{found.straight_mm:.1f} mm away, {direction}"))
    elif found.place == "path":
        rows.append(("where", f"the tightest place of the easiest path tried, {_place(found)}"))
    else:
        rows.append(("where", _place(found)))
    if lobe:
        rows.append(("lobe", lobe))
    rows.append(("proved", "yes: no path exists" if proved else "no: a path may exist"))
    return rows


def _place(found: Obstruction) -> str:
    along = "" if found.inserted_mm is None else f"{found.inserted_mm:.1f} mm along the needle, "
    return f"{along}at {point_in_words(found.point_lps)}"


def obstruction_record(found: Obstruction, proved: bool, lobe: str = "") -> dict[str, Any]:
    """Return plain JSON values: points in both frames, mm, angles in rad."""
    x, y, z = (float(v) for v in found.point_lps)
    branch = (found.label >> BRANCH_SHIFT) - 1
    return {
        "what": found.place,
        "reason": reason_in_words(found),
        "proved": proved,
        "structure": structure_in_words(found.label) if found.label else None,
        "branch": branch if found.label & AIRWAY and branch >= 0 else None,
        "lobe": lobe or None,
        "point_lps_mm": [x, y, z],
        "point_ras_mm": [-x, -y, z],
        "obstacle_lps_mm": None if found.obstacle_lps is None else found.obstacle_lps.tolist(),
        "inserted_mm": found.inserted_mm,
        "distance_mm": found.distance_mm,
        "needed_distance_mm": found.needed_mm,
        "limit": found.limit or None,
        "needed_radius_mm": found.radius_mm,
        "target_direction_rad": found.direction_rad,
        "target_distance_mm": found.straight_mm,
    }

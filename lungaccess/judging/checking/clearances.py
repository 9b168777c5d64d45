"""Clearances from structures: recomputed against what is required, and stated against recomputed."""

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, TypeVar

from anatomy.base.typed import Float
from anatomy.lobes import FISSURES_UNKNOWN
from lungaccess.judging.checking.boxes import Boxes, PathDistances
from lungaccess.judging.checking.findings import Findings
from lungaccess.judging.checking.shapes import STEP_MM
from lungaccess.plans.plan import Plan

if TYPE_CHECKING:
    from anatomy.lung import Lung

Case = TypeVar("Case", bound=tuple[Any, ...])

CLEARANCE_TOLERANCE_MM = 1e-3
"""A planner may keep exactly the required clearance, so that the check may find a micrometre less."""

MEANING = {
    "vessel": "axis to vessels",
    "outside": "axis to the pleura and all that is not lung",
    "fissure": "axis to fissures",
    "airway": "axis to airways",
    "other_airway": "axis to airways of other branches, while the pierced wall is exempt",
    "lumen": "axis to any lumen, while the pierced wall is exempt",
}


REACH_MM = 20.0
"""Clearances are recomputed up to this distance; what lies farther counts as this far."""


def structures_known(cases: Iterable[Case], stage: str, lung: "Lung", found: Findings) -> Iterator[Case]:
    """Yield the structures to keep clear of, and record that fissures are not checked if there is no mask."""
    for case in cases:
        if case[0] == "fissure" and not lung.has_fissures:
            found.unchecked(f"{stage}.clearance.fissure", FISSURES_UNKNOWN)
        else:
            yield case


def check_clear(
    name: str, boxes: Boxes, points: Float, needed_mm: Float, found: Findings, *, limited: bool
) -> float:
    """Record whether the segments between points keep their distances from boxes; return that of the points.

    The finding shows the segment with the least to spare, and the distance that is needed there.
    """
    distances = PathDistances(boxes, points)
    least = distances.least_mm()
    words = MEANING[name.split(".")[-1]]
    if not limited:
        found.measured(name, least, "mm", f"{words}, which may be crossed")
        return least
    # Distances up to this much beyond what is required are measured with FCL, larger ones at samples alone.
    within = float(needed_mm.max()) + 1.0
    gap = distances.segments_mm(within)
    worst = int((gap - needed_mm).argmin())
    value, limit = float(gap[worst]), float(needed_mm[worst])
    if value >= within:
        value, limit = max(least - 0.5 * STEP_MM, within), float(needed_mm.max())
    found.at_least(name, value, limit, "mm", words, CLEARANCE_TOLERANCE_MM)
    return least


def check_stated_clearance(
    plan: Plan, stage: str, name: str, range_mm: tuple[float, float], diagonal_mm: float, found: Findings
) -> None:
    """Record whether a stated clearance is true: not more than there is, nor much less.

    `range_mm` is what was recomputed; the tube's differs with and without its contact in the lumen.
    """
    stated = plan.clearance_mm.get(stage, {}).get(name)
    if stated is None:
        return
    least, most = range_mm
    label = f"{stage}.clearance.{name}.stated"
    detail = "not more than recomputed"
    # A stated clearance is a lower bound; where it was sampled, it may be this much above the recomputed one.
    found.at_most(label, min(stated, REACH_MM), most, "mm", detail, 0.05)
    # A planner may state its proved lower bound: less than the truth by a voxel's diagonal and this.
    slack, detail = diagonal_mm + 0.25, "not much less than recomputed"
    # A clearance beyond this may be stated as no more than this.
    found.at_least(f"{label}.least", stated, min(least, 5.0), "mm", detail, slack)

"""The needle starts that a patient and a system have, and why each does not reach the target."""

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from lungaccess.planning.coupled import DirectArcs
from lungaccess.plans.evaluator import blocker_name

CLEAR, LIMITS, OUT_OF_REACH = "clear", "needs several arcs", "out of reach"
FAILS = MappingProxyType(
    {
        CLEAR: "a single arc reaches the target",
        "a vessel": "blocked by a vessel",
        "a fissure": "blocked by a fissure",
        "an airway": "blocked by an airway",
        "the pleura": "blocked by the pleura",
        LIMITS: "reaches the target with several arcs only",
        OUT_OF_REACH: "out of the needle's reach",
    }
)
"""Why a start fails, in words; the nearest to success first."""


@frozen_record
class StartMap:
    """Where a needle can start, cell by cell, and why it does not reach the target from there.

    Args:
        points_lps ((C, 3) float64, LPS mm): The middle of the starts of a cell.
        why ((C,) int64): Index into `FAILS` of the best of the starts of a cell.
        counts: How many starts fail for each reason of `FAILS`, all starts counted.
    """

    points_lps: Float
    why: Int
    counts: Mapping[str, int]


def map_starts(arcs: DirectArcs) -> StartMap:
    """Return the starts of an atlas with the reason why each one's direct arc fails."""
    entries, names = arcs.atlas.deployments, list(FAILS)
    why = np.full(entries.count, names.index(OUT_OF_REACH), dtype=np.int64)
    blockers = arcs.blockers(arcs.in_workspace)[0]
    labels, of_arc = np.unique(blockers, return_inverse=True)
    codes = np.array([names.index(_reason(int(label))) for label in labels], dtype=np.int64)
    why[arcs.in_workspace] = codes[of_arc.ravel()] if len(labels) else why[arcs.in_workspace]
    counted = np.bincount(why, minlength=len(names))
    # Starts in one cube of this side are shown as one: about the distance at which two dots are still two.
    cells = np.floor(entries.positions / 4.0).astype(np.int64)
    _cells, of_start = np.unique(cells, axis=0, return_inverse=True)
    of_start = of_start.ravel()
    count = int(of_start.max(initial=-1)) + 1
    best = np.full(count, len(names), dtype=np.int64)
    np.minimum.at(best, of_start, why)
    chosen = np.flatnonzero(why == best[of_start]) if count else np.zeros(0, dtype=np.int64)
    sizes = np.maximum(np.bincount(of_start[chosen], minlength=count), 1)
    middle = [
        np.bincount(of_start[chosen], entries.positions[chosen, axis], minlength=count) / sizes
        for axis in range(3)
    ]
    return StartMap(
        points_lps=np.stack(middle, axis=1),
        why=best,
        counts=MappingProxyType({FAILS[name]: int(n) for name, n in zip(names, counted, strict=True)}),
    )


def _reason(label: int) -> str:
    name = blocker_name(label)
    return {"nothing": CLEAR, "the needle's limits": LIMITS}.get(name, name)

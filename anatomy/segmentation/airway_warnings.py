"""What a user should look at in a segmented airway before trusting it."""

from __future__ import annotations

import numpy as np

from anatomy.airway_tree import AirwayTree
from anatomy.base.errors import AnatomyError
from anatomy.base.typed import Mask
from anatomy.grid import Grid, Volume

LEAST_TRACHEA_MM = 25.0
"""A chest CT shows at least a quarter of the trachea, which is about 100 mm long."""
LEAST_ENDS = 4
"""A lung has three lobes or two, and some segments of each are always seen."""
LEAST_SHARE = 0.2
"""A lung with fewer ends than this share of the other's has lost most of its airways."""
GREATEST_LOOPS_SHARE = 0.25
"""An airway with so many rings per end has grown into lung."""


def tree_or_error(lumen: Volume) -> AirwayTree | AnatomyError:
    """Return the tree of a lumen, or why there is none: it is made once, and many judge by it."""
    from anatomy.tree import tree_from_mask

    try:
        return tree_from_mask(lumen)
    except AnatomyError as error:
        return error


def airway_warnings(tree: AirwayTree | AnatomyError, left: Mask, right: Mask, grid: Grid) -> tuple[str, ...]:
    """Judge a lumen by its tree: trachea cut, airway that stops early, leak.

    Lungs are bool `(ni, nj, nk)` on the grid.
    """
    if isinstance(tree, AnatomyError):
        return (f"No tree can be made from the airway: {tree.found}.",)
    warnings = []
    trachea = tree.distance_from_root_mm[tree.branch_start[1] - 1]
    if trachea < LEAST_TRACHEA_MM:
        warnings.append(
            f"The trachea is cut: only {trachea:.0f} mm of it are in the airway. How "
            "a scope lies above it is not known."
        )
    ends = np.setdiff1d(np.arange(len(tree.branch_parent)), tree.branch_parent)
    tips = tree.points_lps[tree.branch_start[ends + 1] - 1]
    at = tuple(np.clip(np.rint(grid.ijk(tips)).astype(np.int64), 0, np.array(left.shape) - 1).T)
    counts = {"left": int(left[at].sum()), "right": int(right[at].sum())}
    for side, count in counts.items():
        if count < max(LEAST_ENDS, LEAST_SHARE * max(counts.values())):
            warnings.append(
                f"The airway stops early in the {side} lung: it has {count} ends there. Reach in that lung "
                "is understated."
            )
    loops = len(tree.report.loops_opened)
    if loops > max(GREATEST_LOOPS_SHARE * len(ends), 2):
        warnings.append(
            f"Leak suspected: the airway has {loops} rings. A branch may be lung that no scope can "
            "enter: look at the branches of a plan."
        )
    return tuple(warnings)

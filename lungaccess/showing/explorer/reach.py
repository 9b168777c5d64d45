"""The reach of a system for the page: voxel by voxel as it becomes known, from the target outward."""

from collections.abc import Iterator, MutableMapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.typed import Int
from anatomy.lung import Lung
from lungaccess.planning.coupled import Atlas
from lungaccess.planning.reachability import KINDS, ReachStream
from lungaccess.problem import System
from lungaccess.showing.explorer.worker import Part, Turn

Reached = MutableMapping[tuple[Any, ...], Int]
"""The deployment that reached each voxel, by scope, tubes, margins and rule for fissures."""


def reach_parts(
    lung: Lung, system: System, atlas: Atlas, around_lps: ArrayLike, reached: Reached, turn: Turn
) -> Iterator[Part]:
    """Yield the grid, then voxels with what became of them.

    Where the atlas is that of the question before, voxels whose arc is clear for the needle of this one, too,
    come first, all at once.
    """
    stream = ReachStream(lung, system, atlas)
    grid = stream.grid
    yield Part(
        {
            "answer": "reach grid", "shape": list(grid.shape), "spacing_mm": float(grid.spacing_mm[0]),
            "ijk_from_lps": grid.ijk_from_lps.tolist(), "lps_from_ijk": grid.lps_from_ijk.tolist(),
            "kinds": dict(KINDS), "counted": len(stream.counted),
            "voxel_ml": float(grid.voxel_volume_mm3) / 1000.0, "system": system.name,
        }
    )  # fmt: skip
    key = (system.scope, system.tubes, system.margins, atlas.with_fissures)
    known = None if system.needle is None else reached.get(key)
    reached.clear()  # Of one atlas only: a page changes the needle far more often than the scope.
    kept = reached[key] = (
        np.full(int(np.prod(grid.shape)), -1, dtype=np.int64) if known is None else known.copy()
    )
    for part in stream.parts(around_lps, known):
        found = part.entries >= 0
        kept[part.voxels[found]] = part.entries[found]
        yield Part(
            {"answer": "reach", "share": part.share},
            {"voxels": part.voxels.astype(np.int32), "kinds": part.kinds.astype(np.uint8)},
        )
        turn.check()

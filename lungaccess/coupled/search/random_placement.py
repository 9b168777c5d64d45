"""Random placements of scope and tubes: lines 3 to 7 of Algorithm 1 of [Kuntz2015]."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from anatomy.records import frozen_record
from lungaccess.coupled.atlas import Atlas
from lungaccess.problem.task import Task
from stages.scope import MedialAxis, ScopeTip, looks_ahead
from stages.tube import tracking_length_mm


@frozen_record
class Placement:
    """Where scope and tubes are placed.

    Parameters
    ----------
    rotation_rad, outer_mm, inner_mm : float
        Rotation and insertions of the tubes.
    needle_seed : int
        Seed of the needle's RRT from there.
    looks_ahead : bool
        Whether an airway in lung tissue lies ahead of the tip; it does not just behind some forks.
    """

    tip: ScopeTip
    rotation_rad: float
    outer_mm: float
    inner_mm: float
    needle_seed: int
    looks_ahead: bool


def random_placements(task: Task, atlas: Atlas) -> Iterator[Placement]:
    """Draw placements without end; there is none if the scope can take no pose.

    The poses are uniform by arc length on the medial axis where the scope passes and an airway in lung tissue
    lies ahead; of the atlas only the sites are used.
    """
    rng = np.random.Generator(np.random.PCG64(task.seed))
    axis = MedialAxis(task.lung.tree, atlas.sites.passable & atlas.sites.exits_ahead)
    longest_mm = tracking_length_mm(task.system.tubes)
    while atlas.sites.count and axis.length_mm > 0.0:
        tip = axis.sample(rng)
        rotation = float(rng.uniform(0.0, 2.0 * math.pi))
        outer, inner = np.sort(rng.uniform(0.0, longest_mm, 2)).tolist()
        yield Placement(
            tip=tip,
            rotation_rad=rotation,
            outer_mm=outer,
            inner_mm=inner,
            needle_seed=int(rng.integers(2**63)),
            looks_ahead=looks_ahead(task.lung.tree, tip),
        )

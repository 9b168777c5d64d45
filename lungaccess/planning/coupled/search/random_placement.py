"""Random placements of scope and tubes: lines 3 to 7 of Algorithm 1 of [Kuntz2015]."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from anatomy.base.records import frozen_record
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.problem.task import Task
from stages.scope import ScopeTip
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
    """

    tip: ScopeTip
    rotation_rad: float
    outer_mm: float
    inner_mm: float
    needle_seed: int


def random_placements(task: Task, atlas: Atlas, number: int = 0) -> Iterator[Placement]:
    """Draw placements without end, each `number` others; there is none if the scope can take no pose.

    The poses are drawn from the atlas's tips that look along the airway.  These lie evenly spaced by arc
    length, where a motion of the scope ends and an airway in lung tissue is ahead.
    """
    rng = np.random.Generator(np.random.PCG64([task.seed, number] if number else task.seed))
    along = np.flatnonzero(~atlas.motions.turned)
    longest_mm = tracking_length_mm(task.system.tubes)
    while len(along):
        tip = atlas.motions.tip(int(rng.choice(along)))
        rotation = float(rng.uniform(0.0, 2.0 * math.pi))
        outer, inner = np.sort(rng.uniform(0.0, longest_mm, 2)).tolist()
        yield Placement(
            tip=tip,
            rotation_rad=rotation,
            outer_mm=outer,
            inner_mm=inner,
            needle_seed=int(rng.integers(2**63)),
        )

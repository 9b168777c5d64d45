"""Random placements of scope and tubes: lines 3 to 7 of Algorithm 1 of [Kuntz2015]."""

import math
from collections.abc import Iterator

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.problem.task import Task
from stages.scope import ScopeTip
from stages.tube import design_arrays, longest_mm


@frozen_record
class Placement:
    """Where scope and tubes are placed.

    Args:
        rotation_rad: Rotation of all tubes.
        insertions_mm, rotations_rad ((n,) float64): Insertion of each tube, the outermost first, and how much
            farther it is turned.
        needle_seed: Seed of the needle's RRT from there.
    """

    tip: ScopeTip
    rotation_rad: float
    insertions_mm: Float
    rotations_rad: Float
    needle_seed: int


def random_placements(task: Task, atlas: Atlas, number: int = 0) -> Iterator[Placement]:
    """Draw placements without end, each `number` others; there is none if the scope can take no pose.

    The poses are drawn from the atlas's tips that look along the airway.  These lie evenly spaced by arc
    length, where a motion of the scope ends and an airway in lung tissue is ahead.
    """
    rng = np.random.Generator(np.random.PCG64([task.seed, number] if number else task.seed))
    along = np.flatnonzero(~atlas.motions.turned)
    tubes = task.system.tubes
    most_mm, turned = longest_mm(tubes), design_arrays(tubes).turned[::-1]
    while len(along):
        tip = atlas.motions.tip(int(rng.choice(along)))
        rotation = float(rng.uniform(0.0, 2.0 * math.pi))
        inserted = np.sort(rng.uniform(0.0, most_mm, len(turned)))
        relative = np.zeros(len(turned))
        relative[turned] = rng.uniform(0.0, 2.0 * math.pi, turned.sum())
        yield Placement(
            tip=tip,
            rotation_rad=rotation,
            insertions_mm=inserted,
            rotations_rad=relative,
            needle_seed=int(rng.integers(2**63)),
        )

"""Every kind of proof that the self-test computes again."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from anatomy.base.records import frozen_value
from lungaccess.judging.selftest import breath_cases, deployment_cases, needle_cases, scope_cases
from lungaccess.judging.selftest.scenes import Case


@frozen_value
class Kind:
    """One kind of proof.

    Parameters
    ----------
    proves : str
        What a case looks at, in words.
    draw : callable
        Draws a case and has the kernels answer it.
    seeds : tuple of int
        Of the cases: those in which bounds are close to the truth, and that take little time in Python.
    """

    proves: str
    draw: Callable[[np.random.Generator], Case]
    seeds: tuple[int, ...]

    def case(self, seed: int) -> Case:
        """Return the case of a seed, answered."""
        return self.draw(np.random.default_rng(seed))


KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "distances": Kind(
            proves="a clearance bound is below the distance, by a diagonal of a voxel at most",
            draw=needle_cases.distances,
            seeds=(0, 1, 2, 3),
        ),
        "arcs": Kind(
            proves="a path of the needle keeps its clearance, or does not",
            draw=needle_cases.arcs,
            seeds=(0, 1, 2, 3, 4),
        ),
        "tubes": Kind(
            proves="tubes keep clear of all but the wall that they pierce",
            draw=deployment_cases.tubes,
            seeds=(0, 1, 2, 3, 4, 5, 6, 7),
        ),
        "scope motions": Kind(
            proves="a motion of the scope touches no wall, at and between its states",
            draw=scope_cases.motions,
            seeds=(3, 4, 6),
        ),
        "start region": Kind(
            proves="the needle reaches its target from every start of the region",
            draw=needle_cases.start_region,
            seeds=(1, 2, 3),
        ),
        "no path": Kind(
            proves="no path of the needle leads to a target",
            draw=needle_cases.no_path,
            seeds=(1, 3, 5, 11, 14),
        ),
        "cost bound": Kind(
            proves="no path from a range of deployments costs less",
            draw=deployment_cases.cost_bound,
            seeds=(0, 1, 2, 3),
        ),
        "unreachable": Kind(
            proves="no deployment of a range reaches a target",
            draw=deployment_cases.not_reached,
            seeds=(2, 3, 4, 7),
        ),
        "window": Kind(
            proves="devices are clear and on target in all phases of a stretch of the breath, or in none",
            draw=breath_cases.windows,
            seeds=(1, 4, 7),
        ),
    }
)
"""The kinds by name."""

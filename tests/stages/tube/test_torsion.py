"""Torsion of two and three tubes in plain numbers, against the arrays that more tubes are integrated in."""

import numba
import numpy as np
import pytest

from benchmarks.scenes import configurations, random_mechanics
from stages.tube.kernels import equilibrium, torsion
from stages.tube.kernels.assembly import BENT


@numba.njit
def _step_in_arrays(design, cutting, nodes, steps, work):
    """Take each step of `nodes` again in arrays, from the nodes as they are; return how many pull."""
    psi, rate, dpsi, drate = nodes[1].copy(), nodes[2].copy(), nodes[3].copy(), nodes[4].copy()
    again, taken = (nodes[0], psi, rate, dpsi, drate), 0
    for at in range(len(steps[0])):
        if cutting[0][steps[1][at], BENT] > 1.0:
            torsion._step(again, at + 1, steps[0][at], design[0], cutting, steps[1][at], work)
            taken += 1
    return again, taken


@pytest.mark.parametrize("count", (2, torsion.FEW))
def test_plain_numbers_are_those_of_arrays_bit_for_bit(count: int) -> None:
    work = np.zeros((torsion.SCRATCH_ROWS, count, count))
    taken = 0
    for seed, made in enumerate(random_mechanics(count, 4)):
        for angles, beta in zip(*configurations(made, 10, seed), strict=True):
            cutting, n_steps = made.cut(beta)
            nodes, steps = equilibrium.scratch_for(n_steps, count, count - 1)
            torsion.twist(made.design, cutting, angles, nodes, steps, work)
            again, pulling = _step_in_arrays(made.design, cutting, nodes, steps, work)
            taken += pulling
            for one, other in zip(nodes, again, strict=True):
                np.testing.assert_array_equal(one, other)
    assert taken > 100
    assert work.any()

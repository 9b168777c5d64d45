"""A small random generator whose state belongs to the caller: SplitMix64."""

import numpy as np

from anatomy.kernels.compiling import kernel

GAMMA = np.uint64(0x9E3779B97F4A7C15)
MIX1 = np.uint64(0xBF58476D1CE4E5B9)
MIX2 = np.uint64(0x94D049BB133111EB)
TO_UNIT = 1.0 / 9007199254740992.0


@kernel()
def uniform(state):
    """Return a float64 in [0, 1) and advance `state`, a `(1,)` uint64 array."""
    state[0] += GAMMA
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * MIX1
    z = (z ^ (z >> np.uint64(27))) * MIX2
    z = z ^ (z >> np.uint64(31))
    return float(z >> np.uint64(11)) * TO_UNIT

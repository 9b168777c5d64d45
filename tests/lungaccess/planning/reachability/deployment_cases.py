"""Random boxes of deployments."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from anatomy.base.typed import Float

KAPPA = 1.0 / 50.0


def random_case(rng: np.random.Generator) -> tuple[Float, Float, Float]:
    """Return frame, a box of any size, and a target."""
    frame = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    scale = 10.0 ** rng.uniform(-3.0, 0.0)
    inner = rng.uniform(2.0, 50.0)
    angles = [*rng.uniform(-0.7, 0.7, 2), rng.uniform(-3.0, 3.0)]
    middles = np.array([*angles, rng.uniform(0.0, inner), inner, *rng.normal(0.0, 3.0, 3)])
    halves = scale * np.array([0.5, 0.5, 1.0, 10.0, 10.0, 2.0, 2.0, 3.0]) * rng.uniform(0.0, 1.0, 8)
    halves[3:5] = np.minimum(halves[3:5], middles[3:5])
    return frame, np.concatenate([middles, halves]), rng.normal(0.0, 40.0, 3)


def draw(rng: np.random.Generator, frame: Float, box: Float) -> tuple[Float, Float]:
    """Return a place and numbers of a deployment of a box that can be, often at its corners."""
    while True:
        share = np.clip(rng.uniform(-1.6, 1.6, 8), -1.0, 1.0)
        values = box[:8] + share * box[8:]
        if 0.0 <= values[3] <= values[4] and values[4] > 0.01:
            return values[5:] @ frame, values[:5]

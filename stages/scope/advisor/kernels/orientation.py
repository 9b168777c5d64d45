"""In which directions a bent tip can point at a place, without touching the wall."""

import numpy as np

from anatomy.kernels.compiling import kernel
from anatomy.kernels.field import MIN_GAP_MM
from stages.scope.advisor.kernels.chain import tip_of
from stages.scope.advisor.kernels.collision import body_fits, clearance_beyond


@kernel()
def pointable(lumen, scope, bases, tips, shaft, twists, bends, fits):
    """Fill `fits` (A, B): whether some body with the tip at one of `tips` (T, 3) has a twist and a bend.

    `bases` (K, 9) are rotation matrices of the base that are tried; behind it the body is straight for
    `shaft` mm.
    """
    state = np.zeros(14)
    joints = np.zeros((scope.links + 1, 3))
    for a in range(len(twists)):
        for b in range(len(bends)):
            fits[a, b] = False
            for k in range(bases.shape[0]):
                for entry in range(9):
                    state[entry] = bases[k, entry]
                for row in range(3):
                    state[9 + row] = 0.0
                x, y, z = tip_of(state, scope.link, scope.links, twists[a], bends[b])
                for t in range(tips.shape[0]):
                    state[9] = tips[t, 0] - x
                    state[10] = tips[t, 1] - y
                    state[11] = tips[t, 2] - z
                    if not body_fits(lumen, scope, state, twists[a], bends[b], joints):
                        continue
                    done = 0.0
                    while True:
                        gap = clearance_beyond(
                            lumen,
                            scope.radius,
                            state[9] + done * state[2],
                            state[10] + done * state[5],
                            state[11] + done * state[8],
                        )
                        if gap < MIN_GAP_MM or done >= shaft:
                            break
                        done = min(done + gap, shaft)
                    if gap >= MIN_GAP_MM:
                        fits[a, b] = True
                        break
                if fits[a, b]:
                    break

"""Motion of the lung by breathing: how much more the target moves than the scope's tip.

A place at height h of its lung (0 at the apex, 1 at the base) moves to the feet by `A g(h)` from end-exhale
to end-inhale, A being the patient's.  Scope and target move in the same phase.  The tip of the scope goes
along with the airway that holds it, so that only the difference of the two counts: in the frame of the
reference image the scope stays, and the target moves by `A f (g(h_target) - g(h_scope))`.  The phase f runs
from 0 at end-exhale, where the image was taken, to 1; the procedure is at any time of the cycle.  g is that
of `anatomy.motion.population`.
"""

from __future__ import annotations

import numpy as np

from anatomy.typed import Float

EXHALE_POWER = 6
"""The phase in time is cos^6, the form that [Lujan1999] fits to quiet breathing: long at end-exhale."""


def phase(share_of_time: Float) -> Float:
    """Return how far between end-exhale, 0, and end-inhale, 1, the lung is at shares of the cycle, 0 to 1."""
    return np.asarray(np.cos(np.pi * share_of_time) ** EXHALE_POWER)

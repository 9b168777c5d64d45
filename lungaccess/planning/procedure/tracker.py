"""What a tracker is: it tells where the tip of a device and the target are, with noise, and late."""

from __future__ import annotations

from typing import Protocol

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float


@frozen_record
class Measured:
    """One measurement.

    Parameters
    ----------
    time_s : float
        When it was made, seconds by the tracker's clock.
    lps_from_tip : (4, 4) float64
        The tip, LPS mm, +z forward.  A tracker that sees no roll states any.
    target_lps : (3,) float64 or None
        The target, LPS mm; None if it is not tracked.
    """

    time_s: float
    lps_from_tip: Float
    target_lps: Float | None = None


class Tracker(Protocol):
    """Tells where the tip of a needle is.

    `lungaccess.showing.live.LinkTracker` reads a real one by OpenIGTLink;
    `lungaccess.planning.procedure.SimulatedTracker` stands for one in simulations.
    """

    def read(self) -> Measured | None:
        """Return the newest measurement that has come since the last call, None if none has; do not wait."""

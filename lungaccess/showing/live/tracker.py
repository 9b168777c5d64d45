"""A real tracker: the tip of a needle and the target as they come in by OpenIGTLink."""

from __future__ import annotations

from anatomy.base.typed import Float
from lungaccess.planning.procedure.tracker import Measured
from lungaccess.showing.live.link import Link
from lungaccess.showing.live.replanning import NEEDLE_TIP, TARGET


class LinkTracker:
    """Reads the newest tracked pose of a needle's tip from a link; a `lungaccess.planning.procedure.Tracker`.

    Parameters
    ----------
    link : Link
    tip, target : str
        Names under which the poses come; of the target only the place counts.
    """

    def __init__(self, link: Link, tip: str = NEEDLE_TIP, target: str = TARGET) -> None:
        self._link, self._tip, self._named_target = link, tip, target
        self._target: Float | None = None

    def read(self) -> Measured | None:
        """Return the newest measurement that has come since the last call, None if none has."""
        newest = None
        for each in self._link.poll():
            if each.lps_from_device is None:
                continue
            if each.name == self._named_target:
                self._target = each.lps_from_device[:3, 3]
            elif each.name == self._tip:
                newest = each
        if newest is None or newest.lps_from_device is None:
            return None
        return Measured(time_s=newest.time_s, lps_from_tip=newest.lps_from_device, target_lps=self._target)

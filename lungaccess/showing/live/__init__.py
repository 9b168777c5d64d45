"""A plan in time and over a network: trajectories as files, and a live link by OpenIGTLink."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.showing.live.link import HOST, PORT, Link, LinkCounts
    from lungaccess.showing.live.replanning import Answer, TrackedReplanner
    from lungaccess.showing.live.session import RATE_HZ, LiveCounts, LiveSession
    from lungaccess.showing.live.trajectory import Speeds, Trajectory, plan_trajectory, write_trajectory

__getattr__, __dir__ = lazy_exports(__name__, __file__)

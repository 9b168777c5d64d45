"""What of a lung a system reaches, and proofs that it cannot reach a target."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.reachability.reach_map import DEFAULT_SPACING_MM as DEFAULT_SPACING_MM
    from lungaccess.reachability.reach_map import KINDS as KINDS
    from lungaccess.reachability.reach_map import NOT_COUNTED as NOT_COUNTED
    from lungaccess.reachability.reach_map import ReachMap as ReachMap
    from lungaccess.reachability.reach_map import RegionReach as RegionReach
    from lungaccess.reachability.reach_map import compare_reach as compare_reach
    from lungaccess.reachability.reach_map import map_reach as map_reach
    from lungaccess.reachability.reach_map import reach_grid as reach_grid
    from lungaccess.reachability.regions import Regions as Regions
    from lungaccess.reachability.regions import lung_regions as lung_regions
    from lungaccess.reachability.unreachable import MOST_BOXES as MOST_BOXES
    from lungaccess.reachability.unreachable import ReachVerdict as ReachVerdict
    from lungaccess.reachability.unreachable import UnreachableProof as UnreachableProof

__getattr__, __dir__ = lazy_exports(__name__, __file__)

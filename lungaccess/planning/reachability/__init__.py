"""What of a lung a system reaches, and proofs that it cannot reach a target."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.planning.reachability.reach_map import (
        KINDS,
        NOT_COUNTED,
        STATES,
        ReachMap,
        ReachStream,
        RegionReach,
        compare_reach,
        map_reach,
    )
    from lungaccess.planning.reachability.unreachable import (
        MOST_BOXES,
        OpenPlace,
        ReachVerdict,
        UnreachableProof,
    )

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""The bronchoscope: the device, its sites and its tip poses; see also `advisor`, `route` and `tour`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from stages.scope.device import Bronchoscope as Bronchoscope
    from stages.scope.sites import Sites as Sites
    from stages.scope.sites import approach_depth_mm as approach_depth_mm
    from stages.scope.sites import find_sites as find_sites
    from stages.scope.sites import tip_is_feasible as tip_is_feasible
    from stages.scope.tips import LEAVING_MM as LEAVING_MM
    from stages.scope.tips import MAX_TURN_AT_TIP_RAD as MAX_TURN_AT_TIP_RAD
    from stages.scope.tips import MedialAxis as MedialAxis
    from stages.scope.tips import ScopeTip as ScopeTip
    from stages.scope.tips import approach as approach
    from stages.scope.tips import leaving_point as leaving_point
    from stages.scope.tips import looks_ahead as looks_ahead
    from stages.scope.tips import tip_at as tip_at
    from stages.scope.tips import turned_aside as turned_aside
    from stages.scope.tips import walk as walk

__getattr__, __dir__ = lazy_exports(__name__, __file__)

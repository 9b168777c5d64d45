"""The bronchoscope: the device and its motions; see also `advisor`, `route` and `tour`."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from stages.scope.device import Bronchoscope
    from stages.scope.motion import ScopeMotion
    from stages.scope.motion_proof import (
        MAX_OFF_AXIS_MM,
        MAX_TURN_AT_TIP_RAD,
        MotionProver,
        TipRow,
        evenly,
        in_tip_region,
        prove_motion,
        prover_of,
    )
    from stages.scope.motions import Passages, ScopeMotions, ScopeTip, find_motions, find_passages
    from stages.scope.resting import RestingShaft, RestingShape, WallContact, lumen_of
    from stages.scope.tip_spread import TipSpread, off_pose, spread_of_tip

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""Simulated insertion of needles that do not follow their plans, in open and in closed loop."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.planning.procedure.insertion.of_plan import (
        RATE_HZ,
        SPEED_MM_PER_S,
        InsertionStudy,
        TrackerModel,
        insert_plan,
    )
    from lungaccess.planning.procedure.insertion.repeated import Study, Summary, study, summary
    from lungaccess.planning.procedure.insertion.simulation import TOLERANCE_MM, Insertion, Outcome, simulate
    from lungaccess.planning.procedure.insertion.tracking import SimulatedTracker, gain_for
    from lungaccess.planning.procedure.insertion.truth import Errors, Truth, assumed_errors

__getattr__, __dir__ = lazy_exports(__name__, __file__)

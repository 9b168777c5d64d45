"""How likely a plan succeeds if the devices deviate from it, and how large an error it survives."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.uncertainty.risk.assessment import (
        MISSES,
        DrawnReport,
        RiskReport,
        Sensitivity,
        assess,
        rare_share,
        rare_touch,
    )
    from lungaccess.uncertainty.risk.assessor import STRUCTURES, RiskAssessor
    from lungaccess.uncertainty.risk.deviations import Deviations
    from lungaccess.uncertainty.risk.patient_errors import RestingRow, resting_rows, resting_tip
    from lungaccess.uncertainty.risk.statistics import Share
    from lungaccess.uncertainty.risk.tolerances import (
        LARGEST,
        Tolerance,
        find_tolerances,
        proved_body,
        safe_start_region,
        tried_body,
    )

__getattr__, __dir__ = lazy_exports(__name__, __file__)

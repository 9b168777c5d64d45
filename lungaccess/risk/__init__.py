"""How likely a plan succeeds if the devices deviate from it, and how large an error it survives."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.risk.assessment import RiskReport as RiskReport
    from lungaccess.risk.assessment import assess as assess
    from lungaccess.risk.assessment import safest as safest
    from lungaccess.risk.assessor import STRUCTURES as STRUCTURES
    from lungaccess.risk.assessor import Outcomes as Outcomes
    from lungaccess.risk.assessor import RiskAssessor as RiskAssessor
    from lungaccess.risk.deviations import Deviations as Deviations
    from lungaccess.risk.deviations import Draws as Draws
    from lungaccess.risk.errors import CURVATURE as CURVATURE
    from lungaccess.risk.errors import UNITS as UNITS
    from lungaccess.risk.errors import ErrorModel as ErrorModel
    from lungaccess.risk.errors import load_errors as load_errors
    from lungaccess.risk.statistics import Share as Share
    from lungaccess.risk.tolerances import LARGEST as LARGEST
    from lungaccess.risk.tolerances import Tolerance as Tolerance
    from lungaccess.risk.tolerances import find_tolerances as find_tolerances

__getattr__, __dir__ = lazy_exports(__name__, __file__)

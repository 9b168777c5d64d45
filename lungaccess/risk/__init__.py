"""How likely a plan succeeds if the devices deviate from it, and how large an error it survives."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.risk.assessment import MISSES, RiskReport, assess, rare_touch, safest
    from lungaccess.risk.assessor import STRUCTURES, Outcomes, RiskAssessor, goal_radius
    from lungaccess.risk.deviations import Deviations
    from lungaccess.risk.draws import Draws
    from lungaccess.risk.error_files import DEFAULT_ERRORS, error_preset_names, load_errors
    from lungaccess.risk.errors import (
        CURVATURE,
        UNITS,
        AngleError,
        BreathingError,
        CurvatureError,
        ErrorModel,
        PositionError,
    )
    from lungaccess.risk.rare import RareShare, rare_share
    from lungaccess.risk.sensitivity import Sensitivity, sensitivities
    from lungaccess.risk.start_bodies import proved_body, tried_body
    from lungaccess.risk.start_region import safe_start_region
    from lungaccess.risk.statistics import Share
    from lungaccess.risk.tolerances import LARGEST, Tolerance, find_tolerances

__getattr__, __dir__ = lazy_exports(__name__, __file__)

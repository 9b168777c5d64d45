"""What is said first of a plan: verdict of the check, chance of success, and how near its limits are."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.judging.appraisal.appraiser import (
        DRAWS,
        SEED,
        Appraisal,
        Appraiser,
        appraise,
        plan_record,
    )
    from lungaccess.judging.appraisal.headline import Geometry, Grade, Headline
    from lungaccess.judging.appraisal.limits import LIMITS_TITLE, SHOWN_LIMITS, Limit, limits_of

__getattr__, __dir__ = lazy_exports(__name__, __file__)

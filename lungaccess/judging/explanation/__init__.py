"""What one learns from a `NoPlan`: the nearest misses, what blocks, which system would do, what is proved."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.judging.explanation.blocking import FAILS
    from lungaccess.judging.explanation.explain import DEFAULT_TIME_S, explain_no_plan
    from lungaccess.judging.explanation.explanation import Explanation
    from lungaccess.judging.explanation.words import explanation_record, save_explanation, sections

__getattr__, __dir__ = lazy_exports(__name__, __file__)

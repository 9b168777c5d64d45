"""Whether a plan is true, what it is worth, and why there is none."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.judging.answering import alternatives, answer, answer_with_several, plan

__getattr__, __dir__ = lazy_exports(__name__, __file__)

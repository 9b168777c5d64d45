"""The independent check of a plan: it shares no arithmetic with the planners."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.judging.checking.checker import Checker, check
    from lungaccess.judging.checking.completion import Motions
    from lungaccess.judging.checking.findings import CheckReport, Finding
    from lungaccess.judging.checking.steering import check_needle_alone

__getattr__, __dir__ = lazy_exports(__name__, __file__)

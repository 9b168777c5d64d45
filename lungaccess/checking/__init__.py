"""The independent check of a plan: it shares no arithmetic with the planners."""

from lungaccess.checking.checker import Checker, check
from lungaccess.checking.findings import CheckReport, Finding

__all__ = ["CheckReport", "Checker", "Finding", "check"]

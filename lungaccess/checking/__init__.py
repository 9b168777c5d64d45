"""The independent check of a plan: it shares no arithmetic with the planners."""

from lungaccess.checking.findings import CheckReport, Finding
from lungaccess.checking.judge import Checker, check

__all__ = ["CheckReport", "Checker", "Finding", "check"]

"""The independent check of a plan: it shares no arithmetic with the planners."""

from lungaccess.check.findings import CheckReport, Finding
from lungaccess.check.judge import check

__all__ = ["CheckReport", "Finding", "check"]

"""What the check found: one line for each thing it looked at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike


@dataclass(frozen=True, kw_only=True)
class Finding:
    """One thing that was checked.

    Parameters
    ----------
    name : str
        Stage and property, such as "needle.clearance.vessel".
    ok : bool
    value, limit : float or None
        What was found and the bound it had to keep; None for what is not a number.
    unit : str
    detail : str
        What was compared, in words.
    """

    name: str
    ok: bool
    value: float | None = None
    limit: float | None = None
    unit: str = ""
    detail: str = ""

    def __str__(self) -> str:
        mark = "ok     " if self.ok else "REFUSED"
        number = "" if self.value is None else f" {self.value:.6g} {self.unit}".rstrip()
        bound = "" if self.limit is None else f" (limit {self.limit:.6g} {self.unit}".rstrip() + ")"
        detail = f": {self.detail}" if self.detail else ""
        return f"{mark} {self.name}{number}{bound}{detail}"


@dataclass(frozen=True, kw_only=True)
class CheckReport:
    """The verdict of the check: accepted only if every finding is ok.

    Parameters
    ----------
    accepted : bool
    findings : tuple of Finding
    """

    accepted: bool
    findings: tuple[Finding, ...]

    @property
    def refusals(self) -> tuple[Finding, ...]:
        """The findings that are not ok."""
        return tuple(finding for finding in self.findings if not finding.ok)

    def __str__(self) -> str:
        verdict = "accepted" if self.accepted else f"REFUSED ({len(self.refusals)} findings)"
        return "\n".join([verdict, *(str(finding) for finding in self.findings)])


class Findings:
    """Collects findings."""

    def __init__(self) -> None:
        self._all: list[Finding] = []

    def true(self, name: str, ok: bool | np.bool_, detail: str = "") -> bool:
        """Record a statement that must be true, and return it."""
        self._all.append(Finding(name=name, ok=bool(ok), detail=detail))
        return bool(ok)

    def at_least(self, name: str, value: float, limit: float, unit: str, detail: str = "") -> bool:
        """Record a value that must not be below `limit`."""
        return self._number(name, value >= limit, value, limit, unit, detail)

    def at_most(self, name: str, value: float, limit: float, unit: str, detail: str = "") -> bool:
        """Record a value that must not be above `limit`."""
        return self._number(name, value <= limit, value, limit, unit, detail)

    def agrees(self, name: str, stated: ArrayLike, found: ArrayLike, tolerance: float, unit: str) -> bool:
        """Record the largest difference between a stated and a recomputed value (or array)."""
        a, b = np.asarray(stated, dtype=np.float64), np.asarray(found, dtype=np.float64)
        gap = float(np.abs(a - b).max(initial=0.0)) if a.shape == b.shape else math.inf
        detail = f"stated {float(a):.6g}, recomputed {float(b):.6g}" if a.shape == b.shape == () else ""
        detail = detail or "largest difference of stated and recomputed"
        return self._number(name, gap <= tolerance, gap, tolerance, unit, detail)

    def _number(self, name: str, ok: bool, value: float, limit: float, unit: str, detail: str) -> bool:
        self._all.append(
            Finding(name=name, ok=bool(ok), value=float(value), limit=float(limit), unit=unit, detail=detail)
        )
        return bool(ok)

    def report(self) -> CheckReport:
        """Return what was collected; nothing collected is not accepted."""
        accepted = bool(self._all) and all(finding.ok for finding in self._all)
        return CheckReport(accepted=accepted, findings=tuple(self._all))

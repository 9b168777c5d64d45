"""How near a plan comes to its limits: one row for each that matters, in words and in usual units."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

from anatomy.base.records import frozen_value
from lungaccess.judging.checking import Finding
from lungaccess.judging.checking.clearances import REACH_MM
from lungaccess.judging.checking.findings import PASS
from lungaccess.plans.plan import Plan

SHOWN_LIMITS = 10
"""As many rows as a reader takes in at once; the others are in the list of findings."""
LIMITS_TITLE = "Nearest to a limit; distances are of a device's axis, which needs radius, margins and sweep"

FAR_MM = REACH_MM - 1.0
"""The check measures no farther than `REACH_MM`, less half a step: beyond this the number says nothing."""


@frozen_value
class _Kind:
    """A limit: what it is called, the findings of the check that measure it, and how a number is shown.

    Numbers of the check are multiplied by `scale`; an `inverse` one is shown as its reciprocal, as a radius
    for a curvature.
    """

    what: str
    findings: tuple[str, ...]
    unit: str = "mm"
    scale: float = 1.0
    inverse: bool = False
    digits: int = 2


def _kind(what: str, *findings: str, **shown: Any) -> _Kind:
    return _Kind(what=what, findings=findings, **shown)


ANGLE: dict[str, Any] = {"unit": "°", "scale": math.degrees(1.0), "digits": 1}
STRAIN: dict[str, Any] = {"unit": "%", "scale": 100.0}
RADIUS: dict[str, Any] = {"inverse": True, "digits": 1}
"""Numbers of these kinds are shown so."""

KINDS = (
    _kind("scope to lumen wall", "scope.fits"),
    _kind("tubes to vessel", "tube.clearance.vessel"),
    _kind("tubes to pleura", "tube.clearance.outside"),
    _kind("tubes to fissure", "tube.clearance.fissure"),
    _kind("tubes to other airway", "tube.clearance.airway"),
    _kind("tube bend (strain)", "tube.strain", "tube.strain.outer", "tube.strain.inner", **STRAIN),
    _kind("needle bend in scope (strain)", "needle.strain", **STRAIN),
    _kind("scope radius of curvature", "tube.channel", **RADIUS),
    _kind("bend set at the scope's handle", "scope.handle", **ANGLE),
    _kind("sideways sweep of tubes", "tube.sweep.limit", "tube.sweep.stated_limit"),
    _kind("tubes to wall at exit", "tube.exit.angle.limit", "tube.exit.angle.stated_limit", **ANGLE),
    _kind("tubes in the wall", "tube.wall_run.limit", "tube.wall_run.stated_limit"),
    _kind("extension beyond scope", "tube.extension", digits=1),
    _kind("inner beyond outer tube", "tube.protrusion", digits=1),
    _kind("needle to vessel", "needle.clearance.vessel"),
    _kind("needle to pleura", "needle.clearance.outside"),
    _kind("needle to fissure", "needle.clearance.fissure"),
    _kind("needle to airway", "needle.clearance.airway", "needle.clearance.other_airway"),
    _kind("needle to lumen at exit", "needle.clearance.lumen"),
    _kind("needle radius of curvature", "needle.curvature", **RADIUS),
    _kind("needle length", "needle.length.limit", digits=1),
    _kind("needle angle from start", "needle.angle.limit", **ANGLE),
    _kind("needle turning in all", "needle.turn.limit", **ANGLE),
)
"""Everything that a device or a margin limits; other findings compare statements of the plan."""


@frozen_value
class Limit:
    """One limit, and how near the plan comes to it.

    Args:
        what: What is limited, in words, such as "needle to vessel".
        finding: The finding of the check with the number; of several, the tightest.
        value: What the check measured, in `unit`; None for the radius of a straight needle.
        bound: What it is limited by, in `unit`; of a distance, the device's radius and the margins.
        side: "at least" or "at most".
        used: How much of the limit is used: 1 at the limit, 0 far from it.
        stated: The lower bound that the plan itself states, see docs/explanation/check.md; None for what is
            no clearance.
    """

    what: str
    finding: str
    value: float | None
    bound: float
    side: str
    unit: str
    used: float
    ok: bool
    stated: float | None = None
    digits: int = 2

    @property
    def found_words(self) -> str:
        """The value with its unit."""
        if self.value is None:
            return "straight"
        far = self.unit == "mm" and self.side == "at least" and "clearance" in self.finding
        return f"over {FAR_MM:.0f} mm" if far and self.value > FAR_MM else self._with_unit(self.value)

    @property
    def bound_words(self) -> str:
        """What the value must be, with its unit."""
        return f"{self.side} {self._with_unit(self.bound)}"

    @property
    def used_words(self) -> str:
        """The share of the limit that is used, rounded down, so that only a plan at its limit uses 100 %."""
        return f"{math.floor(100.0 * self.used)} %" if math.isfinite(self.used) else "–"

    @property
    def comparison(self) -> str:
        """Value and bound in one short clause, such as "2.60 mm ≥ 1.00"."""
        sign = "≥" if self.side == "at least" else "≤"
        return f"{self.found_words} {sign} {self.bound:.{self.digits}f}"

    @property
    def words(self) -> str:
        """The row as a clause, such as "needle to vessel 2.60 mm, at least 1.00 mm"."""
        return f"{self.what} {self.found_words}, {self.bound_words}"

    def _with_unit(self, number: float) -> str:
        return f"{number:.{self.digits}f}{'' if self.unit == '°' else ' '}{self.unit}"

    def to_mapping(self) -> dict[str, object]:
        """Return the row as plain JSON values."""
        values = asdict(self) | {"used": self.used if math.isfinite(self.used) else None}
        del values["digits"]
        return values


def limits_of(findings: Iterable[Finding], plan: Plan | None = None) -> tuple[Limit, ...]:
    """Return the limits among the findings of a check: broken ones first, then by how near the limit is.

    The numbers are those that the check measured, of the pass that comes nearest.  A plan, if given, adds the
    clearances that it states.
    """
    by_name: dict[str, list[Finding]] = {}
    for each in findings:
        name = each.name.split(".", 1)[1] if each.stage.startswith(PASS) else each.name
        by_name.setdefault(name, []).append(each)
    rows = [_limit(kind, by_name, plan) for kind in KINDS]
    return tuple(sorted((row for row in rows if row is not None), key=lambda row: (row.ok, -row.used)))


def _limit(kind: _Kind, findings: dict[str, list[Finding]], plan: Plan | None) -> Limit | None:
    """Return the row of a kind from its tightest finding; None if nothing limits it here."""
    measured = [found for name in kind.findings for found in findings.get(name, ()) if found.side is not None]
    if not measured:
        return None
    tightest = max(measured, key=lambda found: (not found.ok, _used(found)))
    value, bound = _shown(kind, tightest.value), _shown(kind, tightest.limit)
    side = tightest.side or ""
    return Limit(
        what=kind.what,
        finding=tightest.name,
        value=value,
        bound=bound if bound is not None else 0.0,
        side={"at most": "at least", "at least": "at most"}[side] if kind.inverse else side,
        unit=kind.unit,
        used=_used(tightest),
        ok=all(found.ok for found in measured),
        stated=None if plan is None else _stated(kind.findings, plan),
        digits=kind.digits,
    )


def _used(finding: Finding) -> float:
    """Return the share of a limit that is used, comparable between units; infinite beyond all measure."""
    value, limit = finding.value or 0.0, finding.limit or 0.0
    part, whole = (limit, value) if finding.side == "at least" else (value, limit)
    if part <= 0.0:
        return 0.0
    return part / whole if whole > 0.0 else math.inf


def _shown(kind: _Kind, number: float | None) -> float | None:
    if number is None or (kind.inverse and number <= 0.0):
        return None
    return 1.0 / number if kind.inverse else kind.scale * number


def _stated(findings: Sequence[str], plan: Plan) -> float | None:
    """Return the clearance that the plan states for the first of some findings."""
    device, kind, *structure = findings[0].split(".")
    if kind != "clearance" or not structure:
        return None
    return plan.clearance_mm.get(device, {}).get(structure[0])

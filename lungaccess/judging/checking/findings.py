"""Findings hold what the check found, a line each; poses and directions are compared here, too."""

import math
from collections.abc import Sequence
from html import escape
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.display import title

PASS = "pass_"
"""Names of what was found of a further pass begin with this and its number."""
Side = Literal["at least", "at most"]
_HEADINGS = ("", "what", "found", "limit", "margin", "")
Row = tuple[str, ...]
"""The cells of one finding, in the order of the headings; see `Finding.cells`."""


@frozen_value
class Finding:
    """One thing that was checked.

    Args:
        name: Stage and property, such as "needle.clearance.vessel".
        ok: None for what could not be checked.
        value, limit: What was found and the bound it had to keep; None for what is not a number.
        side: Whether the value must be "at least" or "at most" the limit; None without a limit.
        tolerance: It is ok if it misses the limit by no more than this.
    """

    name: str
    ok: bool | None
    value: float | None = None
    limit: float | None = None
    side: Side | None = None
    tolerance: float = 0.0
    unit: str = ""
    detail: str = ""

    @property
    def margin(self) -> float | None:
        """Distance of the value from its limit, positive inside; None for what has no limit."""
        if self.value is None or self.limit is None:
            return None
        return self.value - self.limit if self.side == "at least" else self.limit - self.value

    @property
    def stage(self) -> str:
        """First word of the name: what it is about."""
        return self.name.split(".")[0]

    @property
    def verdict(self) -> str:
        """What the check says in a word or two: "ok", "REFUSED" or "not checked"."""
        return "not checked" if self.ok is None else "ok" if self.ok else "REFUSED"

    def __str__(self) -> str:
        unit = f" {self.unit}" if self.unit else ""
        number = "" if self.value is None else f" {self.value:.6g}{unit}"
        spare = f", tolerance {self.tolerance:.3g}" if self.tolerance else ""
        bound = f" ({self.side} {self.limit:.6g}, margin {self.margin:.3g}{spare})" if self.side else ""
        detail = f": {self.detail}" if self.detail else ""
        return f"{self.verdict:7} {self.name}{number}{bound}{detail}"

    def cells(self) -> tuple[str, ...]:
        """Return what a row of a table says: verdict, name, value, limit, margin and detail."""
        unit = f" {self.unit}" if self.unit else ""
        return (
            self.verdict,
            self.name,
            "" if self.value is None else f"{self.value:.4g}{unit}",
            "" if self.side is None else f"{self.side} {self.limit:.4g}",
            "" if self.margin is None else f"{self.margin:.3g}",
            self.detail,
        )

    def to_mapping(self) -> dict[str, object]:
        """Return plain JSON values; a number that is not finite becomes None."""
        numbers = {"value": self.value, "limit": self.limit, "margin": self.margin}
        finite = {key: n if n is not None and math.isfinite(n) else None for key, n in numbers.items()}
        words = {"name": self.name, "stage": self.stage, "ok": self.ok, "side": self.side}
        return {**words, **finite, "tolerance": self.tolerance, "unit": self.unit, "detail": self.detail}


@frozen_value
class CheckReport:
    """The verdict of the check: accepted only if no finding is refused; what is not checked is listed."""

    accepted: bool
    findings: tuple[Finding, ...]

    def _repr_html_(self) -> str:
        """Return what a notebook shows; accepted geometry is not green, as it says nothing of success."""
        rows, refused = ([each.cells() for each in some] for some in (self.findings, self.refusals))
        verdict = "accepts the plan" if self.accepted else f"REFUSES the plan ({len(refused)} findings)"
        colour = "inherit" if self.accepted else "#c00000"
        everything = f"<details><summary>{len(rows)} findings</summary>{_table(rows)}</details>"
        return (
            f'<div style="color:{colour}">{title(f"The independent check {verdict}")}</div>'
            f"{_table(refused) if refused else ''}{everything}"
        )

    @property
    def refusals(self) -> tuple[Finding, ...]:
        """The findings that are not ok."""
        return tuple(finding for finding in self.findings if finding.ok is False)

    @property
    def unchecked(self) -> tuple[Finding, ...]:
        """What could not be checked."""
        return tuple(finding for finding in self.findings if finding.ok is None)

    def to_mapping(self) -> dict[str, object]:
        """Return the report as plain JSON values."""
        findings = [each.to_mapping() for each in self.findings]
        unchecked = [each.name for each in self.unchecked]
        return {"accepted": self.accepted, "not_checked": unchecked, "findings": findings}

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

    def unchecked(self, name: str, detail: str) -> None:
        """Record what could not be checked, and why."""
        self._all.append(Finding(name=name, ok=None, detail=detail))

    def measured(self, name: str, value: float, unit: str, detail: str) -> None:
        """Record what was measured where nothing limits it."""
        self._all.append(Finding(name=name, ok=True, value=float(value), unit=unit, detail=detail))

    def at_least(
        self, name: str, value: float, limit: float, unit: str, detail: str = "", tolerance: float = 0.0
    ) -> bool:
        """Record a value that must not be below `limit` by more than `tolerance`."""
        said = {"unit": unit, "detail": detail, "tolerance": tolerance}
        return self._bounded(name, value >= limit - tolerance, value, limit, "at least", **said)

    def at_most(
        self, name: str, value: float, limit: float, unit: str, detail: str = "", tolerance: float = 0.0
    ) -> bool:
        """Record a value that must not be above `limit` by more than `tolerance`."""
        said = {"unit": unit, "detail": detail, "tolerance": tolerance}
        return self._bounded(name, value <= limit + tolerance, value, limit, "at most", **said)

    def agrees(self, name: str, stated: ArrayLike, found: ArrayLike, largest: float, unit: str) -> bool:
        """Record the largest difference between a stated and a recomputed value (or array)."""
        a, b = np.asarray(stated, dtype=np.float64), np.asarray(found, dtype=np.float64)
        gap = float(np.abs(a - b).max(initial=0.0)) if a.shape == b.shape else math.inf
        detail = f"stated {float(a):.6g}, recomputed {float(b):.6g}" if a.shape == b.shape == () else ""
        return self.at_most(name, gap, largest, unit, detail or "largest difference of stated and recomputed")

    def _bounded(self, name: str, ok: bool, value: float, limit: float, side: Side, **said: Any) -> bool:
        made = Finding(name=name, ok=bool(ok), value=float(value), limit=float(limit), side=side, **said)
        self._all.append(made)
        return bool(ok)

    def report(self) -> CheckReport:
        """Return what was collected; nothing collected is not accepted."""
        accepted = any(each.ok for each in self._all) and all(each.ok is not False for each in self._all)
        return CheckReport(accepted=accepted, findings=tuple(self._all))


def _table(rows: Sequence[Row]) -> str:
    head = "".join(f"<th>{heading}</th>" for heading in _HEADINGS)
    cells = ("".join(f'<td style="text-align:left">{escape(cell)}</td>' for cell in row) for row in rows)
    return f"<table><tr>{head}</tr>{''.join(f'<tr>{row}</tr>' for row in cells)}</table>"


POSITION_TOLERANCE_MM = 1e-3
"""Closed form and integration agree far better; a device cannot be placed to a micrometre."""
ANGLE_TOLERANCE_RAD = 1e-4
"""Over 100 mm of needle an angle of this size moves the tip by 0.01 mm."""
LENGTH_TOLERANCE_MM = 1e-6
"""Lengths are sums of a few numbers and agree up to rounding."""


def angle_between(a: Float, b: Float) -> Float:
    """Return the angles in rad between vectors `(..., 3)`, accurate for small ones too."""
    return np.asarray(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1)))


def check_rigid(name: str, pose: Float, found: Findings) -> bool:
    """Record whether a 4x4 matrix is a rigid, right-handed pose."""
    rotation = pose[:3, :3]
    error = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    # Rounding of a matrix that is the product of a hundred rotations is less by far.
    rigid = error <= 1e-6 and float(np.linalg.det(rotation)) > 0.0
    rigid &= bool(np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]))
    return found.true(f"{name}.rigid", rigid, f"deviation from a rotation {error:.2g}")


def check_same_pose(name: str, stated: Float, recomputed: Float, found: Findings) -> None:
    """Record whether two poses agree in position and in every axis."""
    found.agrees(f"{name}.position", stated[:3, 3], recomputed[:3, 3], POSITION_TOLERANCE_MM, "mm")
    gap = float(angle_between(stated[:3, :3].T, recomputed[:3, :3].T).max())
    found.at_most(f"{name}.direction", gap, ANGLE_TOLERANCE_RAD, "rad", "largest angle between the axes")

"""Studies of a coarse synthetic patient, whose runs take a fraction of a second."""

from __future__ import annotations

from typing import Any

from lungaccess.running.study.runs import EXACT, PLAN, Answer, Improvement, Run

NEAR = "lps:-81.25,51,-33.5"
OUTSIDE = "lps:300,0,0"


def content(**changes: Any) -> dict[str, Any]:
    """Return the plain values of a study with two targets, one of them outside the lung."""
    case = {
        "name": "coarse",
        "anatomy": "phantom",
        "phantom": {"seed": 2, "spacing_mm": 2.5},
        "system": "ultrathin",
        "fissures_allowed": True,
        "targets": [NEAR, OUTSIDE],
    }
    values: dict[str, Any] = {
        "name": "small",
        "case": [case | changes.pop("case", {})],
        "planner": [{"name": "atlas"}],
        "seeds": [0, 1],
        "budget": {"iterations": 2},
        "atlas": {"rotations": 8, "stop_spacing_mm": 8, "site_spacing_mm": 4},
    }
    return values | changes


def toy_answer(run: Run, **changes: Any) -> Answer:
    """Return an answer that no planner made."""
    finding = {
        "name": "needle.length", "ok": True, "value": 1.5, "limit": 2.0, "side": "at most", "tolerance": 0.0,
        "unit": "mm", "detail": "",
    }  # fmt: skip
    values: dict[str, Any] = {
        "key": run.key,
        "outcome": PLAN,
        "status": EXACT,
        "time_s": 0.25,
        "cpu_s": 0.2,
        "iterations": 7,
        "accepted": True,
        "costs": {"inverse_clearance": 0.1 + 0.2, "cost_map": 0.0, "voxel_sum": 3.0, "length_mm": 40.0},
        "improvements": (
            Improvement(time_s=0.01, iteration=0, cost=1.0),
            Improvement(time_s=0.02, iteration=7, cost=0.1 + 0.2),
        ),
        "findings": (finding,),
        "plan": '{"schema": "toy", "timing": {"planning_s": 0.02}}',
        "digest": "0" * 64,
    }
    return Answer(**values | changes)

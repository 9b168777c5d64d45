"""What most tests of this folder plan: a system, targets in the small phantom, and a budget."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np

import lungaccess as la
from anatomy.grid import Volume
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.problem.target import Target
from stages.needle import TERMS

SYSTEM = la.load_system("ultrathin")
ITERATIONS = 150
KEYS = [term.key for term in TERMS]
KUNTZ_TARGET, KUNTZ_SEED = "lps:-55.0,50.5,-56.5", 3
"""A target and a seed with which random placement finds paths of several arcs within 2,000 draws."""
TARGET = "lps:-45.6,47.0,-65.1"
"""One to which many direct arcs are clear."""


def plans_of(lung: Lung, target: Target, atlas: la.Atlas, **options: Any) -> list[Plan]:
    return list(
        la.plan(lung, SYSTEM, target, atlas=atlas, **{"iterations": ITERATIONS, "goal": "default", **options})
    )


def mapped(lung: Lung) -> Lung:
    """A cost map between 0.2 and 1, higher where y is."""
    share = np.linspace(0.2, 1.0, lung.grid.shape[1], dtype=np.float32)
    values = np.asfortranarray(np.broadcast_to(share[None, :, None], lung.grid.shape))
    return replace(lung, cost=Volume(grid=lung.grid, array=values))


def same_run(plans: list[Plan]) -> list[str]:
    records = [json.loads(plan.to_json()) for plan in plans]
    return [json.dumps({k: v for k, v in r.items() if k != "timing"}, sort_keys=True) for r in records]

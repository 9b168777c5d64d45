"""Pages for tests: of plans and of a map of the small phantom."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import lungaccess as la
from anatomy.grid import Volume
from anatomy.lung import Lung
from lungaccess.planning.reachability.reach_map import ReachMap, map_reach
from lungaccess.plans.plan import Plan
from lungaccess.plans.window import BreathingWindow, WindowLimit
from lungaccess.showing.report.html import PageOptions, plan_page, reach_page

SYSTEM = la.load_system("ultrathin")
SIZE_LIMIT = 15_000_000


def make_plans(lung: Lung, atlas: la.Atlas) -> tuple[Plan, ...]:
    """Return the best plan to a nodule, and the first one that was found."""
    found = list(la.plan(lung, SYSTEM, la.resolve_target(lung), atlas=atlas, iterations=60, goal="default"))
    return found[-1], found[0]


def make_reach(lung: Lung) -> ReachMap:
    """Return a coarse map."""
    atlas = la.build_atlas(lung, SYSTEM, rotations=8, stop_spacing_mm=6.0, site_spacing_mm=5.0)
    return map_reach(lung, SYSTEM, spacing_mm=9.0, atlas=atlas)


def plan_file(plans: tuple[Plan, ...], lung: Lung, ct: Volume | None, folder: Path) -> Path:
    """Write the page of a plan with an alternative, with or without a CT."""
    table = folder / "cost_over_time.csv"
    table.write_text("elapsed_s,iteration,best\n0.1,0,\n0.5,3,9.5\n1.25,8,7.0\n")
    options = PageOptions(
        alternatives=plans[1:],
        ct=ct,
        ct_name="" if ct is None else "simulated",
        cost_over_time=table,
        risk_samples=200,
    )
    return plan_page(plans[0], lung, folder / "report.html", options)


def reach_file(reach: ReachMap, lung: Lung, folder: Path) -> Path:
    """Write the page of a map."""
    return reach_page([reach], lung, folder / "reach.html")


def report_data(page: Path) -> dict[str, Any]:
    """Return the data of a page."""
    found = re.search(r'<script type="application/json" id="report-data">(.*?)</script>', page.read_text())
    assert found is not None
    return dict(json.loads(found.group(1)))


def with_stated_window(plan: Plan, lung: Lung) -> Plan:
    """Return a plan that states a window of the last 40 % before end-inhale."""
    motion = lung.motion
    assert motion is not None
    return replace(plan, window=replace(WINDOW, motion_key=motion.key, motion_source=motion.source))


WINDOW = BreathingWindow(
    motion_key="",
    motion_source="stated",
    warning_only=False,
    masks_phase=1.0,
    amplitude=1.0,
    tolerance_mm=2.0,
    phases=np.array([[0.6, 1.0]]),
    undecided_share=0.0,
    limits=(
        WindowLimit(
            phase=0.6,
            reason="vessel",
            device="needle",
            arc_length_mm=12.3,
            place_lps=np.array([1.0, 2.0, 3.0]),
        ),
    ),
)

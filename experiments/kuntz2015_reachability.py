"""Share of random peripheral targets with a plan, by planning time, as in [Kuntz2015, fig. 8].

    python experiments/kuntz2015_reachability.py PATIENT [--targets 50] [--time 10] [--method atlas]

Targets are drawn per lung, 5 to 25 mm from the pleura and at least 3 mm clear of airway, vessels and
pleura.  Their lung is a commercial model that cannot be had, so the numbers compare methods and devices
on your patient, not with the paper.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import replace

import numpy as np

import lungaccess as la
from anatomy.grid import Float
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL
from lungaccess.atlas import Atlas
from lungaccess.target import point_target

PLEURA_MM = (5.0, 25.0)
CLEAR_MM = 3.0
TIMES_S = (0.1, 1.0, 10.0, 60.0, 3600.0)
PAPER = {1.0: 36, 60.0: 70, 3600.0: 75}


def peripheral_targets(lung: Lung, per_lung: int, seed: int) -> Float:
    """Return `(2 per_lung, 3)` LPS mm points, the patient's left lung first."""
    rng = np.random.default_rng(seed)
    midline = lung.tree.carina_lps[0]
    points = []
    for side in (1.0, -1.0):
        while len(points) < per_lung * (1 if side > 0 else 2):
            point = lung.grid.lps(rng.uniform(-0.5, np.array(lung.grid.shape) - 0.5))
            if (point[0] - midline) * side > 0 and _is_peripheral(lung, point):
                points.append(point)
    return np.array(points)


def _is_peripheral(lung: Lung, point: Float) -> bool:
    if lung.label_at(point) & (AIRWAY | VESSEL | OUTSIDE | FISSURE):
        return False
    low, high = PLEURA_MM
    return bool(
        low <= lung.fields["pleura"].lower_bound_mm(point)[0] <= high
        and lung.fields["obstacle"].lower_bound_mm(point)[0] >= CLEAR_MM
    )


def time_to_first_plan(atlas: Atlas, point: Float, method: str, time_s: float, seed: int) -> float:
    """Return the planning time of the first plan, infinite if there is none within `time_s`."""
    began = time.perf_counter()
    target = point_target(atlas.lung, point)
    try:
        plans = la.plan(
            atlas.lung, atlas.system, target, atlas=atlas, method=method, time_s=time_s, seed=seed
        )
        found = next(plans)
    except la.NoPlan:
        return float("inf")
    elapsed = time.perf_counter() - began
    report = la.check(found, atlas.lung)
    if not report.accepted:
        refused = [finding.name for finding in report.findings if not finding.ok]
        sys.stdout.write(f"REFUSED by check: {point.tolist()}: {refused}\n")
    return elapsed


def main() -> None:
    """Run the study and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("patient")
    parser.add_argument("--targets", type=int, default=50, help="per lung")
    parser.add_argument("--time", type=float, default=10.0, help="planning time per target, s")
    parser.add_argument("--method", default="atlas")
    parser.add_argument("--system", default="lung-default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--cache", default=None)
    options = parser.parse_args()
    lung = la.load_patient(options.patient, cache=options.cache)
    points = peripheral_targets(lung, options.targets, options.seed)
    preset = la.load_system(options.system)
    for name, allowed in (("fissures are obstacles", False), ("fissures may be crossed", True)):
        system = replace(preset, name=f"{preset.name}, {name}", fissures_allowed=allowed)
        atlas = la.build_atlas(lung, system)
        times = np.array(
            [time_to_first_plan(atlas, p, options.method, options.time, options.seed) for p in points]
        )
        sys.stdout.write(f"{lung.name}, {options.method}, {name}: atlas {atlas.build_s:.1f} s\n")
        for limit in (t for t in TIMES_S if t <= options.time):
            share = 100.0 * float((times <= limit).mean())
            paper = f"  (paper, another lung: {PAPER[limit]} %)" if limit in PAPER else ""
            sys.stdout.write(f"  within {limit:g} s: {share:.0f} %{paper}\n")


if __name__ == "__main__":
    main()

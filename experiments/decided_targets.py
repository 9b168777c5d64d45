"""How many peripheral targets are decided: by a plan that the check accepts, or a proof that there is none.

    python -m experiments.decided_targets [--quick] [--results FOLDER] [--patients NAME ...] [--system NAME]

The planner has `PLAN_S` seconds for its first plan, and the proof has the rest of `DECIDE_S`.  The proof is
also offered, with few boxes, every target that has a plan: it must never rule one out.  What is finished is
kept in a file for each patient beside the result, and a run that was stopped goes on from there.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import lungaccess as la
from anatomy.base.files import write_text
from anatomy.base.typed import Float
from experiments.support.anatomies import anatomy, default_anatomies
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.planning.reachability import UnreachableProof
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.system import System, system_fingerprint
from lungaccess.problem.target import point_target

RADII_MM = (121.0, 50.0)
"""Of the needle."""
PLAN_S, DECIDE_S = 20.0, 60.0
"""Most time for the first plan, and for plan and proof together, s."""
BOXES_OF_A_PLANNED = 200_000
TARGETS_A_LUNG, QUICK_TARGETS_A_LUNG = 50, 2
PLANNED, PROVED, OPEN = "planned", "proved unreachable", "open"


class Decider:
    """Decides targets of one patient for one system; the atlas and the deployment space are made first."""

    def __init__(self, atlas: la.Atlas, system: System) -> None:
        self._atlas, self._system = atlas, system
        began = time.perf_counter()
        self._proof = UnreachableProof(atlas.lung, system, with_fissures=atlas.with_fissures)
        self.prepared_s = time.perf_counter() - began

    def record(self, point: Float, seed: int) -> dict[str, Any]:
        """Return the outcome of a target, with seconds, and the share of the deployments ruled out.

        Raises:
            AssertionError: If a target has a plan that the check accepts, and the proof rules it out.
        """
        lung, system = self._atlas.lung, self._system
        began = time.perf_counter()
        found = la.plan(
            lung,
            system,
            point_target(lung, point),
            atlas=self._atlas,
            seed=seed,
            first_plan_s=PLAN_S,
            counterfactuals=False,
            goal="default",
        )
        try:
            plan = next(found)
        except la.NoPlan:
            left = DECIDE_S - (time.perf_counter() - began)
            verdict = self._proof.prove(point, time_s=left, most_boxes=2**62)
            outcome = PROVED if verdict.proved else OPEN
            share = verdict.share_ruled_out
        else:
            if not la.check(plan, lung, system).accepted:
                raise AssertionError(f"The check refuses the plan to {point.tolist()}")
            outcome, share = PLANNED, 0.0
        seconds = time.perf_counter() - began
        if outcome == PLANNED and self._proof.prove(point, most_boxes=BOXES_OF_A_PLANNED).proved:
            raise AssertionError(f"{point.tolist()} has a plan and is ruled out")
        return {"lps_mm": point.tolist(), "outcome": outcome, "seconds": seconds, "share_ruled_out": share}


class Records:
    """The outcomes that are finished, in a file."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._records: dict[str, dict[str, Any]] = json.loads(file.read_text()) if file.exists() else {}

    def of(self, atlas: la.Atlas, system: System, points: Float, seed: int) -> list[dict[str, Any]]:
        """Return the outcome of each point, as kept or else made and kept."""
        common = f"{atlas.lung.key} {system_fingerprint(system)} {seed}"
        keys = [f"{common} {np.round(point, 3).tolist()}" for point in points]
        decider = Decider(atlas, system) if any(key not in self._records for key in keys) else None
        for key, point in zip(keys, points, strict=True):
            if decider is not None and key not in self._records:
                self._records[key] = decider.record(point, seed)
                self._file.parent.mkdir(parents=True, exist_ok=True)
                write_text(self._file, json.dumps(self._records, indent=1))
        return [self._records[key] for key in keys]


def systems(preset: str) -> Iterator[tuple[str, System]]:
    """Yield a preset that may cross fissures with each needle, in words and as a system."""
    system = la.load_system(preset, fissures_allowed=True)
    for radius in RADII_MM:
        needle = replace(system.require_needle("The study"), max_curvature_per_mm=1.0 / radius)
        label = f"{preset}, R = {radius:g} mm"
        yield label, replace(system, name=label, needle=needle)


def add_rows(result: Result, label: str, records: list[dict[str, Any]]) -> None:
    """Add to a result what came out for the targets of one patient and system."""
    for outcome in (PLANNED, PROVED, OPEN):
        count = sum(record["outcome"] == outcome for record in records)
        result.add(f"{label}: {outcome}", 100.0 * count / len(records), unit="%")
    seconds = np.array([record["seconds"] for record in records])
    result.add(f"{label}: time to decide, median", float(np.median(seconds)), unit="s")
    shares = [record["share_ruled_out"] for record in records if record["outcome"] == OPEN]
    if shares:
        result.add(
            f"{label}: deployments ruled out of open targets, median",
            100.0 * float(np.median(shares)),
            unit="%",
        )


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--patients", nargs="+", default=default_anatomies())
    parser.add_argument("--system", default="lung-default")
    options = parser.parse_args()
    per_lung = QUICK_TARGETS_A_LUNG if options.quick else TARGETS_A_LUNG
    setting = setting_of(options)
    result = Result(
        name="decided_targets",
        title="Peripheral targets that are decided",
        setting=setting,
        seeds=[options.seed],
        conditions={
            "targets": f"{2 * per_lung} random peripheral points a patient",
            "fissures": "may be crossed",
            "time": f"{PLAN_S:g} s for a first plan, {DECIDE_S:g} s with the proof, after the preparation",
        },
    )
    finished = Path(options.results) / setting / "decided_targets_finished"
    for patient in options.patients[:1] if options.quick else options.patients:
        lung, records = anatomy(patient), Records(finished / f"{patient}.json")
        points = peripheral_targets(lung, per_lung, options.seed)
        atlas = la.build_atlas(lung, la.load_system(options.system, fissures_allowed=True))
        for label, system in systems(options.system):
            add_rows(result, f"{lung.name}, {label}", records.of(atlas, system, points, options.seed))
    write_result(result, options.results)


if __name__ == "__main__":
    main()

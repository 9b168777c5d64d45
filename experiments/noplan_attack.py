"""Look for plans where the planner says there is none: reference mode on the targets with NoPlan.

    python -m experiments.noplan_attack PATIENT RESULTS.json [--system thin-scope] [--time 60]

Random peripheral targets, see `lungaccess.problem.peripheral`.  Where the planner gives up, Algorithm 1 of
[Kuntz2015] searches with FCL on meshes for `--time` s of processor time.  A plan of it that the check
accepts is a defect of the planner: "missed" if the planner's proof accepts it too, "refused" if the proof
alone stands against it.  Such plans are written beside the results.

Results are written after every target; run again, targets that are done are passed over.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lungaccess as la
from anatomy.base.errors import SettingsError
from anatomy.base.files import atomic_write
from anatomy.base.typed import Float
from lungaccess.planning.coupled.atlas import Atlas
from lungaccess.planning.coupled.kuntz2015_fcl.needle import Obstacles
from lungaccess.planning.coupled.kuntz2015_fcl.search import FOUND, ReferenceSearch, obstacles_for
from lungaccess.plans.assemble import assemble
from lungaccess.plans.candidate import Candidate
from lungaccess.plans.plan import Plan
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.system import system_fingerprint
from lungaccess.problem.target import point_target
from lungaccess.problem.task import Task

RRT_TIME_S = 0.05
MISSED, REFUSED = "missed", "refused"


@dataclass
class Attack:
    """The attack on one patient and system: the planner may take `planner_s`, the reference `time_s`."""

    atlas: Atlas
    planner_s: float
    time_s: float
    seed: int
    obstacles: Obstacles | None = None

    def result(self, point: Float) -> tuple[dict[str, Any], Plan | None]:
        """Return what came out for one target, and the plan that ought not to be."""
        target = point_target(self.atlas.lung, point)
        system = self.atlas.system
        try:
            next(
                la.plan(
                    self.atlas.lung,
                    system,
                    target,
                    atlas=self.atlas,
                    seed=self.seed,
                    time_s=self.planner_s,
                    goal="default",
                )
            )
        except la.NoPlan as reason:
            said = str(reason)
        else:
            return {"planner": "plan"}, None
        task = Task(lung=self.atlas.lung, system=system, target=target, method="reference", seed=self.seed)
        self.obstacles = self.obstacles or obstacles_for(task)
        self.obstacles.prepare()
        search = ReferenceSearch(task, self.atlas, rrt_time_s=RRT_TIME_S, obstacles=self.obstacles)
        outcome, plan, iterations, unaccepted = self._run(search)
        record = {
            "planner": said,
            "reference": outcome,
            "iterations": iterations,
            "found": search.counts[FOUND],
            "refused_by_proof": dict(Counter(refusal.stage for refusal in search.refused_by_proof)),
            "not_accepted_because": dict(unaccepted),
            "counts": dict(search.counts),
        }
        return record, plan

    def _run(self, search: ReferenceSearch) -> tuple[str, Plan | None, int, Counter[str]]:
        """Search until the check accepts something or the time is up."""
        began, judged, iteration = time.process_time(), 0, 0
        unaccepted: Counter[str] = Counter()
        for step in search.steps():
            iteration = step.iteration
            found: list[tuple[str, Candidate]] = []
            if step.candidate is not None:
                found.append((MISSED, step.candidate))
            found += [(REFUSED, refusal.candidate) for refusal in search.refused_by_proof[judged:]]
            judged = len(search.refused_by_proof)
            for outcome, candidate in found:
                plan = assemble(search.task, candidate, iteration=iteration, timing={})
                report = la.check(plan, self.atlas.lung, self.atlas.system)
                if report.accepted:
                    return outcome, plan, iteration, unaccepted
                unaccepted.update(f"{outcome}: {f.name}" for f in report.findings if not f.ok)
            if time.process_time() - began > self.time_s:
                break
        return "nothing", None, iteration, unaccepted


def opened(path: Path, settings: dict[str, Any]) -> dict[str, Any]:
    """Return the results so far; those of other settings are not continued."""
    if not path.exists():
        return {"settings": settings, "targets": {}}
    results: dict[str, Any] = json.loads(path.read_text())
    if results["settings"] != settings:
        raise SettingsError(
            f"{path} holds the results of another study: {results['settings']}",
            expected=str(settings),
            remedy="Name another file",
        )
    return results


def main() -> None:
    """Run what is left of the study, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("patient")
    parser.add_argument("results", type=Path)
    parser.add_argument("--system", default="thin-scope")
    parser.add_argument("--targets", type=int, default=50, help="per lung")
    parser.add_argument("--time", type=float, default=60.0, help="processor time of the reference, s")
    parser.add_argument("--planner-time", type=float, default=10.0, help="time of the planner, s")
    parser.add_argument("--at-most", type=int, default=None, help="stop after so many attacked targets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--allow-fissures", action="store_true")
    parser.add_argument("--cache", default=None)
    options = parser.parse_args()
    lung = la.load_patient(options.patient, cache=options.cache)
    system = la.load_system(options.system, fissures_allowed=options.allow_fissures)
    settings = {
        "lung": lung.key,
        "system": system_fingerprint(system),
        "targets": options.targets,
        "time_s": options.time,
        "planner_s": options.planner_time,
        "seed": options.seed,
    }
    results = opened(options.results, settings)
    attack = Attack(la.build_atlas(lung, system), options.planner_time, options.time, options.seed)
    attacked = 0
    for number, point in enumerate(peripheral_targets(lung, options.targets, 0)):
        if str(number) in results["targets"]:
            continue
        if options.at_most is not None and attacked >= options.at_most:
            break
        record, plan = attack.result(point)
        attacked += "reference" in record
        if plan is not None:
            record["plan"] = f"{options.results.stem}-target-{number}.json"
            plan.save(options.results.with_name(record["plan"]))
        results["targets"][str(number)] = {"lps_mm": point.tolist(), **record}
        with atomic_write(options.results) as temporary:
            temporary.write_text(json.dumps(results, indent=1) + "\n")
        sys.stdout.write(f"target {number}: {record['planner']}; {record.get('reference', '')}\n")
        sys.stdout.flush()
    sys.stdout.write(summary(results["targets"]))


def summary(targets: dict[str, dict[str, Any]]) -> str:
    """Return how many targets were attacked, and the defects."""
    attacked = {number: record for number, record in targets.items() if "reference" in record}
    outcomes = Counter(record["reference"] for record in attacked.values())
    lines = [
        f"{len(targets)} targets, {len(targets) - len(attacked)} with a plan, {len(attacked)} attacked",
        f"paths found by the reference: {sum(record['found'] for record in attacked.values())}",
        f"accepted by the check, missed by the planner: {outcomes[MISSED]}",
        f"accepted by the check, refused by the proof: {outcomes[REFUSED]}",
    ]
    lines += [f"  target {n}: {r['plan']}" for n, r in attacked.items() if "plan" in r]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()

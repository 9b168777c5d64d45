"""Attack the check: it must accept every plan of the planner, and refuse every mutated one.

    python -m experiments.check_attack PATIENT|phantom [--plans 200] [--mutants 1] [--seed 0] [--out FILE]
        [--keep FOLDER]
    python -m experiments.check_attack --table FILE

Plans come in batches: a random system (a preset or one of its own), a coarse atlas, targets all over the
lung, several plans a target from the diverse set of alternatives, the search, its refinement, Algorithm 1 of
[Kuntz2015] and random needles of several arcs (`random_plans`).  Each is checked, and so are random mutants
of each (`mutants.all.MUTATIONS`).  A line of FILE is a plan or a mutant; a batch follows from patient and
number alone, and one that FILE holds is not made again, so that an interrupted run goes on where it was.
A plan that is refused and a mutant that is accepted are kept in FOLDER.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

import lungaccess as la
from anatomy.base.typed import Float
from anatomy.build import build_lung
from anatomy.lung import Lung
from anatomy.phantom import make_phantom
from experiments.support.mutants.all import mutate
from experiments.support.mutants.mutant import Case, Mutant
from experiments.support.mutants.random_plans import plans_of_batch
from lungaccess.judging.checking import Checker, CheckReport
from lungaccess.planning.coupled import explanation
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import System

PHANTOM_SEED = 1


class PlanCheck:
    """Checks plans and mutants of one lung."""

    def __init__(self, lung: Lung) -> None:
        self.lung = lung
        self._checker = Checker(lung)
        self._edited = EditedLung(lung)

    def of_plan(self, plan: Plan, system: System, asked_lps: Float) -> CheckReport:
        """Check a plan as its user would."""
        return self._checker.check(plan, system, target_lps=asked_lps)

    def of_mutant(self, mutant: Mutant, system: System, asked_lps: Float) -> CheckReport:
        """Check a mutant, with its voxel if it has one."""
        if mutant.voxel is None:
            asked = {"system": system, "target_lps": asked_lps} if mutant.asked else {}
            return self._checker.check(mutant.plan, **asked)
        voxel = tuple(mutant.voxel)
        old, self._edited.labels[voxel] = self._edited.labels[voxel], mutant.label
        try:
            return Checker(self._edited).check(mutant.plan)  # type: ignore[arg-type]
        finally:
            self._edited.labels[voxel] = old


class EditedLung:
    """A lung whose labels can be changed."""

    def __init__(self, lung: Lung) -> None:
        self._lung = lung
        self.labels = lung.labels.copy(order="F")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._lung, name)


def attack(check: PlanCheck, patient: str, number: int, mutants: int, keep: Path) -> list[dict[str, Any]]:
    """Make, check, mutate and check the plans of one batch; return records of plans, and of their mutants."""
    rng = np.random.default_rng([number, *patient.encode()])
    records: list[dict[str, Any]] = []
    other: Plan | None = None
    for system, asked_lps, plan in plans_of_batch(check.lung, rng):
        began = time.process_time()
        report = check.of_plan(plan, system, asked_lps)
        record: dict[str, Any] = {
            "patient": patient,
            "batch": number,
            "system": system.name,
            "method": plan.method,
            "iterations": plan.iterations,
            "arcs": 0 if plan.needle is None else len(plan.needle.arcs),
            "accepted": report.accepted,
            "refused_by": [each.name for each in report.refusals],
            "check_s": round(time.process_time() - began, 3),
        }
        records.append(record)
        name = f"{patient}-{number}-{len(records)}"
        if not report.accepted:
            plan.save(keep / f"refused-{name}.json")
            continue
        case = Case(lung=check.lung, plan=plan, report=report, other=other or plan)
        for n in range(mutants):
            kind, mutant = mutate(case, rng)
            verdict = check.of_mutant(mutant, system, asked_lps)
            record = {"patient": patient, "batch": number, "mutation": kind}
            record["mutant_accepted"] = verdict.accepted
            record["mutant_refused_by"] = [each.name for each in verdict.refusals][:6]
            if verdict.accepted:
                plan.save(keep / f"original-{name}.json")
                mutant.plan.save(keep / f"mutant-{kind}-{name}-{n}.json")
                if mutant.voxel is not None:
                    record |= {"voxel": mutant.voxel.tolist(), "label": mutant.label}
            records.append(record)
        other = plan
    return records


def read(path: Path) -> list[dict[str, Any]]:
    """Return the records of a file, none if there is no such file."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text().splitlines()]


def run(patient: str, lung: Lung, plans: int, mutants: int, seed: int, out: Path, keep: Path) -> None:
    """Attack batch after batch until FILE has so many plans of the patient."""
    mine = [each for each in read(out) if each["patient"] == patient]
    done, total = {each["batch"] for each in mine}, sum("accepted" in each for each in mine)
    check = PlanCheck(lung)
    for number in count(seed):
        if total >= plans:
            return
        if number in done:
            continue
        began = time.process_time()
        records = attack(check, patient, number, mutants, keep)
        made = sum("accepted" in each for each in records)
        total += made
        seconds = round(time.process_time() - began, 1)
        records.append({"patient": patient, "batch": number, "batch_s": seconds})
        with out.open("a") as stream:
            stream.writelines(json.dumps(record) + "\n" for record in records)
        refused = sum(not each.get("accepted", True) for each in records)
        through = sum(each.get("mutant_accepted", False) for each in records)
        print(
            f"{patient} batch {number}: {made} plans ({total} in all), {refused} refused, "
            f"{through} mutants let through, {seconds} s",
            flush=True,
        )


def table(records: Sequence[dict[str, Any]]) -> str:
    """Return what became of plans and mutants, by patient and by kind of mutation."""
    plans = [each for each in records if "accepted" in each]
    lines = ["plans", f"{'patient':28} {'checked':>8} {'refused':>8} {'CPU s each':>11}"]
    for patient in sorted({each["patient"] for each in plans}):
        mine = [each for each in plans if each["patient"] == patient]
        refused = sum(not each["accepted"] for each in mine)
        seconds = float(np.median([each["check_s"] for each in mine]))
        lines.append(f"{patient:28} {len(mine):8d} {refused:8d} {seconds:11.3f}")
    mutants = [each for each in records if "mutation" in each]
    lines += ["", "mutants", f"{'kind':28} {'checked':>8} {'accepted':>9}"]
    checked = Counter(each["mutation"] for each in mutants)
    through = Counter(each["mutation"] for each in mutants if each["mutant_accepted"])
    lines += [f"{kind:28} {checked[kind]:8d} {through[kind]:9d}" for kind in sorted(checked)]
    lines.append(f"{'all':28} {len(mutants):8d} {through.total():9d}")
    return "\n".join(lines)


def main() -> None:
    """Run the attack and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("patient", nargs="?", help="folder of a patient, or phantom")
    parser.add_argument("--plans", type=int, default=200, help="plans of this patient in all")
    parser.add_argument("--mutants", type=int, default=1, help="mutants of each plan")
    parser.add_argument("--seed", type=int, default=0, help="number of the first batch")
    parser.add_argument("--out", type=Path, default=Path("check-attack.jsonl"))
    parser.add_argument("--keep", type=Path, default=Path("check-attack-kept"))
    parser.add_argument("--table", type=Path, help="print the table of this file and do nothing else")
    words = parser.parse_args()
    # Why there is no plan takes another atlas, and is not what is attacked.
    explanation.explain = lambda *_, **__: la.NoPlan("No plan", reasons={})
    if words.table is not None:
        sys.stdout.write(table(read(words.table)) + "\n")
        return
    if words.patient is None:
        parser.error("name a patient's folder, or phantom")
    if words.patient == "phantom":
        name, lung = "phantom", build_lung(make_phantom(seed=PHANTOM_SEED).images)
    else:
        name, lung = Path(words.patient).name, la.load_patient(words.patient)
    words.keep.mkdir(parents=True, exist_ok=True)
    run(name, lung, words.plans, words.mutants, words.seed, words.out, words.keep)
    sys.stdout.write(table(read(words.out)) + "\n")


if __name__ == "__main__":
    main()

"""How often procedures succeed that measure on their way, by error model: random peripheral targets.

    python -m experiments.procedures [--quick] [--seed 1] [--results FOLDER] [--patient NAME] [--system NAME]

Random peripheral targets are planned for with `lungaccess.plan`; the plan of least cost of each is carried
out by every procedure that ships, under every error model, always with the same luck.
"""

from __future__ import annotations

import time

import numpy as np

import lungaccess as la
from anatomy.lung import Lung
from experiments.support.anatomies import anatomy, default_anatomies
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.planning.procedure import ProcedureReport, simulate_procedure
from lungaccess.problem.error_files import error_preset_names, load_errors
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.procedures import load_procedure, procedure_names
from lungaccess.problem.target import point_target

SIZES = {"quick": (2, 20), "full": (8, 100)}
"""Targets, and procedures for each target, error model and procedure."""
ITERATIONS = 100


def plans_of(lung: Lung, atlas: la.Atlas, count: int, seed: int) -> list[la.Plan]:
    """Return the plans of least cost to the first `count` random targets that are reached."""
    system, plans = atlas.system, list[la.Plan]()
    for point in peripheral_targets(lung, 4 * count, seed):
        if len(plans) == count:
            break
        try:
            *_, best = la.plan(
                lung, system, point_target(lung, point), atlas=atlas, iterations=ITERATIONS, goal="default"
            )
        except la.NoPlan:
            continue
        plans.append(best)
    return plans


def add_row(result: Result, name: str, reports: list[ProcedureReport], cpu_s: float) -> None:
    """Add the median success over the plans, and what fails most."""
    success = np.array([100.0 * each.succeeds.value for each in reports])
    ends = {name: np.mean([100.0 * each.ends[name].value for each in reports]) for name in reports[0].ends}
    failures = sorted((name for name in ends if name != "success"), key=lambda name: -ends[name])[:3]
    low, high = np.quantile(success, (0.1, 0.9))
    said = ", ".join(f"{each} {ends[each]:.0f} %" for each in failures)
    count = sum(each.samples for each in reports)
    result.add(
        f"{name}: succeed, median of the plans", float(np.median(success)), unit="%",
        note=f"10 and 90 % quantile {low:.0f} and {high:.0f} %; mean {success.mean():.0f} %; fail by {said}; "
        f"placed {np.mean([each.placements for each in reports]):.1f} times; "
        f"{1e3 * cpu_s / count:.1f} ms of CPU time a procedure",
    )  # fmt: skip


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--patient", default=default_anatomies()[-1], metavar="NAME")
    parser.add_argument("--system", default="lung-default", metavar="NAME")
    options = parser.parse_args()
    n_targets, samples = SIZES[setting_of(options)]
    result = Result(
        name="procedures", title="Procedures that measure on their way, by error model",
        setting=setting_of(options), seeds=[options.seed],
    )  # fmt: skip
    system = la.load_system(options.system, fissures_allowed=True)
    lung = anatomy(options.patient)
    plans = plans_of(lung, la.open_atlas(lung, system), n_targets, options.seed)
    result.conditions = {
        "anatomy": f"{lung.name}, system {system.name}",
        "targets": f"{len(plans)} peripheral ones, the plan of least cost after {ITERATIONS} iterations",
        "procedures": f"{samples} for each; a success ends within 5 mm of the target and touches nothing "
        "forbidden",
    }
    for errors in error_preset_names():
        for procedure in procedure_names()[::-1]:
            began = time.process_time()
            reports = [
                simulate_procedure(
                    plan, lung, errors=load_errors(errors), procedure=load_procedure(procedure),
                    samples=samples, seed=options.seed,
                )
                for plan in plans
            ]  # fmt: skip
            add_row(result, f"{errors}, {procedure}", reports, time.process_time() - began)
    write_result(result, options.results)


if __name__ == "__main__":
    main()

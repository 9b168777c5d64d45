"""Needle planner on a cost map, by length and by raw voxel intensity, as in [Fu2018, fig. 7].

    python -m experiments.fu2018_needle [--quick] [--seed 1] [--results FOLDER] [--ct NAME] [--work FOLDER]

Three searches (`PortfolioSearch`) that differ in their objective alone, in three scenarios of rising
difficulty: success and cost over time.  Cost is judged by the cost map for all three: its sum over the set of
voxels crossed [Fu2018, eq. 1], and its line integral, which does not depend on the voxel size.
The cost map is that of `lungaccess segment`, of a CT or of the phantom's.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np

from anatomy.base.typed import Float
from experiments.support.anatomies import PHANTOM, data_folder
from experiments.support.cost_map.case import NEEDLE, SAFETY_MM, Case, case_of
from experiments.support.cost_map.figure import draw
from experiments.support.cost_map.inflation import largest_step_mm
from experiments.support.cost_map.problems import Scenario, choose_scenarios
from experiments.support.cost_map.runs import (
    COST_MAP,
    INTENSITY,
    PAPER_MODE_ITERATIONS,
    SHORTEST_PATH,
    Run,
    changes_of_cost,
    paper_mode,
    proofs,
    run_all,
    success_and_means,
)
from experiments.support.results import Result, setting_of, study_parser, write_result

SHARES_OF_TIME = (0.01, 0.1, 1.0)
PAPER_CHANGE = -50.0
QUICK = {"runs": 3, "limit_s": 0.5, "problems": 10}
FULL = {"runs": 10, "limit_s": 10.0, "problems": 30}
NOT_REPRODUCED = [
    "The CT of a pig's inflated lung cannot be had; the paper's runs took 500 s.  "
    "The numbers compare objectives with each other."
]

Results = dict[tuple[str, str], list[Run]]


def add_planner(result: Result, title: str, runs: list[Run], times: Float) -> tuple[Float, Float]:
    """Add what the runs of one objective found; return the means of both costs at each time."""
    success, sums, integrals = success_and_means(runs, times)
    shares = ", ".join(f"{100 * s:.0f} % at {t:g} s" for s, t in zip(success, times, strict=True))
    first = np.median([run.times[0] if len(run.times) else math.inf for run in runs])
    length = np.mean([run.lengths[-1] for run in runs if len(run.times)] or [math.nan])
    note = f"success {shares}; first path after {1e3 * first:.0f} ms; "
    note += f"{length:.0f} mm long, integral {integrals[-1]:.2f} mm"
    result.add(title, sums[-1], note=note)
    return sums, integrals


def add_scenario(result: Result, name: str, results: Results, limit_s: float) -> None:
    """Add what the runs of one scenario found."""
    times = limit_s * np.array(SHARES_OF_TIME)
    costs = {
        variant: add_planner(result, f"{name}: cost of the {variant} planner", results[name, variant], times)
        for variant in (COST_MAP, SHORTEST_PATH, INTENSITY)
    }
    sums, integrals = costs[COST_MAP]
    for variant, paper in ((SHORTEST_PATH, PAPER_CHANGE), (INTENSITY, None)):
        change, of_integral = (
            100.0 * (ours[-1] / theirs[-1] - 1.0)
            for ours, theirs in zip(costs[COST_MAP], costs[variant], strict=True)
        )
        note = f"integral {of_integral:+.0f} %"
        result.add(f"{name}: cost on the map against {variant}", change, paper, "%", note)
    early, of_integral = (100.0 * (values[-2] / values[-1] - 1.0) for values in (sums, integrals))
    title = f"{name}: cost of ours after {times[-2]:g} s, more than after {times[-1]:g} s"
    result.add(title, early, None, "%", f"integral {of_integral:+.0f} %; means over runs with a path by then")


def add_others(
    result: Result, case: Case, scenarios: list[Scenario], results: Results, problems: int, limit_s: float
) -> None:
    """Add what further problems, the proof, and the paper's way of collision checking show."""
    changes = changes_of_cost(case, result.seeds[0], problems, limit_s)
    low, middle, high = np.quantile(changes, (0.25, 0.5, 0.75))
    note = f"{problems} further problems, one run of {limit_s:g} s each; "
    note += f"quartiles {low:+.0f} and {high:+.0f} %; "
    note += f"at least 50 % less in {100 * np.mean(changes <= PAPER_CHANGE):.0f} % of them"
    result.add("cost on the map against shortest path, median", float(middle), PAPER_CHANGE, "%", note)
    ours = proofs(
        case.environment, [path for group in results.values() for run in group for path in run.paths]
    )
    result.add(
        "paths of all runs that the proof refutes",
        ours.refuted,
        note=f"of {ours.paths}, least distance {ours.least_mm:.2f} mm",
    )
    theirs = paper_mode(case, scenarios, result.seeds)
    step = largest_step_mm(case.environment.grid.spacing_mm, case.environment.required_clearance_mm)
    note = "no search found a path; "
    if theirs.paths:
        note = f"of {theirs.paths}, least distance {theirs.least_mm:.2f} mm "
        note += f"where {case.environment.required_clearance_mm:g} mm is asked; "
    note += f"lookups every {step:.3f} mm, {PAPER_MODE_ITERATIONS} iterations a run"
    refuted = theirs.refuted if theirs.paths else None
    result.add("paths of the paper's inflation that the proof refutes", refuted, note=note)


def study(result: Result, name: str, work: Path, numbers: dict[str, float]) -> None:
    """Run all searches on one CT and add their rows and figure."""
    case = case_of(name, work, result.seeds[0])
    runs, limit_s, problems = int(numbers["runs"]), numbers["limit_s"], int(numbers["problems"])
    result.conditions |= {
        "CT": f"{case.name}, {case.environment.grid.describe()}",
        "needle": f"{NEEDLE.diameter_mm:g} mm, margin {SAFETY_MM:g} mm, curvature 1/121 mm",
        "time": f"{runs} runs of {limit_s:g} s of CPU for each scenario and objective, one core",
    }
    scenarios = choose_scenarios(case, result.seeds[0])
    for scenario in scenarios:
        result.conditions[scenario.name] = scenario.describe()
        print(f"{scenario.name}: {scenario.describe()}", flush=True)
    results: Results = {}
    for scenario in scenarios:
        results |= run_all(case, scenario, result.seeds, limit_s)
        add_scenario(result, scenario.name, results, limit_s)
    add_others(result, case, scenarios, results, problems, 0.1 * limit_s)
    result.figure = draw(case, scenarios, results, limit_s)


def main(arguments: list[str] | None = None) -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument(
        "--ct", metavar="NAME", help="phantom, lidc-0314, or a CT (phantom where there is no data)"
    )
    parser.add_argument(
        "--work", type=Path, metavar="FOLDER", help="keeps the segmented patient for the next run"
    )
    parser.add_argument("--runs", type=int, help="seeds of each scenario and objective")
    parser.add_argument("--time", type=float, help="CPU seconds a run")
    options = parser.parse_args(arguments)
    numbers = dict(QUICK if options.quick else FULL)
    numbers["runs"], numbers["limit_s"] = options.runs or numbers["runs"], options.time or numbers["limit_s"]
    result = Result(
        name="fu2018_needle",
        title="Steerable needle on the cost map, by length and by voxel intensity",
        source="Fu2018, fig. 7",
        setting=setting_of(options),
        seeds=list(range(options.seed, options.seed + int(numbers["runs"]))),
        not_reproduced=list(NOT_REPRODUCED),
    )
    name = options.ct or (PHANTOM if options.quick or data_folder() is None else "lidc-0314")
    if options.work is not None:
        study(result, name, options.work, numbers)
    else:
        with tempfile.TemporaryDirectory() as work:
            study(result, name, Path(work), numbers)
    write_result(result, options.results)


if __name__ == "__main__":
    main()

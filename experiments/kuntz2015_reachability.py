"""Share of random peripheral targets with a plan, by planning time, as in [Kuntz2015, fig. 8].

    python -m experiments.kuntz2015_reachability [--quick] [--results FOLDER] [--patients NAME ...]
    python -m experiments.kuntz2015_reachability --so-far

Targets are drawn per lung, 5 to 25 mm from the pleura and at least 3 mm clear of airway, vessels and
pleura.  Their lung is a commercial model that cannot be had, so the numbers compare methods and devices, not
lungs.  The needle's stiffness is neglected, as in the paper.  Each search ends with its first plan, which the
check then judges.  The runs are a study (`lungaccess study`): `--runs DB` keeps them, each in a transaction
of its own, and what it holds is not run again: the study may be killed at any moment and goes on when it is
started again.  `--so-far` runs nothing and tells of the cases whose runs are all there.

The full setting has 800 runs.  They take at most 2.8 hours with one worker, or half of that with two; most
end with their first plan, or at once where no deployment can reach the target.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from anatomy.base.files import write_text
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from experiments.support.anatomies import PHANTOM, default_anatomies, require_data
from experiments.support.kuntz2015 import as_in_paper
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.running.study.driver import run_study
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.runs import runs_of
from lungaccess.running.study.settings import study_of
from lungaccess.showing.report import style

PAPER_SHARES = {1.0: 36.0, 60.0: 70.0, 3600.0: 75.0}
TIMES_S = {0.1: None, 1.0: 1.0, 5.0: None, 20.0: 60.0}
"""Times after which shares are told, and the paper's time whose share stands beside."""
Times = dict[tuple[str, str], tuple[Float, int]]
OURS, PAPERS = "atlas", "Algorithm 1"
QUERY = """
SELECT p.case_name, c.name, CASE WHEN r.solved THEN r.first_solution_time END, r.correct_solution
FROM runs r JOIN plannerConfigs c ON c.id = r.plannerid JOIN problems p ON p.experimentid = r.experimentid
     JOIN outcomes o ON o.runid = r.id
WHERE NOT o.failed ORDER BY p.case_name, c.name, p.target"""


@frozen_value
class Size:
    """Targets a lung, seconds a target of our search and of Algorithm 1, and the systems."""

    per_lung: int
    ours_s: float
    papers_s: float
    systems: tuple[tuple[str, bool], ...]


FULL = Size(
    per_lung=25, ours_s=20.0, papers_s=5.0,
    systems=(
        ("ultrathin", True), ("flexure-needle", True), ("ultrathin", False), ("thin-scope", True),
    ),
)  # fmt: skip
QUICK = Size(per_lung=5, ours_s=5.0, papers_s=5.0, systems=(("ultrathin", True),))
NOT_REPRODUCED = ["The lung of the paper and its nodules; it is a commercial model that cannot be had."]


def study(patients: list[str], size: Size, planner: str, folder: Path) -> dict[str, Any]:
    """Return the study of one planner as its TOML would say it; files of the devices are in the folder."""
    for system, _allowed in size.systems:
        write_text(folder / f"{system}.toml", as_in_paper(system))
    cases = [
        {
            "name": f"{patient}, {system}, fissures {'crossed' if allowed else 'forbidden'}",
            "anatomy": patient if patient == PHANTOM else str(require_data(f"med-rad/{patient}").resolve()),
            "system": str((folder / f"{system}.toml").resolve()), "fissures_allowed": allowed,
            "peripheral": {"per_lung": size.per_lung, "seed": 0},
        }
        for patient in patients for system, allowed in size.systems
    ]  # fmt: skip
    method, seconds = ("atlas", size.ours_s) if planner == OURS else ("kuntz2015", size.papers_s)
    return {
        "name": "kuntz2015_reachability", "case": cases, "planner": [{"name": planner, "method": method}],
        "seeds": [0], "budget": {"time_s": seconds, "first_plan": True},
    }  # fmt: skip


def times_by_case(file: Path) -> Times:
    """Return by case and planner the times of first plans, inf for none, and how many plans were refused."""
    found: dict[tuple[str, str], list[tuple[float, bool]]] = {}
    with ResultsFile(file) as results:
        for case, planner, seconds, accepted in results.rows(QUERY):
            refused = seconds is not None and not accepted
            found.setdefault((case, planner), []).append((np.inf if seconds is None else seconds, refused))
    return {
        key: (np.array([at for at, _refused in values]), sum(refused for _at, refused in values))
        for key, values in found.items()
    }


def finished(found: Times, runs: dict[tuple[str, str], int]) -> tuple[Times, str]:
    """Return the cases whose runs are all there, and how far the study is; empty if it has ended.

    Args:
        runs: How many runs each case and planner has.
    """
    done = {key: found[key] for key in runs if key in found and len(found[key][0]) >= runs[key]}
    made, of = sum(len(times) for times, _refused in found.values()), sum(runs.values())
    words = f"{made} of {of} runs, {len(done)} of {len(runs)} cases" if len(done) < len(runs) else ""
    return done, words


def add_case(result: Result, label: str, times: Float, refused: int, limit_s: float) -> None:
    """Add the shares of a case, and how soon those came that came at all."""
    solved = times[np.isfinite(times)]
    for limit, papers_s in ((ours, papers) for ours, papers in TIMES_S.items() if ours <= limit_s):
        share = 100.0 * float((times <= limit).mean())
        note = f"of {len(times)} targets" + (f"; the check refused {refused}" if refused else "")
        note += f"; the paper's after {papers_s:g} s" if papers_s not in (None, limit) else ""
        paper = PAPER_SHARES[papers_s] if papers_s is not None else None
        result.add(f"{label}: within {limit:g} s", share, paper, "%", note)
    if len(solved):
        early = 100.0 * float((solved <= 0.1).mean())
        note = f"{len(solved)} solved; within 1 s {100.0 * float((solved <= 1.0).mean()):.1f} %; "
        note += f"median {np.median(solved):.3f} s"
        result.add(f"{label}: of the solved, within 0.1 s", early, unit="%", note=note)


def draw(found: Times, limits_s: dict[str, float]) -> Figure:
    """Draw the share solved over planning time, up to the limit, with the paper's points up to a minute."""
    figure = style.new_figure(7.5, 5.2)
    axes = figure.subplots()
    cases = list(dict.fromkeys(case for case, _planner in found))
    for (case, planner), (times, _refused) in found.items():
        grid = np.geomspace(0.005, limits_s[planner], 300)
        share = [100.0 * float((times <= at).mean()) for at in grid]
        axes.plot(
            grid, share, "-" if planner == OURS else ":", color=f"C{cases.index(case)}", linewidth=1.4,
            label=f"{case}, {planner}",
        )  # fmt: skip
    paper = {at: share for at, share in PAPER_SHARES.items() if at <= 60.0}
    axes.plot(list(paper), list(paper.values()), "o", color=style.INK, label="paper, its own lung")
    axes.set(xscale="log", xlabel="planning time (s)", ylabel="targets with a plan (%)", ylim=(0, 100))
    figure.legend(*axes.get_legend_handles_labels(), frameon=False, fontsize=6, loc="lower center", ncols=2)
    figure.subplots_adjust(bottom=0.16 + 0.012 * len(found), top=0.97)
    return figure


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--patients", nargs="+", default=list(default_anatomies()))
    parser.add_argument("--runs", type=Path, default=Path(".studies/kuntz2015_reachability.db"))
    parser.add_argument("--workers", type=int, default=None)
    parser.add_argument("--so-far", action="store_true", help="run nothing, tell what the runs' file holds")
    options = parser.parse_args()
    size = QUICK if options.quick else FULL
    patients = options.patients[:1] if options.quick else options.patients
    result = Result(
        name="kuntz2015_reachability", title="Peripheral targets with a plan, by planning time",
        source="[Kuntz2015, fig. 8]", setting=setting_of(options), seeds=[0],
        conditions={
            "targets": f"{size.per_lung} on each side, 5 to 25 mm from the pleura",
            "time": "wall, without the atlas; as many searches at once as there are workers",
            "needle": "its stiffness is neglected, as in the paper",
            "searches": f"{OURS} up to {size.ours_s:g} s, {PAPERS} on our kernels up to {size.papers_s:g} s",
        },
        not_reproduced=[
            *NOT_REPRODUCED, f"One hour a target: our own search was given at most {size.ours_s:g} s.",
        ],
    )  # fmt: skip
    file = options.runs.with_stem(f"{options.runs.stem}-{result.setting}")
    file.parent.mkdir(parents=True, exist_ok=True)
    wanted: dict[tuple[str, str], int] = {}
    for planner in (OURS, PAPERS):
        asked = study_of(study(patients, size, planner, file.parent))
        if not options.so_far:
            run_study(asked, file, workers=options.workers)
        for run in runs_of(asked):
            wanted[run.problem.case, planner] = wanted.get((run.problem.case, planner), 0) + 1
    limits_s = {OURS: size.ours_s, PAPERS: size.papers_s}
    found, result.progress = finished(times_by_case(file), wanted)
    for (case, planner), (times, refused) in found.items():
        add_case(result, f"{case}, {planner}", times, refused, limits_s[planner])
    result.figure = draw(found, limits_s)
    write_result(result, options.results)


if __name__ == "__main__":
    main()

"""Compare devices in a study.

A study is every case with every planner and every seed; `lungaccess study run` reads the same values from
a TOML file. The runs are stored in one SQLite file. Here each case has six random targets in the periphery
of the lungs.
"""

from pathlib import Path

import matplotlib.pyplot as plt

from lungaccess.running.study import run_study, study_of, summarise

if __name__ == "__main__":  # the worker processes import this file
    study = study_of(
        {
            "name": "reach of two needles",
            "budget": {"iterations": 10, "first_plan": True},
            "case": [
                {"name": name, "anatomy": "phantom-3", "system": name, "peripheral": {"per_lung": 3}}
                for name in ("ultrathin", "flexure-needle")
            ],
            "planner": [{"name": "atlas"}],
        }
    )
    run_study(study, Path("results.db"), workers=1)
    groups = summarise(Path("results.db"))
    figure, ax = plt.subplots(figsize=(5, 4))
    ax.bar([group.case for group in groups], [100 * group.solved_share for group in groups])
    ax.set(ylabel="targets with a plan, %", title=f"{groups[0].runs} peripheral targets")
    figure.savefig("study.png")

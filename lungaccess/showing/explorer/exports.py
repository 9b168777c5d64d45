"""Files about a plan: what the command line writes, one at a time."""

import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

from anatomy.base.files import write_json, write_text
from anatomy.base.settings import settings_toml
from anatomy.lung import Lung
from lungaccess.judging.appraisal import appraise, plan_record
from lungaccess.plans.plan import Plan
from lungaccess.showing import report
from lungaccess.showing.report.html import PageOptions, plan_page
from lungaccess.showing.report.html.volumes import read_ct
from lungaccess.showing.slicer import export_slicer
from stages.needle import Objective

Curve = Sequence[tuple[float, float, float]]
"""Seconds, iterations and cost of better and better plans."""


def export_file(
    plan: Plan, lung: Lung, what: str, folder: Path, curve: Curve = (), ct: Path | None = None
) -> Path:
    """Write one of `lungaccess.showing.explorer.questions.FileKind` into a new folder in a folder.

    Raises
    ------
    FileError
        If it cannot be written.
    """
    made = Path(tempfile.mkdtemp(dir=folder))
    file = made / what
    points = [
        report.CostPoint(elapsed_s=elapsed_s, iteration=int(iteration), best_cost=cost)
        for elapsed_s, iteration, cost in curve
    ]
    if what == "plan.json":
        plan.save(file)
    elif what == "system.toml":
        write_text(file, settings_toml(plan.system))
    elif what == "summary.json":
        write_json(file, plan_record(plan, lung, appraise(plan, lung), made, (what,)))
    elif what == "report.html":
        history = made / "cost_over_time.csv"
        report.cost_over_time_csv(points, history)
        image = None if ct is None else read_ct(ct)
        name = "" if ct is None else ct.name
        plan_page(plan, lung, file, PageOptions(ct=image, ct_name=name, cost_over_time=history))
    elif what == "overview.png":
        report.overview_png(plan, lung, file, appraise(plan, lung))
    elif what == "tree.png":
        report.tree_png(lung, file)
    elif what == "cost_over_time.csv":
        report.cost_over_time_csv(points, file)
    elif what == "cost_over_time.png":
        report.cost_over_time_png(points, file, Objective.of(plan.objective).words)
    else:
        scene = made / "slicer"
        export_slicer(plan, lung, scene)
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
            for each in sorted(scene.rglob("*")):
                packed.write(each, Path("slicer") / each.relative_to(scene))
    return file

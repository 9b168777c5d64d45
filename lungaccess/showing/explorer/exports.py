"""What the page asks for now and then: files about a plan, why there is none, the reach of a system.

Files are what the command line writes, one at a time.  Why there is no plan is told in the words of the
command, and never more than is proved.  Reach comes voxel by voxel, from the target outward.
"""

import tempfile
import zipfile
from collections.abc import Iterator, MutableMapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError
from anatomy.base.files import write_json, write_text
from anatomy.base.settings import settings_toml
from anatomy.base.typed import Int
from anatomy.base.words import of_hundred, percent
from anatomy.lung import Lung
from lungaccess.judging.advice import advise
from lungaccess.judging.appraisal import Appraisal, appraise, plan_record
from lungaccess.judging.explanation import DEFAULT_TIME_S, explain_no_plan, sections
from lungaccess.planning import run
from lungaccess.planning.coupled import Atlas, atlas_is_kept, open_atlas
from lungaccess.planning.reachability import KINDS, ReachStream
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem import System, Target
from lungaccess.problem.goals import SUCCESS
from lungaccess.problem.request import Request, goal_of
from lungaccess.showing import report
from lungaccess.showing.explorer.questions import ExplainQuestion
from lungaccess.showing.explorer.worker import Part, Turn
from lungaccess.showing.report.html import PageOptions, plan_page
from lungaccess.showing.report.html.volumes import CtFile
from lungaccess.showing.report.reach import COLOURS
from lungaccess.showing.slicer import export_slicer

Reached = MutableMapping[tuple[Any, ...], Int]
"""The deployment that reached each voxel, by scope, tubes, margins and rule for fissures."""

ITERATIONS = 100

ADVICE_S = 3.0
"""Seconds for what would lift the chance of success: a reader of the page waits for it."""

Curve = Sequence[tuple[float, float, float]]
"""Seconds, iterations and value of the goal of better and better plans."""


def export_file(
    plan: Plan, lung: Lung, what: str, folder: Path, curve: Curve = (), ct: CtFile | None = None
) -> Path:
    """Write one of `lungaccess.showing.explorer.questions.FileKind` into a new folder in a folder.

    Raises FileError if it cannot be written.
    """
    made = Path(tempfile.mkdtemp(dir=folder))
    file = made / what
    points = [
        report.CostPoint(elapsed_s=elapsed_s, iteration=int(iteration), best=value)
        for elapsed_s, iteration, value in curve
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
        image, name = (None, "") if ct is None else (ct.read(), ct.path.name)
        advice = advise(plan, lung, appraise(plan, lung), time_s=ADVICE_S)
        options = PageOptions(ct=image, ct_name=name, cost_over_time=history, advice=advice)
        plan_page(plan, lung, file, options)
    elif what == "overview.png":
        report.overview_png(plan, lung, file, appraise(plan, lung))
    elif what == "tree.png":
        report.tree_png(lung, file)
    elif what == "cost_over_time.csv":
        report.cost_over_time_csv(points, file)
    elif what == "cost_over_time.png":
        report.cost_over_time_png(points, file, SUCCESS if plan.chance else goal_of(plan.objective))
    else:
        scene = made / "slicer"
        export_slicer(plan, lung, scene)
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
            for each in sorted(scene.rglob("*")):
                packed.write(each, Path("slicer") / each.relative_to(scene))
    return file


def appraisal_words(appraisal: Appraisal) -> dict[str, str]:
    """Return verdict and geometry in one sentence, the chance of success, and what is most at risk."""
    said = appraisal.headline
    failures = [f"{name} ({of_hundred(share.value, up=True)} of 100)" for name, share in said.failures]
    nearest = [f"nearest limit: {each.words}" for each in appraisal.limits[:1]]
    return {
        "said": f"{said.verdict.capitalize()}: {said.geometry_words}.",
        "chance": said.chance_words,
        "risk": "; ".join([*failures, *nearest]),
    }


def explanation_part(
    lung: Lung,
    system: System,
    target: Target,
    question: ExplainQuestion,
    atlas: Atlas,
    cache: Path | None,
    turn: Turn,
) -> Part:
    """Return headline and sections of an explanation.  Raises SettingsError if there is a plan."""

    def on_part(name: str) -> None:
        turn.check()
        turn.tell(name)

    goal, seed = question.objective, question.seed
    request = Request.of(lung, system, target, goal=goal, seed=seed, iterations=ITERATIONS)
    try:
        next(run(request, atlas=atlas, counterfactuals=False, on_progress=lambda _event: turn.check()))
    except NoPlan as failure:
        made = explain_no_plan(
            lung, system, target, failure, atlas=atlas, objective=goal, seed=seed, time_s=DEFAULT_TIME_S,
            atlas_of=lambda other, progress: open_atlas(lung, other, cache=cache, progress=progress),
            is_kept=lambda other: atlas_is_kept(lung, other, cache=cache), on_part=on_part,
        )  # fmt: skip
    else:
        raise SettingsError("There is a plan to this target", remedy="Ask for it")
    told = [asdict(each) for each in sections(made)]
    return Part({"answer": "explanation", "headline": made.headline, "sections": told})


def reach_parts(
    lung: Lung, system: System, atlas: Atlas, around_lps: ArrayLike, reached: Reached, turn: Turn
) -> Iterator[Part]:
    """Yield the grid, then voxels with what became of them.

    Where the atlas is that of the question before, voxels whose arc is clear for the needle of this one, too,
    come first, all at once.
    """
    stream = ReachStream(lung, system, atlas)
    grid = stream.grid
    yield Part(
        {
            "answer": "reach grid", "shape": list(grid.shape), "spacing_mm": float(grid.spacing_mm[0]),
            "ijk_from_lps": grid.ijk_from_lps.tolist(), "lps_from_ijk": grid.lps_from_ijk.tolist(),
            "colours": {code: COLOURS[name] for name, code in KINDS.items() if name != "undecided"},
            "counted": len(stream.counted), "system": system.name,
        }
    )  # fmt: skip
    key = (system.scope, system.tubes, system.margins, atlas.with_fissures)
    known = None if system.needle is None else reached.get(key)
    reached.clear()  # Of one atlas only: a page changes the needle far more often than the scope.
    count, by = int(np.prod(grid.shape)), "the tubes" if system.needle is None else "a single arc"
    kept = reached[key] = np.full(count, -1, dtype=np.int64) if known is None else known.copy()
    kinds = np.zeros(count, dtype=np.uint8)
    for part in stream.parts(around_lps, known):
        found = part.entries >= 0
        kept[part.voxels[found]] = part.entries[found]
        kinds[part.voxels] = part.kinds
        told, hit = np.count_nonzero(kinds), np.isin(kinds, (KINDS["direct arc"], KINDS["search"])).sum()
        ml = float(grid.voxel_volume_mm3) / 1000.0
        words = f"Reached by {by}: {hit * ml:.0f} of {told * ml:.0f} mL ({percent(hit / max(told, 1))})"
        so_far = "" if part.share >= 1.0 else f"; {percent(part.share)} of the lung known so far"
        yield Part(
            {"answer": "reach", "share": part.share, "words": words + so_far},
            {"voxels": part.voxels.astype(np.int32), "kinds": part.kinds.astype(np.uint8)},
        )
        turn.check()

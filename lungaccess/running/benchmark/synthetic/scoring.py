"""Scores of a submission: every answer is checked anew, by the independent check and nothing else."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, fields
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from anatomy.base.errors import FileError, PlanFileError
from anatomy.base.files import read_json
from anatomy.base.records import frozen_value
from anatomy.base.words import of_hundred
from anatomy.lung import Lung
from lungaccess.judging.checking import Checker
from lungaccess.problem.patients import load_patient
from lungaccess.problem.system import load_system
from lungaccess.running.benchmark.published import known_median
from lungaccess.running.benchmark.runs import decimals, write_table
from lungaccess.running.benchmark.synthetic import cases
from lungaccess.running.benchmark.synthetic.submission import (
    Submission,
    SubmittedAnswer,
    motions_of_answer,
    require_queries,
)
from lungaccess.uncertainty.breathing.window import with_window

if TYPE_CHECKING:
    from lungaccess.planning.reachability import UnreachableProof

SOLVED, REFUSED, NONE, CLAIMED, CERTIFIED, MISSING = (
    "solved", "refused", "no plan", "claimed unreachable", "proved unreachable", "no answer",
)  # fmt: skip
"""An answer comes to one of these.  Only `SOLVED` and `CERTIFIED` are proved; a mere claim is not."""
SAMPLES = 1000
"""Deviated plans for the chance of success, which is then known to 1.6 % or better."""
REASONS = 3
"""Findings that a refusal names."""
Progress = Callable[[str, float], None]


@frozen_value
class Score:
    """What one answer comes to.

    Args:
        status: "solved", "refused", "no plan", "claimed unreachable", "proved unreachable" or "no answer".
        reason: Why it is refused: what the check found.
        cost: Integral of 1 / clearance over the needle; this and all below only where it is solved.
        success: Estimated chance of success under the errors `breath-hold` without correction, if asked for.
        breath_share: Share of the breath in which the plan is proved, of phantoms that breathe.
        not_checked: What the check could not look at; "" for nothing.
        first_cpu_s, cpu_s: Processor time, as the submission states it.
    """

    query: str
    phantom: str
    family: str
    system: str
    target: int
    planner: str
    status: str
    reason: str = ""
    cost: float | None = None
    needle_mm: float | None = None
    success: float | None = None
    breath_share: float | None = None
    not_checked: str = ""
    first_cpu_s: float | None = None
    cpu_s: float | None = None


def score_submission(
    submission: Submission,
    folder: Path,
    *,
    cache: Path | None = None,
    samples: int = SAMPLES,
    certify_boxes: int = 0,
    only_answered: bool = False,
    progress: Progress | None = None,
) -> Iterator[Score]:
    """Yield the score of every query of the phantoms in a folder, phantom by phantom.

    Args:
        samples: Deviated plans for the chance of success; 0 for no estimate.
        certify_boxes: Budget of a proof that a target claimed unreachable is so; 0 for no proof.
        only_answered: Whether queries without an answer are left out.

    Raises:
        FileError: If the folder is not one of this benchmark, or lacks a phantom that an answer is about.
        AnatomyError: If the masks of a phantom in the folder are not those of the manifest.
        SettingsError: If an answer names a tip that was not published.
    """
    phantoms = cases.require_cases(folder)
    require_queries(submission.answers, (each.name for each in phantoms), folder)
    answers = {each.query: each for each in submission.answers}
    held = {each.name for each in phantoms}
    asked = [
        query for query in cases.all_queries().values()
        if query.phantom in held and (query.name in answers or not only_answered)
    ]  # fmt: skip
    tips = cases.PublishedTips(folder)
    done = 0
    for name, of_phantom in groupby(asked, key=lambda query: query.phantom):
        queries = list(of_phantom)
        judge: _Scorer | None = None
        for query in queries:
            (progress or (lambda _words, _share: None))(query.name, done / len(asked))
            done += 1
            answer = answers.get(query.name)
            if answer is not None and (answer.planned or (answer.unreachable and certify_boxes)):
                judge = judge or _Scorer(_own_masks(name, folder / name, cache), tips, samples, certify_boxes)
                yield judge.score(query, answer, submission.planner)
            else:
                status = MISSING if answer is None else CLAIMED if answer.unreachable else NONE
                cpu_s = None if answer is None else answer.cpu_s
                yield _named(query, submission.planner, status, cpu_s=cpu_s)


def _named(query: cases.BenchmarkQuery, planner: str, status: str, **more: Any) -> Score:
    return Score(
        query=query.name,
        phantom=query.phantom,
        family=cases.phantom_named(query.phantom).family,
        system=query.system,
        target=query.target,
        planner=planner,
        status=status,
        **more,
    )


class _Scorer:
    """Scores the answers about one phantom."""

    def __init__(self, lung: Lung, tips: cases.PublishedTips, samples: int, certify_boxes: int) -> None:
        self._lung, self._checker = lung, Checker(lung)
        self._tips, self._samples, self._certify_boxes = tips, samples, certify_boxes
        self._proofs: dict[str, UnreachableProof] = {}

    def score(self, query: cases.BenchmarkQuery, answer: SubmittedAnswer, planner: str) -> Score:
        """Return what an answer comes to."""
        if not answer.planned:
            proved = self._is_proved(query)
            return _named(query, planner, CERTIFIED if proved else CLAIMED, cpu_s=answer.cpu_s)
        system = load_system(query.system)
        target = np.array(query.target_lps)
        motions = motions_of_answer(query, answer, self._tips)
        try:
            plan = self._checker.completed(motions, system, target, method=planner)
            report = self._checker.check(plan, system, target_lps=target)
        except (PlanFileError, FloatingPointError, np.linalg.LinAlgError) as error:
            return _named(query, planner, REFUSED, reason=f"{error}", cpu_s=answer.cpu_s)
        if report.accepted and self._lung.motion is not None:
            plan = with_window(plan, self._lung)
            report = self._checker.check(plan, system, target_lps=target)
        if not report.accepted:
            refusals = [str(each) for each in report.refusals]
            more = f"; and {len(refusals) - REASONS} more" if len(refusals) > REASONS else ""
            reason = "; ".join(refusals[:REASONS]) + more
            return _named(query, planner, REFUSED, reason=reason, cpu_s=answer.cpu_s)
        success = None
        if self._samples:
            from lungaccess.uncertainty.risk import assess

            # Every plan has the same luck.
            report_of_risk = assess(plan, self._lung, samples=self._samples, seed=281, each_kind=False)
            success = report_of_risk.succeeds.value
        return _named(
            query,
            planner,
            SOLVED,
            first_cpu_s=answer.first_cpu_s,
            cpu_s=answer.cpu_s,
            cost=plan.costs["inverse_clearance"],
            needle_mm=plan.costs["length_mm"],
            success=success,
            breath_share=None if plan.window is None else plan.window.share,
            not_checked=", ".join(each.name for each in report.unchecked),
        )

    def _is_proved(self, query: cases.BenchmarkQuery) -> bool:
        from lungaccess.planning.reachability import UnreachableProof

        if query.system not in self._proofs:
            system = load_system(query.system)
            self._proofs[query.system] = UnreachableProof(
                self._lung, system, with_fissures=not system.fissures_allowed
            )
        target = np.array(query.target_lps)
        return self._proofs[query.system].prove(target, most_boxes=self._certify_boxes).proved


def _own_masks(name: str, folder: Path, cache: Path | None) -> Lung:
    """Return the lung of a phantom; AnatomyError if its masks, which answers are about, are others."""
    from anatomy.io.patients import load_patient as read_images

    remedy = "Delete the folder of this phantom and make it again"
    cases.require_masks(name, read_images(folder), f"in {folder}", remedy)
    return load_patient(folder, cache=cache)


def refuted(scores: Iterable[Score]) -> dict[str, str]:
    """Return the queries claimed unreachable that somebody solved, with the latter's name."""
    scores = list(scores)
    solved = {each.query: each.planner for each in scores if each.status == SOLVED}
    return {
        each.query: solved[each.query] for each in scores if each.status == CLAIMED and each.query in solved
    }


HEADINGS = (
    "planner", "family", "device", "queries", "solved", "solved, %", "refused", "proved none",
    "claims refuted", "first, s", "time, s", "cost", "cost, shared", "success, %", "breath, %", "not checked",
)  # fmt: skip
ALL = "all"


@frozen_value
class SheetLine:
    """One line of the score sheet.

    Args:
        planner, family, system: "all" for every family or device.
        queries, solved, refused, certified, refuted: Queries that count; answers that the check accepts; that
            it refuses; queries proved to have no plan; claims of that kind that another planner's accepted
            answer refutes.
        first_cpu_s, cpu_s: Medians of the stated processor times: to the first plan where solved, and of all
            answers.
        cost, shared_cost: Median cost of what is solved, and of those queries that all planners of the sheet
            solved.
        success, breath_share: Mean chance of success, and mean proved share of the breath, of what is solved.
        not_checked: Accepted answers of which the check could not look at everything.
    """

    planner: str
    family: str
    system: str
    queries: int
    solved: int
    refused: int
    certified: int
    refuted: int
    first_cpu_s: float | None
    cpu_s: float | None
    cost: float | None
    shared_cost: float | None
    success: float | None
    breath_share: float | None
    not_checked: int

    def cells(self) -> tuple[str, ...]:
        """Return the line as text; what is not known is empty."""
        solved, *others = (
            "" if each is None else of_hundred(each)
            for each in (self.solved / max(self.queries, 1), self.success, self.breath_share)
        )
        return (
            self.planner, self.family, self.system, f"{self.queries}", f"{self.solved}", solved,
            f"{self.refused}", f"{self.certified}", f"{self.refuted}", decimals(self.first_cpu_s, 3),
            decimals(self.cpu_s, 3), decimals(self.cost, 2), decimals(self.shared_cost, 2),
            *others, f"{self.not_checked}",
        )  # fmt: skip


def score_sheet(scores: Iterable[Score], *, by_family: bool = True) -> list[SheetLine]:
    """Return the lines of a sheet, a planner's whole result first.

    A planner counts for the queries that it has scores of.  With several planners compare the lines only
    where the numbers of queries agree; `shared_cost` is of the queries that all of them solved.
    """
    scores = list(scores)
    planners = list(dict.fromkeys(each.planner for each in scores))
    solved_by = [{s.query for s in scores if s.planner == p and s.status == SOLVED} for p in planners]
    shared = set.intersection(*solved_by) if len(planners) > 1 else set()
    wrong = refuted(scores)
    lines = []
    for planner in planners:
        own = [each for each in scores if each.planner == planner]
        lines.append(_line(planner, ALL, ALL, own, shared, wrong))
        if not by_family:
            continue
        for key in ("family", "system"):
            for value in dict.fromkeys(str(getattr(each, key)) for each in own):
                part = [each for each in own if getattr(each, key) == value]
                names = (value, ALL) if key == "family" else (ALL, value)
                lines.append(_line(planner, *names, part, shared, wrong))
    return lines


def _line(
    planner: str, family: str, system: str, scores: Sequence[Score], shared: set[str], wrong: dict[str, str]
) -> SheetLine:
    solved = [each for each in scores if each.status == SOLVED]
    return SheetLine(
        planner=planner,
        family=family,
        system=system,
        queries=len(scores),
        solved=len(solved),
        refused=sum(each.status == REFUSED for each in scores),
        certified=sum(each.status == CERTIFIED for each in scores),
        refuted=sum(each.status == CLAIMED and each.query in wrong for each in scores),
        first_cpu_s=known_median(each.first_cpu_s for each in solved),
        cpu_s=known_median(each.cpu_s for each in scores if each.status != MISSING),
        cost=known_median(each.cost for each in solved),
        shared_cost=known_median(each.cost for each in solved if each.query in shared),
        success=_mean([each.success for each in solved]),
        breath_share=_mean([each.breath_share for each in solved]),
        not_checked=sum(bool(each.not_checked) for each in solved),
    )


def _mean(values: Iterable[float | None]) -> float | None:
    known = [each for each in values if each is not None]
    return sum(known) / len(known) if known else None


def write_sheet(lines: Iterable[SheetLine], path: Path) -> None:
    """Write the lines of a sheet by the suffix of the file, .csv or .json; errors as of `write_scores`."""
    _write_rows("sheet", SheetLine, lines, path)


def write_scores(scores: Iterable[Score], path: Path) -> None:
    """Write scores by the suffix of the file, .csv or .json; what is not known stays empty, or null.

    FileError is raised if the file cannot be written, or ends in something else.
    """
    _write_rows("scores", Score, scores, path)


def _write_rows(name: str, cls: type, rows: Iterable[Any], path: Path) -> None:
    about: dict[str, Any] = {"benchmark": cases.VERSION, "manifest_sha256": cases.manifest_sha256()}
    columns = [item.name for item in fields(cls)]
    write_table(path, columns, {**about, name: [asdict(each) for each in rows]}, indent=None, end="\n")


def read_scores(path: Path) -> list[Score]:
    """Read scores that `write_scores` wrote as JSON; FileError without any, or of another benchmark."""
    expected, remedy = (
        "scores in JSON",
        f"Write them with: lungaccess benchmark {cases.VERSION} score ... --out scores.json",
    )
    content = read_json(path, expected=expected, remedy=remedy)
    if not isinstance(content, dict) or content.get("manifest_sha256") != cases.manifest_sha256():
        raise FileError(f"{path} holds no scores of {cases.VERSION}", expected=expected, remedy=remedy)
    try:
        return [Score(**row) for row in content["scores"]]
    except (KeyError, TypeError) as error:
        raise FileError(f"{path} holds damaged scores ({error})", expected=expected, remedy=remedy) from error

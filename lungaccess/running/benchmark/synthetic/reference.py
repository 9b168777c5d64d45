"""Runs of our methods and OMPL's planners on the benchmark, as a study; and what they hand in."""

from collections.abc import Iterable, Sequence
from pathlib import Path

from anatomy.base.errors import SettingsError
from lungaccess.plans.plan import Plan
from lungaccess.running.benchmark.synthetic.cases import (
    SYSTEMS,
    TARGETS_A_LUNG,
    VERSION,
    BenchmarkPhantom,
    BenchmarkQuery,
    all_queries,
    entries,
    phantom_named,
    require_cases,
)
from lungaccess.running.benchmark.synthetic.submission import Submission, SubmittedAnswer, answer_of_plan
from lungaccess.running.study.one_run import FIRST_CPU, SEARCH_CPU
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.settings import AtlasGrid, Budget, Case, PlannerChoice, Study

ITERATIONS = 100
"""Beyond the direct arcs: about a tenth of a second."""
JOINT = "+"
"""Between a method and the planner of the needle that it is to use."""
_QUERY = """
SELECT p.case_name, p.x_lps_mm, p.y_lps_mm, p.z_lps_mm, c.name, r.cpu_time, l.plan
FROM runs r JOIN outcomes o ON o.runid = r.id JOIN plannerConfigs c ON c.id = r.plannerid
     JOIN problems p ON p.experimentid = r.experimentid LEFT JOIN plans l ON l.runid = r.id
WHERE NOT o.failed ORDER BY r.id"""


def method_choice(words: str, iterations: int | None) -> PlannerChoice:
    """Return the planner of a study that words name: METHOD, or METHOD+NEEDLE_PLANNER.

    Raises:
        SettingsError: If there is no such method or planner of the needle.
    """
    method, _joint, needle = words.partition(JOINT)
    return PlannerChoice(
        name=words, method=method, needle_planner=needle, iterations=iterations, without_counterfactuals=True
    )


def benchmark_study(
    folder: Path,
    methods: Sequence[str] = ("atlas",),
    *,
    phantoms: Iterable[str] = (),
    systems: Sequence[str] = SYSTEMS,
    targets: int | None = None,
    iterations: int | None = ITERATIONS,
    time_s: float | None = None,
) -> Study:
    """Return the study that runs methods, METHOD or METHOD+NEEDLE_PLANNER, on a folder of cases.

    Args:
        targets: The first so many of each lung of a phantom; all if None.
        iterations, time_s (optional): Budget of a query; iterations can be repeated exactly.

    Raises:
        FileError: If the folder is not one of this benchmark.
        SettingsError: If it does not hold a phantom, or there is no such device or method.
    """
    held = require_cases(folder)
    chosen = tuple(phantom_named(name) for name in phantoms) or held
    for case in chosen:
        if case not in held:
            raise SettingsError(
                f"{folder} does not hold {case.name}",
                expected=", ".join(each.name for each in held),
                remedy=f"lungaccess benchmark {VERSION} make --out {folder} --phantoms {case.name}",
            )
    for system in systems:
        if system not in SYSTEMS:
            raise SettingsError(f"{VERSION} has no device {system!r}", expected=", ".join(SYSTEMS))
    return Study(
        name=VERSION,
        case=tuple(_case(folder, case, system, targets) for case in chosen for system in systems),
        planner=tuple(method_choice(words, iterations) for words in methods),
        budget=Budget(iterations=iterations, time_s=time_s),
        atlas=AtlasGrid(),
        folder=str(folder.resolve()),
    )


def _case(folder: Path, case: BenchmarkPhantom, system: str, targets: int | None) -> Case:
    points = entries()[case.name].targets_lps
    # In turns, so that runs of the first targets remain those of a study of more.
    pairs = tuple(zip(points[:TARGETS_A_LUNG], points[TARGETS_A_LUNG:], strict=True))[:targets]
    chosen = [point for pair in pairs for point in pair]
    return Case(
        name=f"{case.name}/{system}",
        anatomy=case.name,
        system=system,
        objective="inverse-clearance",
        targets=tuple("lps:" + ",".join(repr(x) for x in point) for point in chosen),
    )


def submissions_of(path: Path) -> list[Submission]:
    """Return the submissions that the results of a study of the benchmark make, one of each method.

    Times are processor time of the search; where it found nothing, of the whole run.  Of several runs
    of a query, such as with more iterations, the last counts.

    Raises:
        FileError: If the results cannot be read.
        SettingsError: If they are not of this benchmark.
    """
    queries = {(f"{each.phantom}/{each.system}", each.target_lps): each for each in all_queries().values()}
    answers: dict[str, dict[str, SubmittedAnswer]] = {}
    with ResultsFile(path) as results:
        for case, x, y, z, planner, cpu_s, text in results.rows(_QUERY):
            query = queries.get((case, (x, y, z)))
            if query is None:
                raise SettingsError(
                    f"{path} has a run of {case} to lps:{x},{y},{z}",
                    expected=f"runs of {VERSION} alone",
                    remedy=f"Make them with: lungaccess benchmark {VERSION} run",
                )
            answer = SubmittedAnswer(query=query.name, cpu_s=cpu_s) if not text else _answer(query, text)
            answers.setdefault(planner, {})[query.name] = answer
    return [
        Submission(planner=planner, answers=tuple(own[name] for name in sorted(own)))
        for planner, own in sorted(answers.items())
    ]


def _answer(query: BenchmarkQuery, text: str) -> SubmittedAnswer:
    plan = Plan.from_json(text)
    first_s, all_s = (float(plan.timing.get(key, 0.0)) for key in (FIRST_CPU, SEARCH_CPU))
    return answer_of_plan(query, plan, first_cpu_s=first_s, cpu_s=all_s)

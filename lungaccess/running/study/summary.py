"""What a results file says, by case and planner."""

from pathlib import Path
from statistics import median
from typing import Any

from anatomy.base.records import frozen_value
from lungaccess.running.study.results import ResultsFile

_QUERY = """
SELECT p.case_name, p.objective, c.name,
       o.failed, r.solved, r.correct_solution, r.first_solution_time, r.time, r.cost,
       1.0 * json_extract(l.plan, '$.chance.successes') / json_extract(l.plan, '$.chance.samples')
FROM runs r JOIN outcomes o ON o.runid = r.id JOIN plannerConfigs c ON c.id = r.plannerid
     JOIN problems p ON p.experimentid = r.experimentid LEFT JOIN plans l ON l.runid = r.id
ORDER BY p.case_name, p.objective, c.name, r.key"""


@frozen_value
class Group:
    """The runs of one case with one planner.

    Args:
        failed: Of the runs, those that could not be made and will be made again; they count nowhere else.
        solved_share: Share of the runs with a plan.
        accepted_share: Share of the plans that the check accepts; 0 if there is none.
        first_plan_s: Median and largest planning time of the first plan.
        cost: Median cost of the best plans.
        success: Median chance of success of the best plans; None where the study counts none.
    """

    case: str
    objective: str
    planner: str
    runs: int
    failed: int
    solved_share: float
    accepted_share: float
    first_plan_s: tuple[float, float] | None
    run_s: float
    cost: float | None
    success: float | None = None


def summarise(path: Path) -> list[Group]:
    """Summarise a results file by case, objective and planner.

    Raises:
        FileError: If the file cannot be read.
    """
    groups: dict[tuple[str, str, str], list[tuple[Any, ...]]] = {}
    with ResultsFile(path) as results:
        for case, objective, planner, *values in results.rows(_QUERY):
            groups.setdefault((case, objective, planner), []).append(tuple(values))
    return [_group(*names, rows) for names, rows in groups.items()]


def _group(case: str, objective: str, planner: str, rows: list[tuple[Any, ...]]) -> Group:
    made = [row[1:] for row in rows if not row[0]]
    solved = [row for row in made if row[0]]
    first = [row[2] for row in solved]
    chances = [row[5] for row in solved if row[5] is not None]
    return Group(
        case=case,
        objective=objective,
        planner=planner,
        runs=len(rows),
        failed=len(rows) - len(made),
        solved_share=len(solved) / len(made) if made else 0.0,
        accepted_share=sum(row[1] for row in solved) / len(solved) if solved else 0.0,
        first_plan_s=(median(first), max(first)) if first else None,
        run_s=median(row[3] for row in made) if made else 0.0,
        cost=median(row[4] for row in solved) if solved else None,
        success=median(chances) if chances else None,
    )

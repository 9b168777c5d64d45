"""Why there is no plan, for the page: in the words of the command, and never more than is proved."""

from collections.abc import Callable

from anatomy.base.errors import SettingsError
from anatomy.lung import Lung
from lungaccess.judging.explanation import DEFAULT_TIME_S, explain_no_plan, sections
from lungaccess.planning import run
from lungaccess.planning.coupled import Atlas
from lungaccess.plans.no_plan import NoPlan
from lungaccess.problem import System, Target
from lungaccess.problem.request import Request
from lungaccess.showing.explorer.questions import ExplainQuestion
from lungaccess.showing.explorer.worker import Part, Turn

ITERATIONS = 100


def explanation_part(
    lung: Lung,
    system: System,
    target: Target,
    question: ExplainQuestion,
    atlas: Atlas,
    atlas_of: Callable[[System, Callable[[float], None]], Atlas],
    is_kept: Callable[[System], bool],
    turn: Turn,
) -> Part:
    """Return headline and sections of an explanation.

    Raises
    ------
    SettingsError
        If there is a plan.
    """

    def on_part(name: str) -> None:
        turn.check()
        turn.send(Part({"answer": "progress", "what": name, "share": None}))

    try:
        next(
            run(
                Request.of(
                    lung, system, target, goal=question.objective, seed=question.seed, iterations=ITERATIONS
                ),
                atlas=atlas,
                counterfactuals=False,
                on_progress=lambda _event: turn.check(),
            )
        )
    except NoPlan as failure:
        made = explain_no_plan(
            lung, system, target, failure, atlas=atlas, objective=question.objective, seed=question.seed,
            time_s=DEFAULT_TIME_S, atlas_of=atlas_of, is_kept=is_kept, on_part=on_part,
        )  # fmt: skip
    else:
        raise SettingsError("There is a plan to this target", remedy="Ask for it")
    proved = made.verdict is not None and made.verdict.proved
    return Part(
        {
            "answer": "explanation",
            "headline": made.headline,
            "proved_unreachable": proved,
            "sections": [
                {
                    "title": each.title,
                    "headings": list(each.headings),
                    "rows": [list(row) for row in each.rows],
                }
                for each in sections(made)
            ],
        }
    )

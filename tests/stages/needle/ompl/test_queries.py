"""A query answered with arcs, by our searches as planners of OMPL."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from ompl import base

from anatomy.base.errors import SettingsError
from anatomy.margins import Margins
from stages.needle import ompl as ompl_planner
from stages.needle.environment import NeedleEnvironment, needle_environment
from stages.needle.ompl import NeedleProblem
from stages.needle.path import Query, blocker_on_path
from stages.needle.search.base import RestartingRRT
from tests.stages.needle.ompl.problems import (
    GOAL,
    ITERATIONS,
    OMPL_PLANNERS,
    arcs_of,
    ask,
    given,
    handed_over,
    query,
    require,
    start,
)
from tests.stages.scenes import Canvas


def test_a_planner_written_in_python_solves(problem: NeedleProblem, environment: NeedleEnvironment) -> None:
    path = require(ask(problem))
    assert len(path.arcs) >= 2
    assert np.linalg.norm(path.frames()[-1][:3, 3] - GOAL) < 1e-6
    assert blocker_on_path(environment, path, -1) == 0
    assert np.array_equal(path.lps_from_start, start())


def test_the_same_seed_gives_the_same_path(problem: NeedleProblem, environment: NeedleEnvironment) -> None:
    first, again = require(ask(problem, 7)), require(ask(problem, 7))
    assert np.array_equal(first.arcs, again.arcs)
    assert np.array_equal(first.arcs, require(ask(NeedleProblem(environment), 7)).arcs)
    assert not np.array_equal(first.arcs, require(ask(problem, 8)).arcs)


def test_the_iterations_are_a_limit(problem: NeedleProblem) -> None:
    in_vessel = query(np.zeros(3))
    assert problem.plan(in_vessel, seed=0, iterations=450) is None
    assert problem.own().iterations_used == 450
    assert problem.plan(in_vessel, seed=0, iterations=0) is None
    assert problem.own().iterations_used == 0


def test_without_iterations_only_the_direct_arc_is_tried(problem: NeedleProblem) -> None:
    path = require(problem.plan(query(np.array([15.0, 0.0, 5.0])), seed=0, iterations=0))
    assert len(path.arcs) == 1
    assert ask(problem, iterations=0) is None


def test_anytime_goes_on_to_shorter_paths(problem: NeedleProblem) -> None:
    first, last = require(ask(problem)), require(ask(problem, anytime=True))
    assert problem.own().iterations_used == ITERATIONS
    assert last.length_mm < first.length_mm


def test_a_termination_condition_that_holds_already_stops_at_once(problem: NeedleProblem) -> None:
    require(ask(problem))
    assert ask(problem, time_s=0.0) is None
    assert problem.own().iterations_used == 0
    problem.pose(query())
    status = problem.setup.solve(base.plannerAlwaysTerminatingCondition())
    assert not bool(status)
    assert problem.planner.path is None and problem.planner.iterations_used == 0


def test_the_exemption_reaches_the_kernel(environment: NeedleEnvironment) -> None:
    """A start in the wall of branch 0 has a path only if that is the pierced branch."""
    canvas = Canvas.empty([-20, -20, -20], [20, 20, 20], 1.0)
    x = canvas.points[..., 0]
    canvas.airway(x < -4, x < 0, 0)
    problem = NeedleProblem(
        needle_environment(canvas.lung(), environment.needle, Margins(), with_fissures=False)
    )
    frame = np.eye(4)
    frame[:3, :3] = [[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    frame[0, 3] = -1.0
    pierced = Query(lps_from_start=frame, target=np.array([12.0, 1.0, 0.0]), branch=0)
    path = require(problem.plan(pierced, seed=0, iterations=50))
    assert handed_over(problem).check() and problem.violation(path) == ""
    assert problem.plan(replace(pierced, branch=1), seed=0, iterations=50) is None
    assert "airway" in problem.violation(path)
    # The wall is exempt at the exit alone, which lies behind a needle that is on its way.
    assert problem.plan(replace(pierced, inserted_mm=6.0), seed=0, iterations=50) is None
    assert "airway" in problem.violation(path)


def test_searches_are_chosen_by_name(environment: NeedleEnvironment) -> None:
    path = arcs_of((20.0, 0.0, 0.0))
    problem = NeedleProblem(
        environment,
        {
            "line": given(path),
            "tree": lambda environment, query, seed: RestartingRRT(environment, query, seed=seed),
        },
    )
    assert require(ask(problem)) is path
    assert len(require(ask(problem, method="tree")).arcs) >= 2
    assert list(problem.planners()) == ["line", "tree", *OMPL_PLANNERS]
    assert problem.own("tree").getName() == "tree"
    with pytest.raises(SettingsError, match="line, tree"):
        ask(problem, method="maze")


def test_the_example_of_the_documentation_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = Path(ompl_planner.__file__).parents[3] / "docs" / "explanation" / "ompl.md"
    (code,) = re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    exec(compile(code, str(page), "exec"), names)
    assert names["problem"].violation(names["path"]) == ""
    assert "Exact solution" in capsys.readouterr().out
    assert [file.name for file in tmp_path.iterdir()] == ["needle.log"]

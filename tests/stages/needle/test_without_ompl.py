"""Where OMPL has no wheels our own planners serve, and its planners are refused in words."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from anatomy.margins import Margins
from stages.needle import OMPL_PLANNERS, OUR_PLANNERS, first_path, needle_environment, searches, violation
from stages.needle.device import Needle
from tests.stages.needle.ompl.problems import NEAR, query, scene

ROOT = Path(__file__).resolve().parents[3]
REFUSED = """
import sys
sys.path.insert(0, "tests/without_ompl")
from anatomy.base.errors import MissingLibraryError
from lungaccess.cli.app import main
from stages.needle import OMPL_PLANNERS, OUR_PLANNERS, has_ompl, require_planner

assert not has_ompl()
for name in OUR_PLANNERS:
    require_planner(name)
for name in OMPL_PLANNERS:
    try:
        require_planner(name)
    except MissingLibraryError as error:
        print(error)
print(main(["benchmark", "med-rad", "nowhere", "--planners", "control.EST"]))
"""


@pytest.mark.parametrize("name", OUR_PLANNERS)
def test_ours_serve_as_they_are_and_give_the_same_through_ompl(name: str) -> None:
    environment = needle_environment(
        scene(), Needle(diameter_mm=1.0, max_curvature_per_mm=1 / 30), Margins(), with_fissures=False
    )
    for asked in (query(), query(NEAR)):
        alone = first_path(searches()[name](environment, asked, 5), 3000)
        assert alone is not None and not violation(environment, asked, alone)
        assert first_path(searches()[name](environment, asked, 5), 3000, 0.5 * alone.length_mm) is None
        try:
            from stages.needle.ompl import NeedleProblem
        except ImportError:
            continue
        through = NeedleProblem(environment).plan(asked, seed=5, iterations=3000, method=name)
        assert through is not None and np.array_equal(through.arcs, alone.arcs)


def test_planners_of_ompl_say_that_it_is_missing_and_what_to_use() -> None:
    done = subprocess.run(
        [sys.executable, "-c", REFUSED], cwd=ROOT, capture_output=True, text=True, encoding="utf-8"
    )
    *said, code = done.stdout.splitlines()
    assert len(said) == len(OMPL_PLANNERS) and code == "2", done.stderr
    for line in said:
        assert "kept away" in line and "no wheels for Windows" in line and "such as rrt" in line
    assert "OMPL cannot be imported" in " ".join(done.stderr.replace("│", " ").split())

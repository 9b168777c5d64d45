"""The self-test agrees as it is, and names the kind of proof whose bound is weakened."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy.base.errors import SettingsError
from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.judging.selftest import KINDS, self_test
from lungaccess.judging.selftest.run import TOLERANCE, _difference

CHECKOUT = Path(__file__).resolve().parents[4]
FIELD, BOUND = "anatomy/kernels/field.py", "math.sqrt(max(total - spread, 0.0))"
INFEASIBLE = "stages/needle/infeasibility/kernels"
WEAKENED = [
    ("distances", FIELD, f"return {BOUND}", f"return 10.0 * {BOUND}"),
    ("distances", FIELD, f"return {BOUND}", f"return 0.5 * {BOUND}"),
    ("arcs", FIELD, f"return {BOUND}", f"return 10.0 * {BOUND}"),
    ("tubes", "stages/tube/kernels/wall_exit.py", "= radius + clearance\n", "= radius + 0.5 * clearance\n"),
    ("scope motions", "stages/scope/kernels/body.py", "0.25 * change", "0.05 * change"),
    ("start region", "stages/needle/kernels/start_region.py", "+ (chord", "+ 0.5 * (chord"),
    ("no path", f"{INFEASIBLE}/bounds.py", "return change + (depth", "return 0.5 * change + 0.5 * (depth"),
    ("no path", f"{INFEASIBLE}/blocked.py", "if above + half >=", "if above + -half >="),
    (
        "cost bound",
        "lungaccess/planning/coupled/kernels/cost_bound.py",
        "max(middle + aside,",
        "max(0.7 * middle,",
    ),
    (
        "unreachable",
        "lungaccess/planning/reachability/kernels/unreachable.py",
        "depth + moved",
        "depth - 0.5 * moved",
    ),
    (
        "window",
        "lungaccess/uncertainty/breathing/kernels/rules.py",
        "- half * base - kept",
        "- 0.0 * half * base - kept",
    ),
    (
        "window",
        "lungaccess/uncertainty/breathing/kernels/window.py",
        "miss, stretch.half",
        "miss, 0.3 * stretch.half",
    ),
]
"""A kind of proof, and how a bound of it is made weaker: what is proved then need not be true."""


def test_all_agree(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["selftest", "--json"]) == ExitCode.OK
    found = json.loads(capsys.readouterr().out)
    assert [each["kind"] for each in found] == list(KINDS)
    assert all(each["held"] and each["differences"] == each["contradictions"] == [] for each in found)


def test_there_is_no_such_kind() -> None:
    with pytest.raises(SettingsError, match="no kind of proof named 'arc'"):
        self_test(["arc"])


def test_numbers_that_differ_are_named() -> None:
    there = [1.0, np.inf, 3.0]
    assert _difference(np.array(there) * (1.0 + 0.1 * TOLERANCE), there) == ""
    assert "number 2" in _difference(np.array([1.0, np.inf, 3.001]), there)
    assert "2 numbers, in Python 3" in _difference(np.array([1.0, np.inf]), there)
    assert "IndexError" in _difference(np.array(there), "IndexError: index 9 is out of bounds")


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tree")
    for package in ("anatomy", "stages", "lungaccess"):
        shutil.copytree(CHECKOUT / package, folder / package, ignore=shutil.ignore_patterns("*.nb?"))
    return folder


def answered(tree: Path, kind: str) -> tuple[int, Any]:
    """Run the self-test of a kind in plain Python; return its exit code and what it says."""
    done = subprocess.run(
        [sys.executable, "-c", "import sys; from lungaccess.cli.app import main; sys.exit(main())"]
        + ["selftest", "--json", "--kind", kind],
        env={**os.environ, "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"},
        cwd=tree, capture_output=True, text=True, check=False,
    )  # fmt: skip
    return done.returncode, json.loads(done.stdout)


@pytest.mark.parametrize(
    ("kind", "file", "bound", "weaker"), WEAKENED, ids=[f"{each[0]} {n}" for n, each in enumerate(WEAKENED)]
)
def test_a_weaker_bound_is_named(tree: Path, kind: str, file: str, bound: str, weaker: str) -> None:
    source = tree / file
    text = source.read_text(encoding="utf-8")
    assert text.count(bound) == 1
    try:
        source.write_text(text.replace(bound, weaker), encoding="utf-8")
        code, [outcome] = answered(tree, kind)
    finally:
        source.write_text(text, encoding="utf-8")
    assert code == ExitCode.NEGATIVE
    assert outcome["kind"] == kind and outcome["differences"] is None
    assert outcome["contradictions"] and "Error" not in outcome["contradictions"][0]["said"]


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_no_other_case_is_a_false_alarm(name: str) -> None:
    said = {seed: KINDS[name].case(seed).contradiction() for seed in range(1000, 1060)}
    assert not {seed: what for seed, what in said.items() if what}

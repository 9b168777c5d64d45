"""What a notebook shows of lungs, trees, plans and verdicts; and the tutorial, run by IPython."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import nbformat
import pytest

from anatomy.display import AXIAL, CORONAL, Drawing
from anatomy.lung import Lung
from lungaccess.judging.checking import CheckReport, Finding
from lungaccess.plans.plan import Plan

TUTORIAL = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "tutorial.ipynb"
EVIL = "<script>alert('x')</script>&\""
VOID = {"br", "img", "hr"}


class Balance(HTMLParser):
    """Fails on tags that do not close, and keeps the text."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: Any) -> None:
        self.seen.append(tag)
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: Any) -> None:
        self.seen.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def parsed(shown: Any) -> Balance:
    balance = Balance()
    balance.feed(shown._repr_html_())
    balance.close()
    assert balance.open == []
    assert "script" not in balance.seen
    return balance


def drawings(html: str) -> Iterator[ElementTree.Element]:
    for part in html.split("<svg")[1:]:
        yield ElementTree.fromstring("<svg" + part.split("</svg>")[0] + "</svg>")


def test_a_lung_shows_what_it_is(small_lung: Lung) -> None:
    shown = parsed(small_lung)
    assert small_lung.name in shown.text and f"{small_lung.tree.n_branches}, to generation" in shown.text
    assert len(small_lung._repr_html_()) < 150_000
    evil = parsed(replace(small_lung, name=EVIL, warnings=(EVIL,)))
    assert evil.text.count(EVIL) == 2


def test_the_drawing_of_a_tree_has_every_branch_and_left_on_the_right(small_lung: Lung) -> None:
    tree = small_lung.tree
    (svg,) = drawings(tree._repr_html_())
    lines = [each for each in svg if each.tag.endswith("polyline")]
    assert len(lines) == tree.n_branches
    ends = [each.get("points", "").split()[-1] for each in lines]
    for branch, end in enumerate(ends):
        x, y = (float(c) for c in end.split(","))
        last = tree.points_lps[tree.branch_points(branch)[-1]]
        assert (x, -y) == pytest.approx((last[0], last[2]), abs=0.051)
    letters = {each.text: float(each.get("x", "nan")) for each in svg if each.tag.endswith("text")}
    assert letters["R"] < tree.carina_lps[0] < letters["L"]
    parsed(tree)


def test_a_plan_shows_every_stage(toy_plan: Plan) -> None:
    shown = parsed(toy_plan)
    for words in ("53.0 mm beyond the carina", "30.0 mm in 3 arcs", "vessel 1.60", "inverse_clearance 12.34"):
        assert words in shown.text
    coronal, axial = drawings(toy_plan._repr_html_())
    for svg, column in ((coronal, 2), (axial, 1)):
        rings = [each for each in svg if each.tag.endswith("circle")]
        target = rings[-1]
        across, down = float(target.get("cx", "nan")), float(target.get("cy", "nan"))
        sign = -1.0 if column == 2 else 1.0
        assert (across, sign * down) == pytest.approx(toy_plan.target_lps[[0, column]], abs=0.051)
    assert EVIL in parsed(replace(toy_plan, patient_name=EVIL)).text


@pytest.mark.parametrize("accepted", [True, False])
def test_a_verdict_is_a_word(accepted: bool) -> None:
    finding = Finding(
        name="needle.clearance.vessel",
        ok=accepted,
        value=0.4,
        limit=1.0,
        side="at least",
        unit="mm",
        detail=EVIL,
    )
    report = CheckReport(accepted=accepted, findings=(finding,))
    shown = parsed(report)
    assert ("accepts" in shown.text) is accepted and ("REFUSES" in shown.text) is not accepted
    assert shown.text.count("needle.clearance.vessel") == (1 if accepted else 2)
    assert "0.4 mm" in shown.text and "at least 1" in shown.text and EVIL in shown.text


@pytest.mark.parametrize("view", [CORONAL, AXIAL])
def test_an_empty_drawing_is_a_drawing(view: str) -> None:
    (svg,) = drawings(Drawing(view).svg())
    assert svg.get("viewBox")


def test_showing_needs_no_plotting_library() -> None:
    code = (
        "import sys, lungaccess as la; from lungaccess.judging.checking import CheckReport;"
        "CheckReport(accepted=True, findings=())._repr_html_(); la.Plan._repr_html_; la.Lung; la.AirwayTree;"
        "import anatomy.display, lungaccess.plans.plan;"
        "sys.exit(int(bool({'matplotlib', 'IPython'} & set(sys.modules))))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# The tutorial ------------------------------------------------------------------------------------


@pytest.fixture
def tutorial() -> nbformat.NotebookNode:
    return nbformat.read(TUTORIAL, as_version=4)


def test_the_tutorial_is_stored_without_outputs(tutorial: nbformat.NotebookNode) -> None:
    nbformat.validate(tutorial)
    for cell in tutorial.cells:
        assert cell.cell_type == "markdown" or (cell.outputs == [] and cell.execution_count is None)


@pytest.mark.slow
def test_the_tutorial_runs(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(Path(__file__).with_name("notebook_runner.py")), str(TUTORIAL)],
        cwd=tmp_path,
        env={**os.environ, "IPYTHONDIR": str(tmp_path / "ipython")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    everything = "".join(json.loads(done.stdout.splitlines()[-1]))
    for words in ("Lung of", "Airway tree", "Plan for", "The independent check accepts the plan"):
        assert words in everything, words
    assert (tmp_path / "slicer" / "scene.mrml").is_file()

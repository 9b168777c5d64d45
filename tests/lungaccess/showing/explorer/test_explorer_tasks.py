"""Ten tasks of a user in the explorer, each from the question to its answer."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lungaccess as la
from lungaccess.cli.app import main
from tests.lungaccess.planning.coupled.planning import TARGET
from tests.lungaccess.showing.explorer.windows import PLANNED, Page, Served
from tests.lungaccess.showing.report import browser

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]
DECIDED = f"(({PLANNED}) || !document.getElementById('no-plan').hidden)"


@pytest.fixture
def saved(planned: Page) -> Page:
    """Let downloads end in `window.saved`: name, and bytes as numbers."""
    planned.run(
        "window.saved = null; HTMLAnchorElement.prototype.click = function () {"
        " fetch(this.href).then((r) => r.arrayBuffer())"
        ".then((bytes) => { window.saved = [this.download, [...new Uint8Array(bytes)]]; }); }"
    )
    return planned


def download(page: Page) -> tuple[str, bytes]:
    page.wait("window.saved")
    name, numbers = page.run("return window.saved")
    return name, bytes(numbers)


def exported_plan(page: Page, tmp_path: Path) -> la.Plan:
    page.choose("export", "plan.json")
    name, content = download(page)
    (tmp_path / name).write_bytes(content)
    return la.Plan.load(tmp_path / name)


def test_find_a_plan_that_crosses_no_fissure(saved: Page, tmp_path: Path) -> None:
    saved.choose("fissures", "no")
    saved.wait(f"s.asked.fissures === false && {PLANNED}")
    assert exported_plan(saved, tmp_path).fissures_are_obstacles
    saved.click("reset")


def test_choose_the_exit_with_the_most_clearance(planned: Page) -> None:
    planned.choose("exits-by", "clearance")
    clearances = planned.run(
        "document.getElementById('exits-box').open = true;"
        "return [...document.querySelectorAll('#exits tr')]"
        ".map((row) => parseFloat(row.cells[1].textContent))"
    )
    best = int(np.argmax(clearances))
    planned.run("document.querySelectorAll('#exits tr')[arguments[0]].querySelector('button').click()", best)
    state = planned.wait(f"s.asked.exit !== null && {PLANNED}")
    assert state["asked"]["exit"] == state["exits"]["entries"][best]


def test_see_what_a_thicker_bronchoscope_changes(planned: Page) -> None:
    before = planned.state()
    planned.choose("scope_diameter_mm", "3.4")
    state = planned.wait(
        f"s.exits && s.exits.complete && {DECIDED} && (!s.plan || s.plan.system.includes('3.4'))"
    )
    assert state["plan"] is None or state["plan"]["digest"] != before["plan"]["digest"]
    planned.click("reset")
    again = planned.wait(f"s.plan && s.plan.system === 'ultrathin' && {PLANNED}")
    assert again["plan"]["digest"] == before["plan"]["digest"]


def test_learn_why_there_is_no_plan_and_what_would_help(planned: Page) -> None:
    planned.choose("needle_length_mm", "6")
    planned.wait("!document.getElementById('no-plan').hidden")
    assert planned.run("return document.querySelectorAll('#no-plan-reasons tr').length") > 0
    planned.click("explain")
    planned.wait("document.getElementById('explanation').textContent.length > 40")
    planned.click("reset")
    planned.wait(PLANNED)


def test_keep_two_plans_and_see_which_succeeds_more_often(planned: Page) -> None:
    planned.press("body", "k")
    planned.choose("seed", "5")
    planned.wait(f"s.asked.seed === 5 && {PLANNED}")
    planned.press("body", "k")
    planned.wait("s.compared.length === 2 && s.compared.every((each) => each.appraised)")
    cells = planned.run("return [...document.querySelectorAll('#compare td')].map((e) => e.textContent)")
    assert len(cells) == 8 and all(cells)
    planned.choose("seed", "0")


def test_hand_the_plan_to_somebody_else_by_its_address(planned: Page, served: Served) -> None:
    planned.choose("needle_radius_mm", "60")
    mine = planned.wait(f"s.plan && s.plan.system.includes('60 mm') && {PLANNED}")
    address = planned.run("return location.hash")
    with Page(1100, 800) as other:
        other.open(f"{served.address.url}")
        other.run("location.hash = arguments[0]", address)
        theirs = other.wait(f"s.plan && s.plan.system.includes('60 mm') && {PLANNED}")
    assert theirs["plan"]["digest"] == mine["plan"]["digest"]
    planned.click("reset")


def test_measure_in_the_3d_view(planned: Page) -> None:
    """From the exit to the target: a press there else takes hold of a device, or chooses a target."""
    asked, points = planned.state()["asked"], []
    planned.click("measure")
    for place in (planned.state()["plan"]["exit_lps"], planned.state()["target_lps"]):
        x, y = planned.run("return window.lungaccessReport.project(arguments[0])", place)
        points.append(planned.run("return window.lungaccessReport.pick(...arguments).point", x, y))
        planned.press_at("scene", x, y)
    stated = float(planned.text("scene-words").split(" mm")[0])
    # A press is at whole pixels, at whose sides another depth may be hit.
    assert stated == pytest.approx(np.linalg.norm(np.subtract(*points)), abs=1.0)
    assert planned.state()["asked"] == asked
    planned.click("measure")


def test_cut_the_anatomy_along_the_needle(planned: Page) -> None:
    planned.click("cut")
    planned.run(
        "const e = document.getElementById('cut-offset'); e.value = 5; e.dispatchEvent(new Event('input'))"
    )
    planned.wait("s.view_tools.cut")
    assert "5 mm" in planned.text("cut-words")
    planned.click("cut")


def test_save_a_picture(planned: Page) -> None:
    planned.run(
        "window.named = null; HTMLAnchorElement.prototype.click = function () {"
        " window.named = [this.download, this.href]; }"
    )
    planned.click("save-picture")
    planned.wait("window.named")
    name, address = planned.run("return window.named")
    assert name.endswith(".png") and address.startswith(("blob:", "data:image/png"))


def test_repeat_the_plan_on_the_command_line(planned: Page, tmp_path: Path, patient: Path) -> None:
    program, *words = shlex.split(planned.text("command"))
    assert program == "lungaccess" and words[0] == "plan"
    stated: Any = {"--out": str(tmp_path / "again"), "--cache": str(patient.parent / "cache")}
    for option, value in stated.items():
        if option in words:
            words[words.index(option) + 1] = value
        else:
            words += [option, value]
    assert main([*words, "--no-pictures"]) == 0
    plan = la.Plan.load(tmp_path / "again" / "plan.json")
    assert plan.digest == planned.state()["plan"]["digest"]
    np.testing.assert_allclose(plan.target_lps, [float(v) for v in TARGET.removeprefix("lps:").split(",")])

"""The page in a real browser: what a user does, by mouse and by keys, and what it asks of the network."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.phantom import Phantom, write_phantom
from lungaccess.showing.explorer import PatientSource
from tests.lungaccess.planning.coupled.planning import TARGET
from tests.lungaccess.showing.explorer.windows import PLANNED, Page, Served
from tests.lungaccess.showing.report import browser

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.usefixtures("planned"),
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]
CONTROLS = (
    "return [...document.querySelectorAll('button, input, select, canvas[tabindex]')]"
    ".filter((e) => e.checkVisibility())"
)
HOSTILE = '<img src=x onerror="document.title=1">'


def test_a_target_has_exits_a_checked_plan_and_the_command(page: Page, patient: Path) -> None:
    state = page.state()
    assert state["gl_error"] == 0 and state["exits"]["count"] == state["points"]["exits"] > 0
    assert "geometry proved and checked" in page.text("headline-text")
    assert page.text("exits-words").startswith(f"{state['exits']['count']} place")
    costs = [cost for _s, _n, cost in state["plan"]["curve"]]
    assert costs == sorted(costs, reverse=True)
    lung, system = la.load_patient(patient, cache=patient.parent / "cache"), la.load_system("ultrathin")
    atlas = la.open_atlas(lung, system, cache=patient.parent / "cache")
    plans = list(la.plan(lung, system, la.resolve_target(lung, TARGET), atlas=atlas, iterations=20, seed=0))
    assert plans[-1].digest == state["plan"]["digest"]
    assert "--iterations 20 --seed 0" in page.text("command")
    rows = page.run("return [...document.querySelectorAll('#plan-rows th')].map((e) => e.textContent)")
    assert rows == ["Chance", "Way", "Time", "Risk"]
    assert page.run("return document.title") == f"{lung.name} - lungaccess"


def test_a_click_into_a_slice_is_the_target(page: Page) -> None:
    page.press_at("slice-axial", 70.0, 60.0)
    state = page.wait(f"s.asked.target !== {json.dumps(TARGET)} && s.place && s.target_lps")
    stated = [float(each) for each in state["asked"]["target"].removeprefix("lps:").split(",")]
    np.testing.assert_allclose(state["slices"]["place_lps"], stated, atol=0.051)
    page.press("body", "n")
    page.wait("s.asked.target.startsWith('nodule') || s.asked.target !== ''")
    page.run("history.back(); ")


def test_a_click_in_3d_chooses_an_exit_and_a_drag_moves_it(page: Page) -> None:
    state = page.state()
    if state["exits"]["count"] < 2:
        pytest.skip("this target has one place of exit")
    at_exit = (
        "const { exits, scene } = window.lungaccessExplorer;"
        "return scene.project(exits.places.at(arguments[0]))"
    )
    page.press_at("scene", *page.run(at_exit, 0))
    chosen = page.wait(f"s.asked.exit !== null && s.exits && {PLANNED}")
    assert chosen["asked"]["exit"] in chosen["exits"]["entries"]
    assert "--exit lps:" in page.text("command")
    page.pointer("mousePressed", "scene", *page.run(
        "const { exits, scene, state } = window.lungaccessExplorer;"
            "return scene.project(exits.places[exits.numberOf(state.asked.exit)])"
    ))  # fmt: skip
    # The view may have moved with the new plan.  Exits that lie near each other have the same plan.
    second = page.run(
        "const { exits, scene, state } = window.lungaccessExplorer;"
        "const seen = exits.places.map((each) => scene.project(each));"
        "const [x, y] = seen[exits.numberOf(state.asked.exit)];"
        "const away = (at) => Math.hypot(at[0] - x, at[1] - y);"
        "return seen.reduce((a, b) => (away(b) > away(a) ? b : a))"
    )
    page.pointer("mouseMoved", "scene", *second)
    page.pointer("mouseReleased", "scene", *second)
    dragged = page.wait(f"s.asked.exit !== null && s.asked.exit !== {chosen['asked']['exit']} && {PLANNED}")
    assert dragged["plan"]["digest"] != chosen["plan"]["digest"]


def test_keys_step_through_exits_and_tips_and_undo_brings_all_back(page: Page) -> None:
    free = page.state()["plan"]["digest"]
    page.press("body", "e")
    exit_state = page.wait(f"s.asked.exit !== null && {PLANNED}")
    place = page.run("return window.lungaccessExplorer.exits.places[0]")
    assert np.linalg.norm(np.array(exit_state["plan"]["exit_lps"]) - place) <= 2.0 + 1e-3
    page.press("body", "[")
    ended = "(s.plan && s.plan.final || !document.getElementById('no-plan').hidden)"
    tip = page.wait(f"s.asked.tip !== null && {ended}")
    assert tip["asked"]["exit"] is None and tip["points"]["tip"] == 1
    page.run("history.back()")
    back = page.wait(f"s.asked.exit !== null && s.asked.tip === null && {PLANNED}")
    assert back["plan"]["digest"] == exit_state["plan"]["digest"]
    page.click("undo")
    again = page.wait(f"s.asked.exit === null && {PLANNED}")
    assert again["plan"]["digest"] == free
    page.click("redo")
    assert page.wait(f"s.asked.exit !== null && {PLANNED}")["plan"]["digest"] == exit_state["plan"]["digest"]
    page.press("body", "x")
    assert page.wait(f"s.asked.exit === null && {PLANNED}")["plan"]["digest"] == free


def test_what_if_renews_reach_and_plan_and_names_the_file_of_the_command(page: Page) -> None:
    before = page.wait("s.reach && s.reach.share === 1")
    page.choose("needle_radius_mm", "40")
    after = page.wait(f"s.plan && s.plan.system.includes('needle radius 40 mm') && {PLANNED}")
    assert after["plan"]["digest"] != before["plan"]["digest"]
    page.wait("s.reach && s.reach.system.includes('40 mm')")
    assert "--system system.toml" in page.text("command") and "Export system.toml" in page.text(
        "command-note"
    )
    page.choose("margin_mm", "0.3")
    page.wait(f"s.plan && s.plan.system.includes('margin 0.3 mm') && {PLANNED}")
    page.choose("needle_radius_mm", "2")
    page.wait("document.getElementById('what-if-error').textContent !== ''")
    assert "from 5 to 10000 mm" in page.text("what-if-error")
    page.click("reset")
    again = page.wait(f"s.plan && s.plan.system === 'ultrathin' && {PLANNED}")
    assert again["plan"]["digest"] == before["plan"]["digest"]


def test_plans_are_compared_removed_and_kept_in_the_address(page: Page, served: Served) -> None:
    page.press("body", "k")
    page.wait("s.compared.length === 1 && s.compared[0].appraised")
    page.choose("seed", "3")
    page.wait(f"s.asked.seed === 3 && {PLANNED}")
    page.click("keep")
    kept = page.wait("s.compared.length === 2 && s.compared.every((each) => each.appraised)")
    assert (
        len(page.run("return [...document.querySelectorAll('#compare td')].map((e) => e.textContent)")) == 8
    )
    address = page.run("return location.href")
    page.run("document.querySelector('#compare input').click()")
    assert page.wait("s.compared[0].hidden")["compared"][1]["hidden"] is False
    page.run("location.reload()")
    page.open(address)
    again = page.wait(f"s.compared.length === 2 && s.compared.every((each) => each.appraised) && {PLANNED}")
    assert [each["digest"] for each in again["compared"]] == [each["digest"] for each in kept["compared"]]
    page.run("[...document.querySelectorAll('#compare button')].find((e) => e.textContent === '✕').click()")
    assert page.wait("s.compared.length === 1")["compared"][0]["digest"] == kept["compared"][1]["digest"]


def test_no_plan_is_said_with_its_reasons(page: Page) -> None:
    page.choose("needle_length_mm", "6")
    page.wait("!document.getElementById('no-plan').hidden")
    assert page.text("headline-text") == "No plan was found." and page.text("no-plan-why")
    assert "unreachable" not in page.text("panel").split("Words")[0].lower()
    page.click("reset")
    page.wait(PLANNED)


def test_a_wrong_target_is_explained_and_undone(page: Page) -> None:
    for text, words in (("lps:500,0,0", "outside"), ("1,2,3", "frame"), ("nodule 99", "nodule 99")):
        page.run("document.getElementById('target-text').value = arguments[0]", text)
        page.run("document.getElementById('target-form').requestSubmit()")
        page.wait("document.getElementById('target-error').textContent")
        assert words in page.text("target-error")
        assert page.state()["plan"] is None
        page.click("undo")
        page.wait(f"s.asked.target === {json.dumps(TARGET)} && {PLANNED}")


def test_the_export_is_the_plan_that_is_shown(page: Page) -> None:
    page.run(
        "window.saved = null; HTMLAnchorElement.prototype.click = function () {"
        " fetch(this.href).then((r) => r.text())"
        ".then((text) => { window.saved = [this.download, text]; }); }"
    )
    page.choose("export", "plan.json")
    page.wait("window.saved")
    name, text = page.run("return window.saved")
    assert name == "plan.json" and json.loads(text)["digest"] == page.state()["plan"]["digest"]


def test_the_slider_plays_the_deployment_to_the_target(page: Page) -> None:
    target = page.state()["target_lps"]
    page.press("#position", "Home")
    assert np.linalg.norm(np.array(page.state()["tip_lps"]) - target) > 10.0
    page.run(
        "const e = document.getElementById('position'); e.value = 1000; e.dispatchEvent(new Event('input'))"
    )
    np.testing.assert_allclose(page.state()["tip_lps"], target, atol=2e-2)


def test_keys_move_the_cross_and_enter_makes_it_the_target(page: Page) -> None:
    before = np.array(page.state()["slices"]["place_lps"])
    page.press("#slice-coronal", "ArrowRight", "PageUp")
    moved = np.array(page.state()["slices"]["place_lps"])
    assert moved[0] > before[0] and moved[1] != before[1] and moved[2] == before[2]
    page.press("#slice-coronal", "Enter")
    state = page.wait(f"s.asked.target !== {json.dumps(TARGET)}")
    assert state["asked"]["target"].startswith("lps:")


def test_every_control_has_a_name_and_can_have_the_focus(page: Page) -> None:
    unnamed = page.run(
        CONTROLS + ".filter((e) => !(e.ariaLabel || e.textContent.trim() || (e.labels && e.labels.length)))"
        ".map((e) => e.outerHTML)"
    )
    assert unnamed == []
    lost = page.run(
        CONTROLS + ".filter((e) => !e.disabled)"
        ".filter((e) => { e.focus(); return document.activeElement !== e; }).map((e) => e.outerHTML)"
    )
    assert lost == []


def test_help_opens_by_a_key_and_lists_the_keys(page: Page) -> None:
    page.press("body", "?")
    assert page.run("return document.getElementById('help').open")
    assert page.run("return document.querySelectorAll('#keys tr').length") > 8
    page.click("help-close")
    assert not page.run("return document.getElementById('help').open")


def test_a_phone_shows_all_of_it_without_scrolling_sideways(served: Served) -> None:
    with Page(390, 844, phone=True) as window:
        window.open(f"{served.address.url}")
        window.target(TARGET)
        assert window.run("return document.documentElement.scrollWidth") <= 390
        assert window.messages() == []


def test_a_hostile_name_is_text(small_phantom: Phantom, tmp_path: Path) -> None:
    folder = tmp_path / "patient"
    write_phantom(small_phantom, folder)
    settings = folder / "patient.toml"
    text = settings.read_text()
    lines = [line for line in text.splitlines() if not line.startswith("name =")]
    settings.write_text(f"name = {json.dumps(HOSTILE)}\n" + "\n".join(lines))
    made = Served(PatientSource(folder=folder, system="ultrathin", cache=tmp_path / "cache"))
    try:
        with Page(800, 600) as window:
            window.open(made.address.url)
            assert window.text("patient") == HOSTILE
            assert window.run("return document.querySelectorAll('img').length") == 0
            assert window.run("return document.title").startswith(HOSTILE) and window.messages() == []
    finally:
        made.stop()

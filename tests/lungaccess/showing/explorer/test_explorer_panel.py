"""Controls of the panel and of the bar in the explorer, each driven as a user does."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.lungaccess.planning.coupled.planning import TARGET
from tests.lungaccess.showing.explorer.windows import PLANNED, Page, Served
from tests.lungaccess.showing.report import browser

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.usefixtures("planned"),
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]
ENDED = f"(({PLANNED}) || !document.getElementById('no-plan').hidden)"
SAVED = (
    "window.saved = null; HTMLAnchorElement.prototype.click = function () {"
    " fetch(this.href).then((file) => file.arrayBuffer())"
    ".then((bytes) => {"
    " window.saved = [this.download, [...new Uint8Array(bytes).slice(0, 8)], bytes.byteLength]; }); }"
)
"""Lets a download end in `window.saved`: name, first bytes, and how many there are."""
PNG, ZIP = b"\x89PNG", b"PK\x03\x04"


def test_the_cross_becomes_the_target_by_its_button(page: Page) -> None:
    page.press("#slice-axial", "ArrowRight")
    moved = page.wait("s.place && Math.abs(s.place.lps_mm[0] - s.slices.place_lps[0]) < 0.01")
    page.wait("!document.getElementById('cross-target').hidden")
    assert moved["asked"]["target"] == TARGET
    page.click("cross-target")
    state = page.wait(f"s.asked.target !== {json.dumps(TARGET)} && s.exits && s.exits.complete && {PLANNED}")
    stated = [float(each) for each in state["asked"]["target"].removeprefix("lps:").split(",")]
    np.testing.assert_allclose(stated, moved["slices"]["place_lps"], atol=0.051)
    assert page.run("return document.getElementById('cross-target').hidden")


def test_buttons_move_the_tip_of_the_scope_and_free_it(page: Page) -> None:
    free = page.state()["plan"]["digest"]
    assert page.run("return document.getElementById('free').disabled")
    tips = []
    for button in ("tip-back", "tip-back", "tip-forward"):
        before = page.state()["asked"]["tip"]
        page.click(button)
        tips.append(page.wait(f"s.asked.tip !== {json.dumps(before)} && {ENDED}")["asked"]["tip"])
    depths = page.run("return arguments[0].map((tip) => window.lungaccessExplorer.tips.depth[tip])", tips)
    assert depths[1] < depths[0] and depths[2] > depths[1]
    page.click("free")
    assert page.wait(f"s.asked.tip === null && {PLANNED}")["plan"]["digest"] == free


def test_the_slider_of_the_needle_is_its_radius(page: Page) -> None:
    page.run(
        "const e = document.getElementById('needle_radius_slider'); e.value = 80;"
        "e.dispatchEvent(new Event('input', { bubbles: true }))"
    )
    page.wait(f"s.asked.radius === 80 && s.plan && s.plan.system.includes('80 mm') && {PLANNED}")
    assert page.run("return document.getElementById('needle_radius_mm').value") == "80"
    assert page.run("return document.getElementById('needle_radius_mm').classList.contains('changed')")
    page.click("reset")
    page.wait(f"s.asked.radius === null && {PLANNED}")
    assert not page.run("return document.getElementById('needle_radius_mm').classList.contains('changed')")


def test_iterations_go_into_plan_and_command(page: Page) -> None:
    page.choose("iterations", "100")
    page.wait(f"s.asked.iterations === 100 && {PLANNED}")
    assert "--iterations 100 " in page.text("command")
    page.choose("iterations", "20")
    page.wait(f"s.asked.iterations === 20 && {PLANNED}")


def test_a_nodule_is_picked_in_the_list(page: Page) -> None:
    text = page.run("return document.getElementById('nodule').options[1].value")
    page.choose("nodule", text)
    state = page.wait(f"s.asked.target === {json.dumps(text)} && (s.failure || {ENDED})")
    assert state["failure"] is None
    nodules = page.run("return window.lungaccessExplorer.facts.targets.map((each) => each.lps_mm)")
    np.testing.assert_allclose(state["target_lps"], nodules[0], atol=1e-3)


def test_the_reach_is_painted_where_it_is_wanted(page: Page) -> None:
    page.wait("s.reach && s.reach.share === 1")
    slices = "return document.getElementById('slice-axial').toDataURL()"
    shown = page.run("return document.getElementById('reach-slices').checked")
    pictures = []
    for wanted in (not shown, shown):
        page.click("reach-slices")
        page.frame()
        assert page.run("return document.getElementById('reach-slices').checked") is wanted
        pictures.append(page.run(slices))
    assert pictures[0] != pictures[1]
    page.click("reach-scene")
    assert page.wait("s.points.reach > 0")["points"]["reach"] > 10
    assert page.run("return document.querySelectorAll('#reach-key li').length") == 2
    page.click("reach-scene")
    page.wait("!s.points.reach")


def test_structures_are_switched_off_and_on(page: Page) -> None:
    keys = page.run(
        "return [...document.querySelectorAll('#structures input')].map((box) => box.dataset.key)"
    )
    assert set(keys) == set(page.state()["structures"])
    before = page.state()["structures"]
    for key in keys:
        page.run("document.querySelector(`#structures input[data-key='${arguments[0]}']`).click()", key)
    assert page.state()["structures"] == {key: not shown for key, shown in before.items()}
    for key in keys:
        page.run("document.querySelector(`#structures input[data-key='${arguments[0]}']`).click()", key)


def test_help_opens_by_its_button(page: Page) -> None:
    page.click("help-open")
    assert page.run("return document.getElementById('help').open")
    page.click("help-close")
    assert not page.run("return document.getElementById('help').open")


def test_the_deployment_plays_and_is_held(page: Page) -> None:
    position = "return Number(document.getElementById('position').value)"
    page.run(
        "const e = document.getElementById('position'); e.value = 0; e.dispatchEvent(new Event('input'))"
    )
    page.click("play")
    assert page.text("play") == "Pause"
    frames = 0
    while page.run(position) == 0:
        page.frame()
        frames += 1
        assert frames < 10
    page.click("play")
    assert page.text("play") == "Play"
    held = page.run(position)
    page.frame()
    assert page.run(position) == held > 0


def test_the_command_is_copied_or_it_is_said_why_not(page: Page, served: Served) -> None:
    allowed = {
        "permissions": ["clipboardReadWrite", "clipboardSanitizedWrite"],
        "origin": served.address.origin,
    }
    page.command("Browser.grantPermissions", allowed)
    page.run("document.getElementById('command-box').open = true")
    page.click("copy")
    page.wait("document.getElementById('status').textContent === 'The command is copied.'")
    copied = page.run_async("navigator.clipboard.readText().then(done, (error) => done(String(error)))")
    assert copied == page.text("command") and copied.startswith("lungaccess plan ")
    page.run(
        "navigator.clipboard.writeText = () => Promise.reject(new DOMException('no', 'NotAllowedError'))"
    )
    page.click("copy")
    page.wait("document.getElementById('status').textContent.includes('Select it')")
    page.run("delete navigator.clipboard.writeText")


def test_all_files_can_be_exported(page: Page) -> None:
    page.run(SAVED)
    names = page.run("return [...document.getElementById('export').options].map((each) => each.value)")[1:]
    assert len(names) == len(set(names)) == 9
    for name in names:
        page.run("window.saved = null")
        page.choose("export", name)
        page.wait("window.saved")
        saved, begin, size = page.run("return window.saved")
        assert saved == name and size > 20
        wanted = {"png": PNG, "zip": ZIP, "json": b"{", "html": b"<!DOCTYP"}.get(name.rpartition(".")[2], b"")
        assert bytes(begin).startswith(wanted), name

"""The explorer as a room to plan in: four views in one window, their places and sizes, themes, fields."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.lungaccess.planning.coupled.planning import TARGET
from tests.lungaccess.showing.explorer.windows import PLANNED, Page, Served
from tests.lungaccess.showing.report import browser

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]
VIEWS = ("scene", "slice-axial", "slice-coronal", "slice-sagittal")
BOXES = """return arguments[0].map((id) => { const b = document.getElementById(id).getBoundingClientRect();
return [b.left, b.top, b.right, b.bottom]; })"""
FAINT_TEXT = """const rgb = (text) => text.match(/[\\d.]+/g).map(Number);
const light = (c) => { const [r, g, b] = c.slice(0, 3).map((v) => v / 255)
  .map((v) => (v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
const ground = (e) => { for (; e; e = e.parentElement) { const c = rgb(getComputedStyle(e).backgroundColor);
  if (c.length === 3 || c[3] > 0.99) return c; } return [255, 255, 255]; };
return [...document.querySelectorAll('body *')].filter((e) => e.checkVisibility() && !e.disabled
  && !e.closest('.view, option') && [...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim()))
.map((e) => {
  const [a, b] = [light(rgb(getComputedStyle(e).color)), light(ground(e))].sort((x, y) => y - x);
  return [(a + 0.05) / (b + 0.05), e.outerHTML.slice(0, 90)]; }).filter(([ratio]) => ratio < 4.5)"""
"""Visible text whose contrast with its ground is below 4.5 (WCAG 2.1, AA), and the contrast."""
MOVE = (
    "const e = document.getElementById('position'); e.value = arguments[0];"
    "e.dispatchEvent(new Event('input'))"
)
"""Moves the slider of the deployment."""
TISSUES = """const { scene } = window.lungaccessExplorer, { canvas } = scene, found = {};
window.lungaccessExplorer.redraw.now();
const sheet = document.createElement('canvas');
[sheet.width, sheet.height] = [canvas.clientWidth, canvas.clientHeight];
const pen = sheet.getContext('2d', { willReadFrequently: true });
pen.drawImage(canvas, 0, 0, sheet.width, sheet.height);
for (let x = 6; x < sheet.width; x += 9) for (let y = 30; y < sheet.height; y += 9) {
  const hit = scene.pick(x, y, { pickable: ['airway', 'vessel', 'nodule'] });
  const name = !hit ? 'ground' : hit.kind === 'surface' ? hit.key : null;
  if (name) (found[name] ??= []).push([...pen.getImageData(x, y, 1, 1).data].slice(0, 3)); }
return found"""
"""The colours of the 3-D view by the tissue that is seen there."""


def size(page: Page, width: int, height: int, *, phone: bool = False) -> None:
    """Give the page itself a size; that of a window counts its frame."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": phone}
    page.command("Emulation.setDeviceMetricsOverride", metrics)
    page.frame()


@pytest.fixture(scope="module")
def room(served: Served) -> Iterator[Page]:
    """A window of 1440 x 900 pixels with a plan."""
    with Page(1440, 1000, dark=True) as window:
        size(window, 1440, 900)
        window.open(served.address.url)
        window.target(TARGET)
        yield window
        assert window.messages() == []


def luminance(colour: Any) -> float:
    """Return the relative luminance of a colour `(3,)` from 0 to 255, as WCAG defines it."""
    share = np.asarray(colour, dtype=np.float64) / 255.0
    linear = np.where(share <= 0.03928, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return float(linear @ (0.2126, 0.7152, 0.0722))


def least_contrast(colours: list[Any]) -> float:
    """Return the least contrast between any two of some colours."""
    lights = np.sort([luminance(each) + 0.05 for each in colours])
    return float((lights[1:] / lights[:-1]).min())


def test_views_headline_and_advice_are_in_view_without_scrolling(room: Page) -> None:
    size(room, 1440, 900)
    boxes = np.array(room.run(BOXES, [*VIEWS, "headline", "plan-table", "advice"]))
    assert boxes.min() >= 0.0 and boxes[:, 2].max() <= 1440.0 and boxes[:, 3].max() <= 900.0
    sides = boxes[:4, 2:] - boxes[:4, :2]
    assert sides.min() >= 280.0
    assert room.run("return [scrollY, document.documentElement.scrollHeight <= innerHeight]") == [0, True]


@pytest.mark.parametrize(("width", "height"), [(1440, 900), (1024, 768), (390, 844)])
def test_nothing_overflows(room: Page, width: int, height: int) -> None:
    size(room, width, height, phone=width < 500)
    assert room.run("return document.documentElement.scrollWidth") <= width
    wide = room.run(
        "return [...document.querySelectorAll('main *')].filter((e) => e.checkVisibility()"
        " && !e.closest('svg, .view, .strip details > ul') && getComputedStyle(e).overflow === 'visible'"
        " && e.scrollWidth > e.clientWidth + 1 && e.clientWidth).map((e) => [e.outerHTML.slice(0, 80),"
        " e.scrollWidth, e.clientWidth])"
    )
    assert wide == []
    size(room, 1440, 900)


def test_any_view_takes_the_place_of_any_other(room: Page) -> None:
    choose = (
        "const e = document.querySelector(`.pane[data-name=${arguments[0]}] > select`);"
        "e.value = arguments[1]; e.dispatchEvent(new Event('change', { bubbles: true }))"
    )
    shown = (
        "return [...document.querySelectorAll('.pane')].filter((e) => !e.hidden)"
        ".sort((a, b) => a.style.gridArea < b.style.gridArea ? -1 : 1).map((e) => e.dataset.name)"
    )
    assert room.run(shown) == ["scene", "axial", "coronal", "sagittal"]
    room.run(choose, "coronal", "bronchoscopy")
    room.run(MOVE, 200)
    room.frame()
    assert room.run(shown) == ["scene", "axial", "bronchoscopy", "sagittal"]
    lit = room.run(
        "const { data } = document.getElementById('inside').getContext('2d').getImageData(0, 0, 440, 440);"
        "return data.filter((v, n) => n % 4 === 0 && v > 60).length"
    )
    assert lit > 10_000 and "carina" in room.text("inside-place")
    room.run(choose, "scene", "coronal")
    assert room.run(shown) == ["coronal", "axial", "bronchoscopy", "sagittal"]
    room.run(choose, "coronal", "scene")
    room.run(choose, "bronchoscopy", "coronal")
    assert room.run(shown) == ["scene", "axial", "coronal", "sagittal"]


def test_bars_between_views_are_moved_by_keys_and_by_dragging(room: Page) -> None:
    before = np.array(room.run(BOXES, list(VIEWS)))
    for share, key, axis in (("across", "ArrowRight", 2), ("down", "ArrowUp", 3), ("views", "ArrowLeft", 2)):
        bar, at = f".split[data-share={share}]", room.run(BOXES, ["scene"])[0][axis]
        room.press(bar, key, key)
        moved = room.run(BOXES, ["scene"])[0][axis]
        assert moved > at if key == "ArrowRight" else moved < at
    box = room.run("const b = document.querySelector('.split[data-share=across]').getBoundingClientRect();"
                   "return [b.left + 3, b.top + 100]")  # fmt: skip
    for kind, x in (("mousePressed", box[0]), ("mouseMoved", box[0] + 120), ("mouseReleased", box[0] + 120)):
        event = {"type": kind, "x": x, "y": box[1], "button": "left", "buttons": 1, "clickCount": 1}
        room.command("Input.dispatchMouseEvent", event)
    room.frame()
    after = np.array(room.run(BOXES, list(VIEWS)))
    assert after[0, 2] > before[0, 2] + 60.0 and after[1, 0] > before[1, 0] + 60.0
    sizes = room.run(
        "return [...document.querySelectorAll('canvas[id^=slice]')].map((c) =>"
        " [c.width / c.height, c.clientWidth / c.clientHeight])"
    )
    for drawn, seen in sizes:
        assert drawn == pytest.approx(seen, rel=0.01)
    for share in ("across", "down"):
        room.run(f"document.querySelector('.four').style.setProperty('--{share}', 50)")
    room.run("document.querySelector('.planning').style.setProperty('--views', 72)")


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_text_is_read_in_both_themes(room: Page, theme: str) -> None:
    if room.run("return document.documentElement.dataset.theme") != theme:
        room.click("theme")
    room.run("document.querySelectorAll('.panel details').forEach((each) => { each.open = true; })")
    assert room.run(FAINT_TEXT) == []


def test_tissues_are_told_apart_on_dark_ground(room: Page) -> None:
    if room.run("return document.documentElement.dataset.theme") != "dark":
        room.click("theme")
    painted = room.run(
        "const { codes, table } = window.lungaccessExplorer.image;"
        "return Object.values(codes).map((code) => [...table.slice(3 * code, 3 * code + 3)])"
    )
    assert len(painted) == 7 and least_contrast(painted) >= 1.5
    seen = room.run(TISSUES)
    tissues = [np.median(seen[name], axis=0) for name in ("ground", "vessel", "airway")]
    assert least_contrast(tissues) >= 1.5
    assert luminance(tissues[0]) < 0.02


def test_the_3d_view_follows_what_plays_and_comes_back(room: Page) -> None:
    room.run("window.lungaccessExplorer.lookAtPlan()")
    centre = "return [...window.lungaccessExplorer.orbit.centre]"
    home = room.run(centre)
    for share in (150, 500, 900):
        room.run(MOVE, share)
        room.frame()
        np.testing.assert_allclose(room.run(centre), room.state()["tip_lps"], atol=1e-6)
    room.run(MOVE, 1000)
    room.frame()
    np.testing.assert_allclose(room.run(centre), home, atol=1e-6)


@pytest.mark.parametrize(("field", "value"), [("needle_radius_mm", "12160"), ("scope_diameter_mm", "1.5")])
def test_bad_input_is_answered_beside_its_field_and_forgotten(room: Page, field: str, value: str) -> None:
    plan = room.state()["plan"]["digest"]
    room.choose(field, value)
    room.wait("document.getElementById('what-if-error').textContent")
    beside = (
        "return document.getElementById('what-if-error').previousElementSibling.querySelector('input').id"
    )
    assert room.run(beside) == field
    room.wait(PLANNED)
    assert room.state()["plan"]["digest"] == plan
    assert (
        room.run(
            "return Object.values(window.lungaccessExplorer.state.asked).includes(arguments[0])", float(value)
        )
        is False
    )
    room.target("nodule 1")
    assert room.text("what-if-error") == ""
    assert room.run("return document.getElementById(arguments[0]).value", field) != value
    room.target(TARGET)


def test_the_nodule_is_shown_with_its_place_and_size(room: Page) -> None:
    room.target("nodule 1")
    listed = room.run("return document.getElementById('nodule').selectedOptions[0].textContent")
    place = json.dumps(listed.removeprefix("nodule 1, "))
    room.wait(f"document.getElementById('place-words').textContent.includes({place})")
    assert listed.endswith(" mm")
    room.target(TARGET)

"""The first screen of a report and its print, in a real browser: all is in view, and nothing over another."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lungaccess.plans.plan import Plan
from tests.lungaccess.showing.report import browser
from tests.lungaccess.showing.report.scripts import PROJECT
from tests.lungaccess.showing.report.test_report_browser import contrast

pytestmark = [
    pytest.mark.slow,
    pytest.mark.browser,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]

BOX = """const b = document.querySelector(arguments[0]).getBoundingClientRect();
return [b.left, b.top, b.right, b.bottom]"""
TEXTS = """const found = [];
for (const e of document.querySelectorAll('body *')) {
  if (!e.checkVisibility({ visibilityProperty: true }) || e.closest('.view, .sample, option')) continue;
  if (![...e.childNodes].some((n) => n.nodeType === 3 && n.data.trim())) continue;
  let ground = e;
  const clear = 'rgba(0, 0, 0, 0)';
  while (getComputedStyle(ground).backgroundColor === clear) ground = ground.parentElement;
  const ink = getComputedStyle(e)[e instanceof SVGElement ? 'fill' : 'color'];
  found.push([e.textContent.trim().slice(0, 30), ink, getComputedStyle(ground).backgroundColor]);
}
return found"""


@pytest.fixture(scope="module")
def window(page: Path) -> Iterator[browser.Browser]:
    with browser.Browser(1440, 900) as opened:
        metrics = {"width": 1440, "height": 900, "deviceScaleFactor": 1, "mobile": False}
        opened.command("Emulation.setDeviceMetricsOverride", metrics)
        opened.open(page)
        yield opened


def test_sentence_picture_numbers_and_player_are_in_view(window: browser.Browser) -> None:
    assert window.messages() == []
    boxes = {
        name: np.array(window.run(BOX, name)) for name in (".headline", "#scene", ".glance", ".player", "h1")
    }
    for box in boxes.values():
        assert (box >= 0).all() and (box[[0, 2]] <= 1440).all() and (box[[1, 3]] <= 900).all()
    assert boxes["#scene"][3] <= boxes[".player"][1]
    # The picture is the largest thing of the screen.
    left, top, right, bottom = boxes["#scene"]
    assert (right - left) * (bottom - top) > 0.4 * 1440 * 900
    assert window.run("return document.querySelectorAll('.glance li').length") == 4
    said = window.run("return document.querySelector('.headline .said').textContent")
    assert window.run("return document.querySelector('.first').textContent").count(said) == 1


def test_the_picture_shows_the_whole_way(window: browser.Browser, plans: tuple[Plan, ...]) -> None:
    """The scope from the carina on, tubes and needle, and the target; the smaller view lacks the scope."""
    plan, width_height = plans[0], window.run(
        "const c = document.getElementById('scene'); return [c.clientWidth, c.clientHeight]"
    )  # fmt: skip
    scope, *devices = plan.curves().present
    beyond = scope.arc_length_mm[-1] - scope.arc_length_mm <= plan.scope.length_from_carina_mm
    points = [scope.points_lps[beyond], *(each.points_lps for each in devices), plan.target_lps[None]]
    spread = {}
    for fitted, shown in (("plan", points), ("target", points[1:])):
        window.run("document.querySelector(`button[data-fit=${arguments[0]}]`).click()", fitted)
        window.frame()
        places = np.array([window.run(PROJECT, point.tolist()) for point in np.concatenate(shown)[::4]])
        assert (places > 0).all() and (places < width_height).all()
        spread[fitted] = window.state()["view"]["distance"]
    assert spread["target"] < spread["plan"]
    window.run("document.querySelector('button[data-fit=plan]').click()")


def test_the_view_goes_with_the_scope(window: browser.Browser) -> None:
    middle = np.array(window.run(BOX, "#scene")).reshape(2, 2)
    middle = (middle[1] - middle[0]) / 2
    for position in (0.1, 0.25):
        window.run("window.lungaccessReport.set(arguments[0])", position)
        state = window.state()
        assert state["stage"] == "scope"
        np.testing.assert_allclose(window.run(PROJECT, state["tip_lps"]), middle, atol=0.5)
    window.run("window.lungaccessReport.set(1)")
    assert np.abs(np.array(window.run(PROJECT, window.state()["tip_lps"])) - middle).max() > 5


def test_a_cut_and_words_below_do_not_move_the_view(window: browser.Browser) -> None:
    before = window.run(BOX, "#scene")
    window.run("document.getElementById('cut').click(); document.getElementById('measure').click()")
    window.frame()
    assert window.run(BOX, "#scene") == before
    window.run("document.getElementById('measure').click(); document.getElementById('cut').click()")


def test_nothing_is_drawn_outside_of_the_view(window: browser.Browser) -> None:
    """The cross of the slices and the labels are cut off at its border."""
    clipped = window.run(
        """const view = document.querySelector('.view');
        const inside = (e) => view.contains(e) && getComputedStyle(view).overflow === 'hidden';
        const drawn = ['.scene-cross', '#scene-labels', '#pointed'];
        return drawn.map((each) => inside(document.querySelector(each)))"""
    )
    assert clipped == [True, True, True]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out_from_its_ground(window: browser.Browser, scheme: str) -> None:
    features = [{"name": "prefers-color-scheme", "value": scheme}]
    window.command("Emulation.setEmulatedMedia", {"features": features})
    window.frame()
    found = window.run(TEXTS)
    assert len(found) > 100
    for text, ink, ground in found:
        colours = [np.array([float(n) for n in re.findall(r"[\d.]+", each)[:3]]) for each in (ink, ground)]
        assert contrast(*colours) >= 4.5, (text, ink, ground)
    window.command("Emulation.setEmulatedMedia", {"features": [{**features[0], "value": "light"}]})


def test_charts_show_what_matters_and_keep_their_height(window: browser.Browser) -> None:
    """The nearest curve takes a good part of the height; text below a chart makes no chart taller."""
    heights = "return [...document.querySelectorAll('.charts svg:has(> svg)')].map((e) => e.clientHeight)"
    before = window.run(heights)
    window.run("document.querySelector('.cost-total').append(' word'.repeat(300))")
    assert window.run(heights) == before
    lowest = window.run(
        """const curves = [...document.querySelectorAll('.chart-clearance svg > svg > path')].slice(0, -1);
        return Math.max(...curves.map((e) => e.getBBox()).map((b) => b.y + b.height))"""
    )
    # In the lower half of the frame, which goes from 12 down to 226.
    assert 119 < lowest < 227


def test_no_interval_is_wrapped(window: browser.Browser) -> None:
    lines = window.run(
        """return [...document.querySelectorAll('.shares td, .plans td:nth-child(2)')].map((e) => {
          const range = document.createRange();
          range.selectNodeContents(e);
          return range.getBoundingClientRect().height / parseFloat(getComputedStyle(e).lineHeight);
        })"""
    )
    assert len(lines) > 1 and max(lines) < 1.5


def test_it_prints_to_two_pages_with_its_picture(window: browser.Browser) -> None:
    window.run("window.lungaccessReport.set(1)")
    sheet: dict[str, Any] = {"paperWidth": 8.27, "paperHeight": 11.69, "printBackground": True}
    printed = base64.b64decode(window.command("Page.printToPDF", sheet)["data"])
    assert len(re.findall(rb"/Type\s*/Page\b", printed)) == 2
    # The picture is in it: what is printed where the view is empty is smaller by far.
    window.run("document.getElementById('scene').style.visibility = 'hidden'")
    empty = base64.b64decode(window.command("Page.printToPDF", sheet)["data"])
    window.run("document.getElementById('scene').style.visibility = ''")
    assert len(printed) > len(empty) + 20_000


def test_a_tube_looks_like_one_from_inside(window: browser.Browser) -> None:
    """Rings lie across it: along its middle it grows dark more often than where it begins before the wall."""
    window.run("window.lungaccessReport.set(1)")
    light = window.run(
        """const c = document.getElementById('inside'), side = c.width;
        const d = c.getContext('2d').getImageData(side / 2, side / 2, 1, side / 2).data;
        return Array.from({ length: side / 2 }, (_, n) => d[4 * n] + d[4 * n + 1] + d[4 * n + 2])"""
    )
    assert (np.diff(light) < -40).sum() >= 3

"""The page of a plan in a real browser: it opens, the slider moves the devices, switches and keys work."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from lungaccess.plans.insertion import scope_motion
from lungaccess.plans.plan import Plan
from tests.lungaccess.showing.report import browser, made_scene
from tests.lungaccess.showing.report.scripts import CHOOSE, PICTURE

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]

RED_AND_BLUE = """const c = document.getElementById('inside');
const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
let red = 0, blue = 0;
for (let n = 0; n < d.length; n += 4) { red += d[n]; blue += d[n + 2]; }
return [4 * red / d.length, 4 * blue / d.length]"""
LABELS = "return [...document.querySelectorAll('#scene-labels > span')].map((e) => e.textContent)"
LUNGS_ALONE = """const c = document.getElementById('scene'), found = [];
for (let x = 3; x < c.clientWidth; x += 17) for (let y = 3; y < c.clientHeight; y += 17) {
  const hit = window.lungaccessReport.pick(x, y);
  if (hit && hit.hits.every((each) => each.key === 'lung')) found.push([x, y]);
}
return found"""


@pytest.fixture
def page(breathing_window: browser.Browser) -> browser.Browser:
    return breathing_window


def test_it_opens_without_a_word_on_the_console(page: browser.Browser) -> None:
    state = page.state()
    assert page.messages() == []
    assert state["gl_error"] == 0
    assert state["triangles"] > 5000
    drawn = page.run(
        "return [...document.querySelectorAll('.charts svg > svg')].map((e) => e.checkVisibility())"
    )
    # Distances, room over the breath, curvature, cost and its history; hidden are other phases and plans.
    assert sum(drawn) == 5 < len(drawn)


def test_nothing_is_asked_of_the_network(page: browser.Browser) -> None:
    names = page.run("return performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert [name for name in names if not name.startswith("data:")] == []


@pytest.mark.slow
def test_the_slider_moves_scope_tubes_and_needle_to_where_the_plan_has_them(
    page: browser.Browser, plans: tuple[Plan, ...]
) -> None:
    plan = plans[0]
    page.run("window.lungaccessReport.set(1)")
    end = page.state()
    np.testing.assert_allclose(end["tip_lps"], plan.needle.end_lps, atol=2e-3)
    assert end["needle_mm"] == pytest.approx(plan.needle.length_mm, abs=1e-3)
    assert end["inner_mm"] == pytest.approx(plan.tube.inner_insertion_mm, abs=1e-3)
    assert end["solids"]["needle"] > 0
    page.run("window.lungaccessReport.set(0)")
    start = page.state()
    np.testing.assert_allclose(start["tip_lps"], scope_motion(plan).tips[0, :3, 3], atol=1e-3)
    assert (start["stage"], start["needle_mm"], start["inner_mm"]) == ("scope", 0, 0)
    assert not {"needle", "inner", "outer"} & start["solids"].keys()
    travelled = []
    for position in np.linspace(0.0, 1.0, 21):
        page.run("window.lungaccessReport.set(arguments[0])", float(position))
        state = page.state()
        travelled.append([state[name] for name in ("scope_mm", "outer_mm", "inner_mm", "needle_mm")])
    steps = np.diff(travelled, axis=0)
    assert (steps >= -1e-6).all()
    assert (steps.max(axis=1) > 0).all()
    words = page.run("return document.getElementById('position').getAttribute('aria-valuetext')")
    assert words == f"Needle: {plan.needle.length_mm:.1f} of {plan.needle.length_mm:.1f} mm"


def test_the_tip_of_the_scope_is_where_the_plan_has_it(
    page: browser.Browser, plans: tuple[Plan, ...]
) -> None:
    page.run("document.querySelector('button[data-stage=\"1\"]').click()")
    page.frame()
    state = page.state()
    np.testing.assert_allclose(state["camera"]["eye"], plans[0].scope.lps_from_scope_tip[:3, 3], atol=0.2)
    angle = np.dot(state["camera"]["forward"], plans[0].scope.lps_from_scope_tip[:3, 2])
    assert angle > 0.99


def test_keys_move_slider_and_view(page: browser.Browser) -> None:
    page.press("#position", "Home")
    assert page.state()["position"] == 0
    page.press("#position", "ArrowRight", "ArrowRight", "ArrowRight")
    assert page.state()["position"] == pytest.approx(0.003)
    before = page.state()["view"]
    page.press("#scene", "ArrowLeft", "ArrowUp", "+")
    after = page.state()["view"]
    assert after["yaw"] < before["yaw"]
    assert after["pitch"] > before["pitch"]
    assert after["distance"] < before["distance"]
    page.press("#scene", "f")
    assert page.state()["view"]["distance"] == before["distance"]
    page.press("#scene", "0")
    assert page.state()["view"]["distance"] > 1.5 * before["distance"]
    page.run("document.querySelector('button[data-fit=plan]').click()")
    page.frame()
    assert page.state()["view"] == before


def test_every_control_can_have_the_focus(page: browser.Browser) -> None:
    lost = page.run(
        """const all = [...document.querySelectorAll('input, select, button, summary, canvas[tabindex]')];
        const focused = (e) => { e.focus({ preventScroll: true }); return document.activeElement === e; };
        const kinds = { contentVisibilityAuto: true, visibilityProperty: true };
        const seen = all.filter((e) => e.checkVisibility(kinds));
        return seen.filter((e) => !focused(e)).map((e) => e.outerHTML)"""
    )
    assert lost == []


@pytest.mark.slow
def test_switches_show_and_hide(page: browser.Browser) -> None:
    keys = page.run("return [...document.querySelectorAll('input[data-key]')].map((box) => box.dataset.key)")
    assert {"scope", "tubes", "needle", "airway", "vessel", "lung", "fissure", "plan-0", "plan-1"} <= set(
        keys
    )
    before = page.run(PICTURE, 1, "scene")
    for key in ("scope", "needle", "vessel", "fissure", "plan-1"):
        shown = page.run("return document.querySelector(`input[data-key='${arguments[0]}']`).checked", key)
        page.press(f"input[data-key='{key}']", " ")
        state = page.state()
        named = {
            **state["devices"],
            **state["structures"],
            **{f"plan-{n}": on for n, on in enumerate(state["plans"])},
        }
        assert named[key] is not shown
        assert page.run(PICTURE, 1, "scene") != before, key
        # Without waiting for a picture of it: each takes seconds where the processor draws.
        page.run("document.querySelector(`input[data-key='${arguments[0]}']`).click()", key)
    assert page.run(PICTURE, 1, "scene") == before


def test_several_plans_have_numbers_and_styles(page: browser.Browser) -> None:
    page.run("window.lungaccessReport.set(1)")
    assert page.run(LABELS) == []
    page.run("document.querySelector(`input[data-key='plan-1']`).click(); window.lungaccessReport.set(1)")
    assert page.run(LABELS) == ["0", "1"]
    assert "plan 1" in page.state()["solids"]
    swatches = page.run(
        "return [0, 1].map((n) => "
        "document.querySelector(`[data-key='plan-${n}'] + .swatch`).style.background)"
    )
    assert swatches[0] != swatches[1]
    page.run("document.querySelector(`input[data-key='plan-1']`).click(); window.lungaccessReport.set(1)")


@pytest.mark.slow
def test_another_plan_can_be_followed(page: browser.Browser, plans: tuple[Plan, ...]) -> None:
    page.run(CHOOSE, "followed", "1")
    page.run("window.lungaccessReport.set(1)")
    state = page.state()
    assert state["plan"] == 1
    np.testing.assert_allclose(state["tip_lps"], plans[1].needle.end_lps, atol=2e-3)
    page.run(CHOOSE, "followed", "0")


@pytest.mark.slow
def test_the_bronchoscopy_shows_the_airway(page: browser.Browser) -> None:
    page.run("window.lungaccessReport.set(0.1)")
    red, blue = page.run(RED_AND_BLUE)
    assert red > 40
    assert red > 1.2 * blue
    assert page.run(PICTURE, 0.1, "inside") != page.run(PICTURE, 0.2, "inside")


@pytest.mark.slow
def test_playing_moves_the_slider(page: browser.Browser) -> None:
    page.run("window.lungaccessReport.set(0)")
    # A machine on which a frame lasts long comes to a bifurcation in the first one.
    page.run("document.getElementById('pause').checked = false")
    page.run("document.getElementById('play').click()")
    # No longer than it takes to move: on a slow machine few frames last as long as the whole motion.
    frames = 0
    while page.state()["position"] == 0:
        page.frame()
        frames += 1
        assert frames < 10
    assert page.run("return document.getElementById('play').textContent") == "Pause"
    page.run("document.getElementById('play').click()")
    stopped = page.state()["position"]
    page.frame()
    assert page.state()["position"] == stopped


@pytest.mark.slow
def test_a_phone_needs_no_sideways_scrolling_and_a_dark_page_is_dark_and_shows_lungs(
    breathing_page: Path,
) -> None:
    with browser.Browser(390, 844, phone=True, dark=True) as phone:
        phone.open(breathing_page)
        assert phone.messages() == []
        page = "document.querySelector('.page').scrollWidth"
        assert phone.run(f"return [document.documentElement.scrollWidth, {page}, innerWidth]") == [390] * 3
        small = phone.run(
            """return [...document.querySelectorAll('.player button, select, label')]
            .filter((e) => e.offsetParent && e.getBoundingClientRect().height < 24).map((e) => e.outerHTML)"""
        )
        assert small == []
        colour = phone.run("return getComputedStyle(document.body).backgroundColor")
        assert max(int(part) for part in re.findall(r"\d+", colour)) < 60
        seen = contrasts_of_lungs(phone)
        assert np.quantile(seen, 0.1) > 1.2
        assert np.median(seen) > 1.3


@pytest.mark.slow
def test_lungs_stand_out_from_a_light_ground(page: browser.Browser) -> None:
    seen = contrasts_of_lungs(page)
    page.run("document.querySelector('button[data-fit=plan]').click()")
    assert np.quantile(seen, 0.1) > 1.05
    assert np.median(seen) > 1.08


def contrasts_of_lungs(page: browser.Browser) -> list[float]:
    """Return the contrast of the ground and of places of the lungs with nothing else before or behind."""
    page.run("document.querySelector('button[data-fit=all]').click()")
    page.run("document.querySelector('button[data-view=front]').click(); window.lungaccessReport.set(1)")
    found = page.run(LUNGS_ALONE)
    picture = made_scene.decoded(page.run(PICTURE, 1, "scene"))
    scale = picture.shape[1] / page.run("return document.getElementById('scene').clientWidth")
    seen = [contrast(picture[int(y * scale), int(x * scale)], picture[2, 2]) for x, y in found]
    assert len(seen) > 20
    return seen


def contrast(one: np.ndarray, other: np.ndarray) -> float:
    """Return the contrast of two colours, 0 to 255, as WCAG 2 defines it."""
    srgb = np.stack([one, other]) / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    light = linear @ [0.2126, 0.7152, 0.0722]
    return float((light.max() + 0.05) / (light.min() + 0.05))

"""The pages in a real browser: they open, the slider moves the devices, switches and keys work."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from anatomy import structures
from anatomy.lung import Lung
from lungaccess.breathing.moving import Moving
from lungaccess.plans.insertion import scope_motion
from lungaccess.plans.plan import Plan
from lungaccess.report.html import volumes
from tests.lungaccess.report import browser
from tests.lungaccess.report.pages import make_reach, plan_file, reach_file

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]

PICTURE = (
    "window.lungaccessReport.set(arguments[0]); return document.getElementById(arguments[1]).toDataURL()"
)
CHOOSE = """const s = document.getElementById(arguments[0]);
s.value = arguments[1]; s.dispatchEvent(new Event('change'))"""
RED_AND_BLUE = """const c = document.getElementById('inside');
const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
let red = 0, blue = 0;
for (let n = 0; n < d.length; n += 4) { red += d[n]; blue += d[n + 2]; }
return [4 * red / d.length, 4 * blue / d.length]"""
LUMEN = (14, 58, 87)


@pytest.fixture(scope="module")
def file(breathing_plans: tuple[Plan, ...], breathing_lung: Lung, tmp_path_factory: Any) -> Path:
    """A page that breathes, in the phase of the masks at first."""
    return plan_file(breathing_plans, breathing_lung, None, tmp_path_factory.mktemp("browser"))


@pytest.fixture(scope="module")
def page(file: Path) -> Iterator[browser.Browser]:
    with browser.Browser(1000, 700) as window:
        window.open(file)
        yield window


def test_it_opens_without_a_word_on_the_console(page: browser.Browser) -> None:
    state = page.state()
    assert page.messages() == []
    assert state["gl_error"] == 0
    assert state["triangles"] > 5000
    assert page.run("return document.querySelectorAll('.charts figure:not([hidden]) > svg').length") == 5


def test_nothing_is_asked_of_the_network(page: browser.Browser) -> None:
    names = page.run("return performance.getEntriesByType('resource').map((entry) => entry.name)")
    assert [name for name in names if not name.startswith("data:")] == []


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
    page.press("#scene", "0")
    assert page.state()["view"] == before


def test_every_control_can_have_the_focus(page: browser.Browser) -> None:
    lost = page.run(
        """const all = [...document.querySelectorAll('input, select, button, summary, canvas[tabindex]')];
        const focused = (e) => { e.focus({ preventScroll: true }); return document.activeElement === e; };
        return all.filter((e) => e.offsetParent && !focused(e)).map((e) => e.outerHTML)"""
    )
    assert lost == []


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


def test_another_plan_can_be_followed(page: browser.Browser, plans: tuple[Plan, ...]) -> None:
    page.run(CHOOSE, "followed", "1")
    page.run("window.lungaccessReport.set(1)")
    state = page.state()
    assert state["plan"] == 1
    np.testing.assert_allclose(state["tip_lps"], plans[1].needle.end_lps, atol=2e-3)
    page.run(CHOOSE, "followed", "0")


def test_the_bronchoscopy_shows_the_airway(page: browser.Browser) -> None:
    page.run("window.lungaccessReport.set(0.1)")
    red, blue = page.run(RED_AND_BLUE)
    assert red > 40
    assert red > 1.2 * blue
    assert page.run(PICTURE, 0.1, "inside") != page.run(PICTURE, 0.2, "inside")


def test_left_is_left_in_the_slices(page: browser.Browser, small_lung: Lung) -> None:
    """The lumen of the airways is painted where the labels have it, by radiological convention."""
    page.run(CHOOSE, "field", "380")
    page.run("window.lungaccessReport.set(1)")
    state = page.state()
    assert state["slice_edges"]["axial"] == ["R", "L", "A", "P"]
    assert state["slice_edges"]["coronal"] == ["R", "L", "H", "F"]
    assert state["slice_edges"]["sagittal"] == ["A", "P", "H", "F"]
    assert state["view"]["edges"] == ["R", "L", "F", "H"]
    centre = np.array(state["tip_lps"])
    codes = volumes.label_codes(small_lung, (0, 0, 0), small_lung.grid.shape)
    lumen = codes.grid.lps(np.argwhere(codes.array == volumes.CODES["lumen"]))
    compared, told_apart = 0, np.zeros(2)
    for name, (across, down, normal) in {
        "axial": ((0, 1), (1, 1), 2), "coronal": ((0, 1), (2, -1), 1), "sagittal": ((1, 1), (2, -1), 0)
    }.items():  # fmt: skip
        seen = pixels(page, f"slice-{name}", LUMEN)
        near = lumen[np.abs(lumen[:, normal] - centre[normal]) <= 0.5 * small_lung.grid.spacing_mm.max()]
        if len(near) < 25 or len(seen) < 25:
            continue
        compared += 1
        aside = [sign * (near[:, axis] - centre[axis]).mean() * 360 / 380 for axis, sign in (across, down)]
        np.testing.assert_allclose(seen.mean(axis=0) - 180, aside, atol=7.0)
        told_apart += np.abs(aside) > 10.0
    # So far beside the centre that a mirrored picture would be found out.
    assert compared
    assert told_apart.all()


def pixels(page: browser.Browser, canvas: str, colour: tuple[int, int, int]) -> np.ndarray:
    """Return columns and rows of the pixels of a colour."""
    script = """const c = document.getElementById(arguments[0]), wanted = arguments[1], found = [];
    const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
    for (let n = 0; n < d.length; n += 4) {
      const same = wanted.every((value, k) => Math.abs(d[n + k] - value) <= 1);
      if (same) found.push([(n / 4) % c.width, Math.floor(n / 4 / c.width)]);
    }
    return found;"""
    return np.array(page.run(script, canvas, list(colour)), dtype=float).reshape(-1, 2)


def test_everything_breathes_together(
    page: browser.Browser, breathing_plans: tuple[Plan, ...], breathing_lung: Lung
) -> None:
    """Devices and target go where Python has them, inside and outside the window; all pictures change."""
    plan, canvases = breathing_plans[0], ("scene", "slice-axial", "slice-across", "inside")
    moving, before = Moving.of(plan, breathing_lung), [page.run(PICTURE, 1, name) for name in canvases]
    for phase, said in ((0.0, "✗ not proved"), (0.35, "✗ not proved"), (0.8, "✓ proved")):
        page.run("window.lungaccessReport.set(1); window.lungaccessReport.breathe(arguments[0])", phase)
        state = page.state()
        end = moving.carried(np.array(plan.needle.end_lps)[None], phase)[0]
        np.testing.assert_allclose(state["tip_lps"], end, atol=5e-3)
        np.testing.assert_allclose(state["needle_lps"][-1], end, atol=5e-3)
        target = moving.moved(np.array(plan.target_lps)[None], phase)[0]
        np.testing.assert_allclose(state["target_lps"], target, atol=0.03)
        words = page.run("return document.getElementById('phase-words').textContent")
        assert words.startswith(f"{100 * phase:.0f} % of the breath: {said}")
        if phase == 0.0:
            assert all(page.run(PICTURE, 1, name) != old for name, old in zip(canvases, before, strict=True))
            assert state["gl_error"] == 0
    page.run("window.lungaccessReport.breathe(1)")
    assert [page.run(PICTURE, 1, name) for name in canvases] == before


def test_the_lumen_breathes_in_the_slices(
    page: browser.Browser, breathing_plans: tuple[Plan, ...], breathing_lung: Lung
) -> None:
    """It is painted where Python has moved its voxels."""
    moving, step_mm = Moving.of(breathing_plans[0], breathing_lung), 140 / 360
    page.run(CHOOSE, "field", "140")
    page.run("window.lungaccessReport.set(0.2); window.lungaccessReport.breathe(0)")
    across, down = pixels(page, "slice-axial", LUMEN).T
    aside = np.stack([across - 179.5, down - 179.5, np.zeros(len(across))], axis=1)
    places = np.array(page.state()["tip_lps"]) + step_mm * aside
    masks = moving.pulled_back(places, 0.0)
    assert len(places) > 50
    assert np.linalg.norm(masks - places, axis=1).min() > 0.3
    index = np.rint(breathing_lung.grid.ijk(masks)).astype(int)
    assert ((breathing_lung.labels[tuple(index.T)] & structures.LUMEN) != 0).mean() > 0.9
    page.run("window.lungaccessReport.breathe(1)")


def test_playing_moves_the_slider(page: browser.Browser) -> None:
    page.run("window.lungaccessReport.set(0)")
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


def test_the_breath_plays_and_is_held(page: browser.Browser) -> None:
    page.run("window.lungaccessReport.breathe(0.2); document.getElementById('breathe').click()")
    frames = 0
    while page.state()["phase"] == 0.2:
        page.frame()
        frames += 1
        assert frames < 10
    page.run("document.getElementById('breathe').click()")
    held = page.state()["phase"]
    page.frame()
    assert page.state()["phase"] == held
    page.run("window.lungaccessReport.breathe(1)")


def test_a_phone_needs_no_sideways_scrolling_and_a_dark_page_is_dark(file: Path) -> None:
    with browser.Browser(390, 844, phone=True, dark=True) as phone:
        phone.open(file)
        assert phone.messages() == []
        widths = phone.run("return [document.documentElement.scrollWidth, innerWidth]")
        assert widths == [390, 390]
        small = phone.run(
            """return [...document.querySelectorAll('.player button, select, label')]
            .filter((e) => e.offsetParent && e.getBoundingClientRect().height < 24).map((e) => e.outerHTML)"""
        )
        assert small == []
        colour = phone.run("return getComputedStyle(document.body).backgroundColor")
        assert max(int(part) for part in re.findall(r"\d+", colour)) < 60


def test_the_map_opens_and_its_slices_follow_the_sliders(small_lung: Lung, tmp_path: Path) -> None:
    reach = make_reach(small_lung)
    file = reach_file(reach, small_lung, tmp_path)
    with browser.Browser() as window:
        window.open(file)
        assert window.messages() == []
        state = window.state()
        assert state["gl_error"] == 0
        assert state["structures"]["0: reachable"] is True
        before = window.run("return Number(document.getElementById('place-2').value)")
        window.press("#place-2", "ArrowRight", "ArrowRight")
        assert window.state()["place_lps"][2] == before + 2
        i, j, k = np.argwhere(reach.reached)[len(np.argwhere(reach.reached)) // 2]
        window.run("window.lungaccessReport.set(arguments[0])", reach.kinds.grid.lps([i, j, k]).tolist())
        words = window.state()["words"]
        assert words.startswith("direct arc, clearance ")
        stated = float(words.split()[-2])
        assert stated == pytest.approx(float(reach.clearance_mm.array[i, j, k]), abs=0.08)
        before = window.run("return document.getElementById('slice-axial').toDataURL()")
        window.run(CHOOSE, "quantity", "clearance")
        window.frame()
        assert window.run("return document.getElementById('slice-axial').toDataURL()") != before
        assert window.run("return document.documentElement.scrollWidth <= innerWidth")

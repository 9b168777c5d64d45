"""The pages in a real browser: they open, the slider moves the devices, switches and keys work."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from anatomy import structures
from anatomy.lung import Lung
from lungaccess.breathing.moving import Moving
from lungaccess.plans.insertion import scope_motion
from lungaccess.plans.plan import Plan
from lungaccess.report.html import volumes
from tests.lungaccess.report import browser, made_scene
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
PROJECT = "return window.lungaccessReport.project(arguments[0])"
LABELS = "return [...document.querySelectorAll('#scene-labels > span')].map((e) => e.textContent)"
POINTER = """const c = document.getElementById('scene'), at = c.getBoundingClientRect();
const send = (kind) => c.dispatchEvent(new PointerEvent(kind, { pointerId: 1, bubbles: true,
  clientX: at.x + arguments[0], clientY: at.y + arguments[1] }));
c.setPointerCapture = () => {};"""
POINT = f"{POINTER} send('pointermove');"
CLICK = f"{POINTER} send('pointerdown'); send('pointerup');"
LUNGS_ALONE = """const c = document.getElementById('scene'), found = [];
for (let x = 3; x < c.clientWidth; x += 17) for (let y = 3; y < c.clientHeight; y += 17) {
  const hit = window.lungaccessReport.pick(x, y);
  if (hit && hit.hits.every((each) => each.key === 'lung')) found.push([x, y]);
}
return found"""
SLIDE = """const s = document.getElementById(arguments[0]);
s.value = arguments[1]; s.dispatchEvent(new Event('input'))"""


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
        const seen = all.filter((e) => e.checkVisibility({ contentVisibilityAuto: true }));
        return seen.filter((e) => !focused(e)).map((e) => e.outerHTML)"""
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


def test_the_first_view_fits_the_plan(page: browser.Browser, plans: tuple[Plan, ...]) -> None:
    """Tubes and needle are in it, and large."""
    page.run("document.querySelector('button[data-fit=plan]').click(); window.lungaccessReport.set(1)")
    curves = plans[0].curves()
    points = np.concatenate([each.points_lps for each in curves.present[1:]])
    width, height = page.run(
        "const c = document.getElementById('scene'); return [c.clientWidth, c.clientHeight]"
    )
    places = np.array([page.run(PROJECT, point.tolist()) for point in points[:: max(len(points) // 40, 1)]])
    assert (places > 0).all()
    assert (places < [width, height]).all()
    assert np.linalg.norm(np.ptp(places, axis=0)) > 0.3 * min(width, height)


def test_pointing_names_what_is_there_and_how_far_from_the_needle(
    page: browser.Browser, plans: tuple[Plan, ...]
) -> None:
    page.run("window.lungaccessReport.set(1)")
    plan = plans[0]
    target = np.array(plan.target_lps)
    x, y = page.run(PROJECT, target.tolist())
    found = page.run("return window.lungaccessReport.pick(arguments[0], arguments[1])", x, y)
    # The balls of target and nodule, and the needle in them: of 1.6 mm, and its near side is hit.
    solid = next(each for each in found["hits"] if each["kind"] == "solid")
    assert solid["key"] in ("target", "needle")
    assert np.linalg.norm(np.array(solid["point"]) - target) < 2.5
    page.run(POINT, x, y)
    page.frame()
    words = page.run("return document.getElementById('pointed').textContent")
    name, needle, far = words.split(" · ")
    assert name == {"target": "Target", "needle": "Needle", "nodule": "Nodules"}[found["key"]]
    assert far == f"{np.linalg.norm(np.array(found['point']) - target):.1f} mm to the target"
    axis = plan.curves().needle.points_lps
    assert float(needle.split()[0]) == pytest.approx(
        np.linalg.norm(axis - np.array(found["point"]), axis=1).min(), abs=0.3
    )
    # The keyboard's way: what is in the middle.
    page.press("#scene", "\ue007")
    middle = page.run("return document.getElementById('scene-words').textContent")
    picked = page.run(
        "const c = document.getElementById('scene'); "
        "return window.lungaccessReport.pick(c.clientWidth / 2, c.clientHeight / 2)"
    )
    assert (middle == "Nothing there") is (picked is None)
    page.press("#scene", "\ue00c")


def test_two_clicks_measure(page: browser.Browser, plans: tuple[Plan, ...]) -> None:
    page.run("window.lungaccessReport.set(1); document.getElementById('measure').click()")
    needle = plans[0].curves().needle.points_lps
    ends = [needle[len(needle) // 5], needle[-1]]
    points = []
    for end in ends:
        x, y = page.run(PROJECT, end.tolist())
        page.run(CLICK, x, y)
        page.frame()
        points.append(
            page.run("return window.lungaccessReport.pick(arguments[0], arguments[1])", x, y)["point"]
        )
    words = page.run("return document.getElementById('scene-words').textContent")
    length, along = (float(part.split(" mm")[0]) for part in words.split("; "))
    # Within the radii of what was hit: the needle is drawn thicker than it is, the target is a ball.
    assert length == pytest.approx(np.linalg.norm(ends[1] - ends[0]), abs=2.5)
    assert along == pytest.approx(
        np.linalg.norm(np.diff(needle[len(needle) // 5 :], axis=0), axis=1).sum(), abs=2.5
    )
    labels = page.run(
        "return [...document.querySelectorAll('#scene-labels > span')].map((e) => e.textContent)"
    )
    assert f"{length:.1f} mm" in labels
    assert "measure" in page.state()["solids"]
    page.press("#scene", "m")
    middle = page.run("return document.getElementById('scene-words').textContent")
    assert middle.startswith("From ") or middle == "Nothing there to measure from"
    page.press("#scene", "\ue00c")
    assert "measure" not in page.state()["solids"]
    assert page.run("return document.getElementById('measure').getAttribute('aria-pressed')") == "false"


def test_the_cut_goes_through_the_needle_and_faces_the_viewer(
    page: browser.Browser, plans: tuple[Plan, ...]
) -> None:
    before = page.run(PICTURE, 1, "scene")
    needle = plans[0].curves().needle.points_lps
    page.run("document.getElementById('cut').click()")
    for offset in (0, 12):
        page.run(SLIDE, "cut-offset", str(offset))
        for turn in ("ArrowLeft", "ArrowUp"):
            page.press("#scene", turn)
            page.run("window.lungaccessReport.set(1)")
            *normal, level = page.state()["view_tools"]["cut"]
            assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-6)
            for end in (needle[0], needle[-1]):
                assert np.dot(normal, end) + level == pytest.approx(offset, abs=0.02)
    assert page.run("return document.getElementById('cut-words').textContent") == "12 mm before it"
    assert page.run(PICTURE, 1, "scene") != before
    page.run("document.getElementById('cut').click()")
    page.run(SLIDE, "cut-offset", "0")
    page.press("#scene", "f")
    page.run("document.querySelector('button[data-view=front]').click()")


def test_what_is_near_can_be_brought_out_or_not(page: browser.Browser) -> None:
    before = page.run(PICTURE, 1, "scene")
    page.run("document.getElementById('focus').click()")
    assert page.run(PICTURE, 1, "scene") != before
    page.run("document.getElementById('focus').click()")
    assert page.run(PICTURE, 1, "scene") == before


def test_pictures_and_films_are_saved(page: browser.Browser, tmp_path: Path) -> None:
    page.command("Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(tmp_path)})
    page.run("document.getElementById('save-picture').click()")
    picture = wait_for_file(page, tmp_path, ".png")
    image = Image.open(picture)
    shown = page.run("const c = document.getElementById('scene'); return [c.clientWidth, c.clientHeight]")
    assert image.size[0] >= shown[0] and image.size[0] / image.size[1] == pytest.approx(
        shown[0] / shown[1], abs=0.01
    )
    assert np.ptp(np.asarray(image.convert("L"))) > 100
    for kind in ("turn", "deployment"):
        page.run(CHOOSE, "film-kind", kind)
        film = recorded(page, tmp_path)
        assert film[:4] == b"\x1a\x45\xdf\xa3"
        assert len(film) > 1000
    assert page.run("return document.getElementById('save-film').textContent") == "Save film"
    assert page.messages() == []


def recorded(page: browser.Browser, folder: Path) -> bytes:
    """Return a film of so many pictures that the browser has begun to write them."""
    film = b""
    for frames in (5, 20, 60, 120):
        page.run("document.getElementById('save-film').click()")
        for _ in range(frames):
            page.frame()
        # Where it was not stopped, it has come to its end.
        stop = "if (b.textContent === 'Stop film') b.click()"
        page.run(f"const b = document.getElementById('save-film'); {stop}")
        file = wait_for_file(page, folder, ".webm")
        film = file.read_bytes()
        file.unlink()
        if len(film) > 1000:
            break
    return film


def wait_for_file(page: browser.Browser, folder: Path, ending: str) -> Path:
    """Return the file of a download when it is complete."""
    for _ in range(600):
        found = [each for each in folder.iterdir() if each.suffix == ending]
        if found and found[0].stat().st_size:
            return found[0]
        page.frame()
    raise AssertionError(f"no {ending} was saved")


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


def test_a_phone_needs_no_sideways_scrolling_and_a_dark_page_is_dark_and_shows_lungs(file: Path) -> None:
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
        seen = contrasts_of_lungs(phone)
        assert np.quantile(seen, 0.1) > 1.2
        assert np.median(seen) > 1.3


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

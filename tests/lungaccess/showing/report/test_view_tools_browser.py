"""The 3-D view of a page in a real browser: sides, pointing, measuring, the cut, pictures and films."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lungaccess.plans.plan import Plan
from tests.lungaccess.showing.report import browser
from tests.lungaccess.showing.report.scripts import CHOOSE, PICTURE, PROJECT, SLIDE

pytestmark = [
    pytest.mark.slow,
    pytest.mark.browser,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]

POINTER = """const c = document.getElementById('scene'), at = c.getBoundingClientRect();
const send = (kind) => c.dispatchEvent(new PointerEvent(kind, { pointerId: 1, bubbles: true,
  clientX: at.x + arguments[0], clientY: at.y + arguments[1] }));
c.setPointerCapture = () => {};"""
POINT = f"{POINTER} send('pointermove');"
CLICK = f"{POINTER} send('pointerdown'); send('pointerup');"
SWITCH_STRUCTURES = "document.querySelectorAll('#structures input').forEach((each) => each.click())"


@pytest.fixture
def page(breathing_window: browser.Browser) -> browser.Browser:
    return breathing_window


def test_the_view_of_the_target_fits_tubes_and_needle(page: browser.Browser, plans: tuple[Plan, ...]) -> None:
    """They are in it, and large; the view of all is from farther away."""
    page.run("document.querySelector('button[data-fit=target]').click(); window.lungaccessReport.set(1)")
    curves = plans[0].curves()
    points = np.concatenate([each.points_lps for each in curves.present[1:]])
    width, height = page.run(
        "const c = document.getElementById('scene'); return [c.clientWidth, c.clientHeight]"
    )
    places = np.array([page.run(PROJECT, point.tolist()) for point in points[:: max(len(points) // 40, 1)]])
    assert (places > 0).all()
    assert (places < [width, height]).all()
    assert np.linalg.norm(np.ptp(places, axis=0)) > 0.3 * min(width, height)
    near = page.state()["view"]["distance"]
    page.run("document.querySelector('button[data-fit=all]').click()")
    page.frame()
    assert page.state()["view"]["distance"] > 1.5 * near
    page.run("document.querySelector('button[data-fit=plan]').click()")


@pytest.mark.parametrize(
    ("side", "edges"),
    [("back", "LRFH"), ("left", "APFH"), ("right", "PAFH"), ("feet", "RLPA"), ("front", "RLFH")],
)
def test_it_is_seen_from_each_side(page: browser.Browser, side: str, edges: str) -> None:
    """The letters at the left, right, lower and upper edge are the patient's sides there."""
    page.run("document.querySelector(`button[data-view=${arguments[0]}]`).click()", side)
    page.frame()
    assert page.state()["view"]["edges"] == list(edges)
    shown = page.run("return [...document.querySelectorAll('#scene-figure .edge')].map((e) => e.textContent)")
    assert shown == list(edges)


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
    """What lies before the needle is hit first, so the structures are hidden meanwhile."""
    page.run(SWITCH_STRUCTURES)
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
    # Words have a tenth of a millimetre; the picture holds depths to some micrometres.
    assert length == pytest.approx(np.linalg.norm(np.subtract(*points)), abs=0.06)
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
    page.run(SWITCH_STRUCTURES)


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

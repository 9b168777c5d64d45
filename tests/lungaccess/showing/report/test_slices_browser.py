"""Slices and the bronchoscopist's view in a real browser: cross, window, oblique planes, prompts."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from anatomy.lung import Lung
from anatomy.structures import LUMEN
from lungaccess.plans.insertion import shown_motion
from lungaccess.plans.plan import Plan
from lungaccess.showing.report import pack
from lungaccess.showing.report.html import document
from tests.lungaccess.showing.report import browser

pytestmark = [
    pytest.mark.slow,
    pytest.mark.browser,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]

CHOOSE = """const e = document.getElementById(arguments[0]);
if (e.type === 'checkbox') e.checked = arguments[1]; else e.value = arguments[1];
for (const kind of ['input', 'change']) e.dispatchEvent(new Event(kind, { bubbles: true }))"""
POINTER = """const c = document.getElementById(arguments[0]), box = c.getBoundingClientRect();
const [kind, column, row, more] = [arguments[1], arguments[2], arguments[3], arguments[4] || {}];
const at = [box.x + column * box.width / c.width, box.y + row * box.height / c.height];
c.setPointerCapture = () => {};
const Kind = kind === 'wheel' ? WheelEvent : PointerEvent;
const all = { pointerId: 1, pointerType: 'mouse', bubbles: true, cancelable: true, ...more };
const event = new Kind(kind, { clientX: at[0], clientY: at[1], ...all });
c.dispatchEvent(event)"""
GREYS = """const c = document.getElementById(arguments[0]);
const copy = document.createElement('canvas');
[copy.width, copy.height] = [c.width, c.height];
const pen = copy.getContext('2d', { willReadFrequently: true });
pen.drawImage(c, 0, 0);
const d = pen.getImageData(0, 0, c.width, c.height).data;
return Array.from({ length: d.length / 4 }, (_, n) => d[4 * n])"""
RING = """const c = document.getElementById('inside'), copy = document.createElement('canvas');
[copy.width, copy.height] = [c.width, c.height];
const pen = copy.getContext('2d', { willReadFrequently: true });
pen.drawImage(c, 0, 0);
let found = 0;
for (let n = 0; n < 36; n++) {
  const angle = (n * Math.PI) / 18, [x, y] = arguments;
  const at = [x + 13 * Math.cos(angle), y + 13 * Math.sin(angle)];
  const [r, g, b] = pen.getImageData(...at.map(Math.floor), 1, 1).data;
  found += Math.hypot(r - 125, g - 240, b - 181) < 60 ? 1 : 0;
}
return found / 36"""
"""The share of a circle around a place of the bronchoscopy that has the colour of the opening to be taken."""
DEVICES = ("scope", "tubes", "needle", "target")
SIDE = 360
GRID_PAGE = """<!DOCTYPE html><meta charset="utf-8"><link rel="icon" href="data:,"><script type="module">
{script}
window.made = {{ VoxelGrid, PackedSource, volumeOf }};
window.lungaccessReport = {{ ready: Promise.resolve() }};
</script>"""


@pytest.fixture(scope="module")
def window(page: Path) -> Iterator[browser.Browser]:
    """The page of a plan with a CT."""
    with browser.Browser(1200, 900) as opened:
        opened.open(page)
        yield opened


@pytest.fixture
def fresh(window: browser.Browser) -> browser.Browser:
    for name, value in (
        ("field", "140"),
        ("window", "lung"),
        ("follow", True),
        ("drag", "cross"),
        ("along-turn", 0),
    ):
        window.run(CHOOSE, name, value)
    window.run("window.lungaccessReport.set(1)")
    window.rest()
    return window


def cross(page: browser.Browser) -> np.ndarray:
    return np.array(page.state()["slices"]["place_lps"])


def click(page: browser.Browser, canvas: str, column: float, row: float, **more: Any) -> None:
    for kind in ("pointerdown", "pointerup"):
        page.run(POINTER, canvas, kind, column, row, {"button": 0, **more})
    page.frame()


def test_a_click_puts_the_cross_of_all_slices_there(fresh: browser.Browser) -> None:
    tip = np.array(fresh.state()["tip_lps"])
    np.testing.assert_allclose(cross(fresh), tip, atol=1e-9)
    mm = 140 / SIDE
    for canvas, right, up in (
        ("slice-axial", (1, 0, 0), (0, -1, 0)), ("slice-coronal", (1, 0, 0), (0, 0, 1)),
        ("slice-sagittal", (0, 1, 0), (0, 0, 1)),
    ):  # fmt: skip
        fresh.run(CHOOSE, "follow", True)
        fresh.run("window.lungaccessReport.set(1)")
        click(fresh, canvas, 180 + 30, 180 - 50)
        wanted = tip + mm * (30 * np.array(right) + 50 * np.array(up))
        np.testing.assert_allclose(cross(fresh), wanted, atol=0.5 * mm)
        assert fresh.state()["following"] is False
        words = fresh.run("return document.getElementById('under-pointer').textContent")
        assert words.startswith("Cross: LPS ") and " HU" in words and "to the target" in words
    assert fresh.messages() == []


def test_wheel_zoom_pan_and_keys_work_without_a_click_first(fresh: browser.Browser, small_lung: Lung) -> None:
    before = cross(fresh)
    fresh.run(POINTER, "slice-axial", "wheel", 180, 180, {"deltaY": -120})
    fresh.frame()
    spacing = small_lung.grid.spacing_mm
    # Forward is away from the viewer, who looks from the feet.
    fresh.run(CHOOSE, "follow", False)
    np.testing.assert_allclose(cross(fresh) - before, [0, 0, 2 * spacing[2]], atol=1e-6)
    fresh.run(POINTER, "slice-axial", "wheel", 180, 180, {"deltaY": -200, "ctrlKey": True})
    fresh.frame()
    width = fresh.state()["slices"]["width_mm"]
    assert width == pytest.approx(140 * np.exp(-0.3))
    centre = np.array(fresh.state()["slices"]["centre_lps"])
    fresh.run(
        POINTER, "slice-coronal", "pointerdown", 100, 100, {"button": 0, "buttons": 1, "shiftKey": True}
    )
    fresh.run(POINTER, "slice-coronal", "pointermove", 130, 90, {"buttons": 1, "shiftKey": True})
    fresh.run(POINTER, "slice-coronal", "pointerup", 130, 90, {"button": 0, "shiftKey": True})
    fresh.frame()
    mm = width / SIDE
    moved = np.array(fresh.state()["slices"]["centre_lps"]) - centre
    np.testing.assert_allclose(moved, [-30 * mm, 0, -10 * mm], atol=0.02)
    before = cross(fresh)
    fresh.press("#slice-sagittal", "ArrowRight", "ArrowUp")
    np.testing.assert_allclose(cross(fresh) - before, [0, spacing[1], spacing[2]], atol=1e-6)


def test_the_window_maps_hounsfield_units_to_greys(fresh: browser.Browser) -> None:
    """By its presets, its fields and a drag with the right button."""
    fresh.run(CHOOSE, "tint", False)
    for key in DEVICES:
        fresh.run(
            "const b = document.querySelector(`input[data-key='${arguments[0]}']`); if (b.checked) b.click()",
            key,
        )
    raster = {"origin": None, "across": None, "down": None, "columns": SIDE, "rows": SIDE}
    tip, mm = np.array(fresh.state()["tip_lps"]), 140 / SIDE
    raster["origin"] = (tip + mm * np.array([0.5 - SIDE / 2, 0.5 - SIDE / 2, 0])).tolist()
    raster["across"], raster["down"] = [mm, 0, 0], [0, mm, 0]
    hu = values(fresh, raster).reshape(SIDE, SIDE)
    # Away from cross, letters and bar.
    part = (slice(190, 330), slice(200, 330))
    for name, (low, high) in {"lung": (-1350, 150), "tissue": (-160, 240), "bone": (-500, 1300)}.items():
        fresh.run(CHOOSE, "window", name)
        fresh.rest()
        greys = np.array(fresh.run(GREYS, "slice-axial")).reshape(SIDE, SIDE)
        wanted = np.clip(255 * (hu - low) / (high - low), 0, 255)
        assert np.abs(greys - wanted)[part].max() <= 1.0
        assert np.ptp(wanted[part]) > 5
    fresh.run(CHOOSE, "window-level", -500)
    fresh.run(CHOOSE, "window-width", 1000)
    assert fresh.state()["slices"]["window"] == {"level": -500, "width": 1000}
    assert fresh.run("return document.getElementById('window').value") == "free"
    box = fresh.run("return document.getElementById('slice-axial').clientWidth") / SIDE
    fresh.run(POINTER, "slice-axial", "pointerdown", 100, 100, {"button": 2, "buttons": 2})
    fresh.run(POINTER, "slice-axial", "pointermove", 100 + 50 / box, 100, {"buttons": 2})
    fresh.run(POINTER, "slice-axial", "pointerup", 150, 100, {"button": 2})
    assert fresh.state()["slices"]["window"]["width"] == pytest.approx(1200, abs=5)
    fresh.run(CHOOSE, "tint", True)
    for key in DEVICES:
        fresh.run("document.querySelector(`input[data-key='${arguments[0]}']`).click()", key)


def values(page: browser.Browser, raster: dict[str, Any]) -> np.ndarray:
    """Return the HU that the page's source has for a plane."""
    page.run("window.asked = arguments[0]", raster)
    found = page.run_async("window.lungaccessReport.slice(window.asked).then((v) => done(Array.from(v)))")
    return np.array([np.nan if each is None else each for each in found], dtype=float)


def test_oblique_slices_have_the_values_between_the_voxels(
    fresh: browser.Browser, data: dict[str, Any]
) -> None:
    """Compared with another interpolation of the stored volumes: 1 grey of the narrowest preset is 1.6 HU."""
    rng = np.random.default_rng(3)
    table = np.array(data["hounsfield"], dtype=float)
    packed = data["ct"][1]
    bytes_kji = np.cumsum(pack.unpack(packed["voxels"]), axis=2, dtype=np.uint8)
    fine, first, step = table[bytes_kji], np.array(packed["first_lps"]), packed["spacing_mm"]
    middle = first + 0.5 * step * (np.array(fine.shape[::-1]) - 1)
    for _ in range(3):
        right, up = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
        columns, rows, mm = 40, 30, 0.45
        origin = middle - mm * (columns / 2 * right + rows / 2 * up)
        raster = {
            "origin": origin.tolist(),
            "across": (mm * right).tolist(),
            "down": (mm * up).tolist(),
            "columns": columns,
            "rows": rows,
        }
        places = origin + mm * (
            np.arange(columns)[None, :, None] * right + np.arange(rows)[:, None, None] * up
        )
        kji = ((places - first) / step).reshape(-1, 3)[:, ::-1].T
        wanted = map_coordinates(fine, kji, order=1)
        assert np.ptp(wanted) > 50
        assert np.abs(values(fresh, raster) - wanted).max() < 1.0


def test_the_plane_along_the_needle_holds_it_and_turns_about_it(fresh: browser.Browser) -> None:
    state = fresh.state()
    needle = np.array(state["needle_lps"])
    axis = needle[-1] - needle[0]
    axis /= np.linalg.norm(axis)
    normals = []
    for turn in (0, 90):
        fresh.run(CHOOSE, "along-turn", turn)
        fresh.frame()
        plane = fresh.state()["along"]
        normal = np.cross(plane["right"], plane["up"])
        np.testing.assert_allclose(plane["up"], axis, atol=1e-6)
        np.testing.assert_allclose((needle[[0, -1]] - plane["through"]) @ normal, 0.0, atol=1e-3)
        normals.append(normal)
    assert abs(normals[0] @ normals[1]) < 1e-6
    fresh.run(CHOOSE, "along", "scope")
    fresh.frame()
    state = fresh.state()
    np.testing.assert_allclose(state["along"]["up"], state["camera"]["forward"], atol=1e-6)
    edges = state["slice_edges"]["along"]
    for n, vector in ((1, np.array(state["along"]["right"])), (3, -np.array(state["along"]["up"]))):
        strongest = int(np.argmax(np.abs(vector)))
        assert edges[n][0] == ("RL", "AP", "FH")[strongest][int(vector[strongest] > 0)]
    fresh.run(CHOOSE, "along", "needle")


def test_a_click_into_the_plane_along_the_needle_stays_in_it(fresh: browser.Browser) -> None:
    before, plane = cross(fresh), fresh.state()["along"]
    click(fresh, "slice-along", 215.0, 140.0)
    moved = cross(fresh) - np.array(plane["through"])
    assert np.linalg.norm(cross(fresh) - before) > 5.0
    assert moved @ np.cross(plane["right"], plane["up"]) == pytest.approx(0.0, abs=1e-6)
    assert moved @ np.array(plane["right"]) > 0.0 and moved @ np.array(plane["up"]) > 0.0


def test_opacity_of_a_structure(fresh: browser.Browser) -> None:
    before = fresh.run("return document.getElementById('slice-axial').toDataURL()")
    change = """const s = document.querySelector("input[data-structure='vessel']");
    s.value = arguments[0]; s.dispatchEvent(new Event('input'))"""
    for value in (0, 45):
        fresh.run(change, value)
        fresh.rest()
        same = fresh.run("return document.getElementById('slice-axial').toDataURL()") == before
        assert same is (value == 45)


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_cross_is_exact_to_a_voxel_on_any_grid(tmp_path: Path, mirrored: bool) -> None:
    """Turned, anisotropic and left-handed: indices there and back, and a trilinear value."""
    file = tmp_path / "grid.html"
    script = document.bundle(["decode.js", "vectors.js", "voxels.js"])
    file.write_text(GRID_PAGE.format(script=script), encoding="utf-8")
    rng = np.random.default_rng(5)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn)) * (-1 if mirrored else 1)
    matrix = np.column_stack([turn * [0.6, 0.9, 2.5], [10.0, -40.0, 900.0]])
    shape = (7, 9, 5)
    ijk = rng.uniform(-1, np.array(shape), (60, 3))
    places = ijk @ matrix[:, :3].T + matrix[:, 3]
    image = rng.integers(-1000, 1000, shape)
    with browser.Browser(300, 200) as opened:
        opened.open(file)
        found = opened.run(
            """const [shape, rows, places, voxels] = arguments, grid = new made.VoxelGrid(shape, rows);
            const source = new made.PackedSource([made.volumeOf(grid, Int16Array.from(voxels))]);
            return places.map((p) => [grid.voxel(p), grid.lps(grid.ijk(p)), source.value(p)])""",
            list(shape), matrix.tolist(), places.tolist(), image.ravel(order="F").tolist(),
        )  # fmt: skip
        assert opened.messages() == []
    inside = ((ijk > -0.5) & (ijk < np.array(shape) - 0.5)).all(axis=1)
    between = ((ijk > 0) & (ijk < np.array(shape) - 1)).all(axis=1)
    assert inside.any() and between.any() and not inside.all()
    wanted = map_coordinates(image.astype(float), ijk.T, order=1)
    for n, (voxel, back, value) in enumerate(found):
        assert voxel == (np.floor(ijk[n] + 0.5).astype(int).tolist() if inside[n] else None)
        np.testing.assert_allclose(back, places[n], atol=1e-9)
        if between[n]:
            assert value == pytest.approx(wanted[n], abs=1e-6)


def test_a_double_click_in_the_3d_view_puts_the_cross_there(fresh: browser.Browser) -> None:
    place = fresh.run(
        """const c = document.getElementById('scene'), at = [c.clientWidth / 2, c.clientHeight / 2];
        const hit = window.lungaccessReport.pick(...at), box = c.getBoundingClientRect();
        const place = { clientX: box.x + at[0], clientY: box.y + at[1], bubbles: true };
        c.dispatchEvent(new MouseEvent('dblclick', place));
        return hit && hit.point"""
    )
    fresh.frame()
    assert place is not None
    np.testing.assert_allclose(cross(fresh), place, atol=0.6)
    assert fresh.state()["following"] is False


# The bronchoscopist's view -----------------------------------------------------------------------


def test_hours_of_the_prompts_are_those_of_the_picture(
    fresh: browser.Browser, data: dict[str, Any], plans: tuple[Plan, ...], small_lung: Lung
) -> None:
    """Computed again from the camera of the page; every branch of the route is taken once, in order."""
    stored, plan = data["plans"][0]["scope"]["bifurcations"], plans[0]
    assert [each["openings"][0]["branch"] for each in stored] == plan.scope.branches[1:].tolist()
    tips = shown_motion(plan).tips
    aside = data["plans"][0]["scope"]["camera_aside_mm"]
    for each in stored:
        tip = tips[each["state"]]
        for opening in each["openings"] if each["bend_deg"] == each["held_bend_deg"] else ():
            away = np.array(opening["place_lps"]) - tip[:3, 3] - aside * tip[:3, 0]
            forward, up = tip[:3, 2], tip[:3, 0]
            right = np.cross(forward, up)
            angle = np.degrees(np.arctan2(away @ right, away @ up)) % 360
            from_middle = np.degrees(np.arccos(away @ forward / np.linalg.norm(away)))
            wanted = int(np.floor(angle / 30 + 0.5)) % 12 or 12
            # What holds the middle of the picture is straight ahead, up to 12 degrees from it.
            straight = from_middle < (12.0 if opening["hour"] == 0 else 4.0)
            wanted = 0 if straight else wanted
            assert opening["hour"] == wanted
            assert (f"at {wanted} o'clock" if wanted else "straight ahead") in each["text"]
    shown = fresh.run("return document.getElementById('h-route').parentNode.textContent")
    assert all(each["text"] in shown for each in stored)


def test_playing_pauses_before_every_bifurcation(fresh: browser.Browser, data: dict[str, Any]) -> None:
    scope = data["plans"][0]["scope"]
    along = pack.unpack(scope["arc_length_mm"])
    pauses = fresh.state()["pauses"]
    assert len(pauses) == len(scope["bifurcations"]) > 0
    fresh.run("window.lungaccessReport.set(0)")
    for tick, each in zip(pauses, scope["bifurcations"], strict=True):
        if tick <= 1000 * fresh.state()["position"]:
            continue
        fresh.run("document.getElementById('play').click()")
        for _ in range(200):
            fresh.frame()
            if fresh.run("return document.getElementById('play').textContent") == "Play":
                break
        fresh.rest()
        state = fresh.state()
        assert round(1000 * state["position"]) == tick
        eye = pack.unpack(scope["points"])[each["state"]]
        per_tick = along[-1] / 1000 / 0.3
        assert np.linalg.norm(np.array(state["camera"]["eye"]) - eye) <= per_tick
        assert each["number"] in state["prompts"]
        assert each["text"] in fresh.run("return document.getElementById('inside-prompt').textContent")
    fresh.run("window.lungaccessReport.set(0)")
    fresh.run("document.getElementById('fork-next').click()")
    fresh.frame()
    assert round(1000 * fresh.state()["position"]) == next(tick for tick in pauses if tick > 0)
    fresh.run("document.getElementById('fork-before').click()")
    assert fresh.messages() == []


def test_without_the_pause_box_playing_goes_on(fresh: browser.Browser) -> None:
    """From just before the place of a pause, which is passed only without the box."""
    first = next(tick for tick in fresh.state()["pauses"] if tick > 0)
    stopped = {}
    for pausing in (False, True):
        fresh.run(CHOOSE, "pause", pausing)
        fresh.run("window.lungaccessReport.set(arguments[0])", (first - 1) / 1000)
        fresh.run("document.getElementById('play').click()")
        for _ in range(200):
            fresh.frame()
            at = 1000 * fresh.state()["position"]
            playing = fresh.run("return document.getElementById('play').textContent") == "Pause"
            if at > first or not playing:
                break
        stopped[pausing] = at, playing
        if playing:
            fresh.run("document.getElementById('play').click()")
    assert stopped[False][0] > first and stopped[False][1]
    assert stopped[True] == (pytest.approx(first), False)


def test_openings_are_named_where_they_are(fresh: browser.Browser, data: dict[str, Any]) -> None:
    """Their places in the picture are computed again from the camera; a ring is around the one to take."""
    plan = data["plans"][0]
    radius, half, tangent = plan["radius_mm"], 220.0, np.tan(np.radians(48.0))
    aside = min(max(0.7 * radius["scope"], radius["outer"] + 0.35), 0.9 * radius["scope"])
    assert plan["scope"]["camera_aside_mm"] == pytest.approx(aside)
    ringed = 0
    for tick in fresh.state()["pauses"]:
        fresh.run("window.lungaccessReport.set(arguments[0])", tick / 1000)
        state = fresh.state()
        eye, forward, up = (np.array(state["camera"][name]) for name in ("eye", "forward", "up"))
        eye = eye + aside * up
        wanted = []
        for each in plan["scope"]["bifurcations"]:
            for opening in each["openings"] if each["number"] in state["prompts"] else ():
                away = np.array(opening["place_lps"]) - eye
                depth = away @ forward
                place = np.array([away @ np.cross(forward, up), away @ up]) / (depth * tangent)
                if (
                    not opening["in_view"]
                    or depth <= 0
                    or np.linalg.norm(away) > 45.0
                    or np.linalg.norm(place) > 0.92
                ):
                    continue
                wanted.append(opening["branch"])
                if opening["taken"]:
                    ringed += 1
                    at = half * (1.0 + place[0]), half * (1.0 - place[1])
                    assert fresh.run(RING, *at) > 0.6
        assert state["named"] == wanted
    assert ringed > 0
    fresh.run("window.lungaccessReport.set(1)")
    assert fresh.state()["named"] == []


def test_the_cross_section_shows_what_is_free(
    fresh: browser.Browser, plans: tuple[Plan, ...], small_lung: Lung
) -> None:
    tip, radius = shown_motion(plans[0]).tips[-1], plans[0].system.scope.radius_mm
    section = fresh.state()["section"]
    border = np.array(section["border"])
    angle = 2 * np.pi * np.arange(len(border)) / len(border)
    rays = np.cos(angle)[:, None] * tip[:3, 0] + np.sin(angle)[:, None] * tip[:3, 1]
    codes = small_lung.labels
    for shift, lumen in ((-0.06, True), (0.06, False)):
        ijk = np.rint(small_lung.grid.ijk(tip[:3, 3] + (border + shift)[:, None] * rays)).astype(int)
        assert (((codes[tuple(ijk.T)] & LUMEN) != 0) == lumen).mean() > 0.9
    assert section["gap"] == pytest.approx(border.min() - radius, abs=0.01)
    assert section["depthGap"] <= section["gap"] + 0.06
    assert f"{section['gap']:.1f} mm free" in fresh.run(
        "return document.getElementById('gap-words').textContent"
    )

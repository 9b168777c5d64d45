"""Controls of slices and 3-D view in the explorer with a CT: sharp slices, drags, fingers, what is pale."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lungaccess.showing.explorer.patient import ct_slice
from lungaccess.showing.report.html.volumes import CtFile, find_ct
from tests.lungaccess.planning.coupled.planning import TARGET
from tests.lungaccess.showing.explorer.client import source_of
from tests.lungaccess.showing.explorer.windows import PLANNED, Page, Served
from tests.lungaccess.showing.report import browser

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]
FINGERS = """const c = document.getElementById(arguments[0]), box = c.getBoundingClientRect();
c.setPointerCapture = () => {};
for (const [kind, id, x, y] of arguments[1]) c.dispatchEvent(new PointerEvent(kind, { pointerId: id,
  pointerType: 'touch', bubbles: true, cancelable: true, clientX: box.x + x, clientY: box.y + y }))"""
APART = [
    ["pointerdown", 1, 90, 100], ["pointerdown", 2, 110, 100], ["pointermove", 1, 60, 100],
    ["pointermove", 2, 140, 100], ["pointerup", 1, 60, 100], ["pointerup", 2, 140, 100],
]  # fmt: skip
"""Two fingers that go apart from 20 to 80 pixels."""


@pytest.fixture(scope="module")
def scanned(patient: Path) -> Iterator[Page]:
    """A window with a plan, of a patient with a CT."""
    served = Served(replace(source_of(patient), ct=find_ct(patient)))
    try:
        with Page(1100, 800) as window:
            window.open(served.address.url)
            window.target(TARGET)
            yield window
            assert window.messages() == []
    finally:
        served.stop()


def drag(page: Page, canvas: str, *, by: tuple[int, int]) -> None:
    page.pointer("mousePressed", canvas, 80.0, 80.0)
    page.pointer("mouseMoved", canvas, 80.0 + by[0], 80.0 + by[1])
    page.pointer("mouseReleased", canvas, 80.0 + by[0], 80.0 + by[1])


def test_the_slices_have_the_values_of_the_whole_ct(scanned: Page, patient: Path) -> None:
    scanned.wait("Object.values(s.finer).every(Boolean)")
    raster, shown = scanned.run(
        "const { coronal } = window.lungaccessExplorer.slices;"
        "return [coronal.raster(), Array.from(coronal.fine.values, (v) => (Number.isNaN(v) ? null : v))]"
    )
    ct = CtFile(path=patient / "ct.nii.gz").read()
    expected = ct_slice(ct, *(raster[key] for key in ("origin", "across", "down", "columns", "rows")))
    values = np.array(shown, dtype=np.float64).reshape(expected.shape)
    np.testing.assert_array_equal(np.isnan(values), np.isnan(expected))
    np.testing.assert_allclose(values, expected, atol=1e-3)


def test_what_a_drag_moves_can_be_chosen(scanned: Page) -> None:
    before: dict[str, Any] = scanned.state()["slices"]
    scanned.choose("drag", "window")
    drag(scanned, "slice-axial", by=(30, -20))
    windowed = scanned.state()["slices"]
    assert windowed["window"]["width"] > before["window"]["width"]
    assert windowed["window"]["level"] > before["window"]["level"]
    assert windowed["place_lps"] == before["place_lps"]
    scanned.choose("drag", "pan")
    drag(scanned, "slice-axial", by=(25, 0))
    panned = scanned.state()["slices"]
    assert panned["centre_lps"][0] < windowed["centre_lps"][0] and panned["window"] == windowed["window"]
    scanned.choose("drag", "cross")
    drag(scanned, "slice-axial", by=(25, 0))
    assert scanned.state()["slices"]["place_lps"] != panned["place_lps"]


def test_two_fingers_zoom_slices_and_3d_view(scanned: Page) -> None:
    before = scanned.state()["slices"]["width_mm"]
    scanned.run(FINGERS, "slice-sagittal", APART)
    assert scanned.state()["slices"]["width_mm"] == pytest.approx(before / 4.0, rel=0.05)
    distance = "return window.lungaccessExplorer.orbit.distance"
    far = scanned.run(distance)
    scanned.run(FINGERS, "scene", APART)
    assert scanned.run(distance) < 0.5 * far


def test_a_finger_that_taps_chooses_the_place(scanned: Page) -> None:
    before = scanned.state()["asked"]["target"]
    scanned.run(FINGERS, "slice-axial", [["pointerdown", 1, 100, 90], ["pointerup", 1, 100, 90]])
    assert scanned.state()["asked"]["target"] != before
    scanned.target(TARGET)


def test_the_reach_before_a_change_is_pale_and_said_to_be(scanned: Page) -> None:
    scanned.wait("s.reach && s.reach.share === 1")
    known = scanned.run("return window.lungaccessExplorer.reach.points().places.length")
    assert known > 0 and scanned.text("reach-words").startswith("Reached by a single arc")
    words, pale = scanned.run(
        "const page = window.lungaccessExplorer; page.whatIfPanel.set({ margin: 0.2 });"
        "return [document.getElementById('reach-words').textContent, page.reach.points().places.length]"
    )
    assert words.startswith("Pale: what ultrathin reaches") and pale == known
    scanned.wait(f"s.reach && s.reach.share === 1 && s.reach.system.includes('0.2') && {PLANNED}")
    assert scanned.text("reach-words").startswith("Reached by a single arc")
    scanned.click("reset")
    scanned.wait(PLANNED)


def test_tubes_alone_have_no_exits_but_a_reach(scanned: Page) -> None:
    scanned.choose("system", "tubes-only")
    scanned.wait("s.reach && s.reach.share === 1 && s.reach.system === 'tubes-only'")
    assert "has no needle" in scanned.text("exits-words")
    assert "by the tubes" in scanned.text("reach-words")
    assert scanned.state()["exits"] is None
    scanned.choose("needle_length_mm", "")
    scanned.choose("system", "ultrathin")
    scanned.wait(f"s.exits && s.exits.complete && {PLANNED}")

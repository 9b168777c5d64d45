"""A page that breathes in a real browser: devices and pictures are where Python has them."""

from __future__ import annotations

import numpy as np
import pytest

from anatomy.grid import Grid
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.showing.report.html import volumes
from lungaccess.showing.report.html.deployment import device_points
from lungaccess.uncertainty.breathing.moving import Moving
from tests.lungaccess.showing.report import browser
from tests.lungaccess.showing.report.scripts import CHOOSE, PICTURE

pytestmark = [
    pytest.mark.slow,
    pytest.mark.browser,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]

LUMEN = (25, 80, 126)


@pytest.fixture
def page(breathing_window: browser.Browser) -> browser.Browser:
    return breathing_window


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


def test_everything_breathes_together(
    page: browser.Browser, breathing_plans: tuple[Plan, ...], breathing_lung: Lung
) -> None:
    """Devices and target go where Python has them, inside and outside the window; all pictures change."""
    plan, canvases = breathing_plans[0], ("scene", "slice-axial", "slice-across", "inside")
    page.run("window.lungaccessReport.set(1); window.lungaccessReport.breathe(1)")
    page.rest()
    moving, before = Moving.of(plan, breathing_lung), [page.run(PICTURE, 1, name) for name in canvases]
    for phase, said in ((0.0, "✗ not proved"), (0.35, "✗ not proved"), (0.8, "✓ proved")):
        page.run("window.lungaccessReport.set(1); window.lungaccessReport.breathe(arguments[0])", phase)
        page.rest()
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
    page.rest()
    assert [page.run(PICTURE, 1, name) for name in canvases] == before


def test_the_lumen_breathes_in_the_slices(
    page: browser.Browser, breathing_plans: tuple[Plan, ...], breathing_lung: Lung
) -> None:
    """It is painted where Python has moved the voxels of the page, and not where they were before."""
    moving, step_mm = Moving.of(breathing_plans[0], breathing_lung), 140 / 360
    page.run(CHOOSE, "field", "140")
    page.run("window.lungaccessReport.set(0.2); window.lungaccessReport.breathe(0)")
    page.rest()
    across, down = pixels(page, "slice-axial", LUMEN).T
    aside = np.stack([across - 179.5, down - 179.5, np.zeros(len(across))], axis=1)
    places = np.array(page.state()["tip_lps"]) + step_mm * aside
    masks = moving.pulled_back(places, 0.0)
    assert len(places) > 50
    assert np.linalg.norm(masks - places, axis=1).min() > 0.3
    grids = volumes.page_grids(
        breathing_lung.grid, np.concatenate([device_points(each) for each in breathing_plans])
    )
    assert share_of_lumen(masks, breathing_lung, grids) > 0.99
    assert share_of_lumen(places, breathing_lung, grids) < 0.8
    page.run("window.lungaccessReport.breathe(1)")


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


def share_of_lumen(places: np.ndarray, lung: Lung, grids: tuple[Grid, Grid]) -> float:
    """Return the share of places in lumen voxels of a page: the fine ones where it has them, else coarse.

    A page knows the motion within 0.03 mm: where a place lies so near a voxel's border, either side will do.
    """
    codes, lumen = volumes.label_codes(lung, (0, 0, 0), lung.grid.shape), np.zeros(len(places), dtype=bool)
    for aside_mm in 0.03 * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)]):
        found = np.zeros(len(places))
        for grid in grids:
            index = np.floor(grid.ijk(places + aside_mm) + 0.5).astype(int)
            inside = ((index >= 0) & (index < grid.shape)).all(axis=1)
            found[inside] = volumes.resampled(codes, grid, 0, 0)[tuple(index[inside].T)]
        lumen |= found == volumes.CODES["lumen"]
    return float(lumen.mean())


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

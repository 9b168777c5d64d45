"""The page of a map in a real browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from anatomy.lung import Lung
from tests.lungaccess.showing.report import browser
from tests.lungaccess.showing.report.pages import make_reach, reach_file
from tests.lungaccess.showing.report.scripts import CHOOSE

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]


@pytest.mark.slow
def test_the_map_opens_and_its_slices_follow_the_sliders(small_lung: Lung, tmp_path: Path) -> None:
    reach = make_reach(small_lung)
    file = reach_file(reach, small_lung, tmp_path)
    with browser.Browser() as window:
        window.open(file)
        assert window.messages() == []
        state = window.state()
        assert state["gl_error"] == 0
        assert state["structures"]["0: reachable"] is True
        for axis, slider in enumerate(("place-0", "place-1", "place-2")):
            before = window.run("return Number(document.getElementById(arguments[0]).value)", slider)
            window.press(f"#{slider}", "ArrowRight", "ArrowRight")
            assert window.state()["place_lps"][axis] == before + 2
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

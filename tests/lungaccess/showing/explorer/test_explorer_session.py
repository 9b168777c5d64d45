"""Many clicks in one session: memory stays flat, nothing is asked elsewhere, plans are the command's."""

from __future__ import annotations

from pathlib import Path

import pytest

from experiments.explorer_speed import targets
from tests.lungaccess.planning.coupled.planning import TARGET
from tests.lungaccess.showing.explorer.session import GROWTH, WINDOW, click_through
from tests.lungaccess.showing.explorer.windows import Page, Served
from tests.lungaccess.showing.report import browser

pytestmark = [
    pytest.mark.browser,
    pytest.mark.slow,
    pytest.mark.skipif(bool(browser.missing()), reason=browser.missing() or "all there"),
]
CLICKS = 30
FILLED_MB = 4.0
"""So much the 30 plans that a page keeps may take, and what a process keeps of its latest answers."""


def test_a_session_keeps_its_memory_and_its_plans(served: Served, patient: Path) -> None:
    points = targets(patient, patient.parent / "cache", CLICKS)
    with Page(*WINDOW) as window:
        window.open(served.address.url)
        # Every process has loaded what it needs once a plan has been made and appraised.
        window.target(TARGET)
        made = click_through(window, served, points, 5, 2, lambda _made: None)
    assert made.compared >= 2 and made.differing == []
    assert made.messages == []
    assert made.hosts == {f"127.0.0.1:{served.address.port}"}
    for name in ("clicks", "plans", "answers", "page: heap"):
        values = made.memory[name]
        grown = values[-1] - values[len(values) // 5]
        assert made.growth(name) <= 2.0 * GROWTH - 1.0 or grown <= FILLED_MB, (name, values)

"""A patient on disk, with its atlas in the cache, and a window that explores it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import lungaccess as la
from anatomy.phantom import Phantom, write_phantom
from tests.lungaccess.planning.coupled.planning import TARGET
from tests.lungaccess.showing.explorer.client import source_of
from tests.lungaccess.showing.explorer.windows import Page, Served


@pytest.fixture(scope="session")
def patient(small_phantom: Phantom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The small phantom, prepared, in a folder with an odd name."""
    folder = tmp_path_factory.mktemp("explored") / "<img src=x onerror=alert(1)>"
    write_phantom(small_phantom, folder)
    lung = la.load_patient(folder, cache=folder.parent / "cache")
    la.open_atlas(lung, la.load_system("ultrathin"), cache=folder.parent / "cache")
    return folder


@pytest.fixture(scope="module")
def served(patient: Path) -> Iterator[Served]:
    made = Served(source_of(patient))
    yield made
    made.stop()


@pytest.fixture(scope="module")
def page(served: Served) -> Iterator[Page]:
    with Page(1100, 800) as window:
        window.open(served.address.url)
        window.target(TARGET)
        yield window
        assert window.messages() == [], "after all tests: no message on the console"
        asked = [
            url for url in window.requests() if not url.startswith(("data:", "blob:", "about:", "chrome:"))
        ]
        hosts = {url.split("/")[2] for url in asked}
        assert hosts == {f"127.0.0.1:{served.address.port}"}, "nothing is asked of anything else"


@pytest.fixture
def planned(page: Page) -> Page:
    """Return the window with the plan to the same target."""
    page.run("location.hash = ''; window.lungaccessExplorer.state.read()")
    page.run("Object.assign(window.lungaccessExplorer.state, { compared: [] })")
    page.target(TARGET)
    return page

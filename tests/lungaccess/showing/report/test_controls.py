"""Every control of a page is named by a test in the browser."""

from __future__ import annotations

import re
from importlib import resources
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[2]
CONTROL = re.compile(r'<(?:button|input|select|canvas)\b[^>]*\bid="([\w-]+)"')


@pytest.mark.parametrize("package", ["lungaccess.showing.report", "lungaccess.showing.explorer"])
def test_every_control_is_driven_in_the_browser(package: str) -> None:
    """Templates and code of a package write the controls; a test that drives one finds it by its name."""
    folder = Path(str(resources.files(package)))
    written = [*folder.glob("page/*.html"), *folder.rglob("*.py")]
    controls = {name for file in written for name in CONTROL.findall(file.read_text(encoding="utf-8"))}
    tests = [file.read_text(encoding="utf-8") for file in TESTS.rglob("*.py") if file != Path(__file__)]
    driven = "\n".join(text for text in tests if "browser" in text)
    assert len(controls) > 20
    assert [name for name in sorted(controls) if not re.search(rf"""['"#]{name}['", \]]""", driven)] == []

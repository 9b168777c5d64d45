"""Make the picture of the explorer anew, which is stored: `python -m docs.make_explorer`.

It is of the phantom of the tutorial, with its CT.  Chromium and chromedriver draw the page.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from PIL import Image

from docs.make_first_steps import IMAGES, output_of
from lungaccess.showing.explorer import PatientSource
from tests.lungaccess.showing.explorer.windows import PLANNED, Page, Served

COMMAND = "lungaccess phantom --out phantom"
SIZE = 1440, 900
TARGET = "nodule 1"
SETTLED = (
    f"{PLANNED} && s.reach && s.reach.share === 1 && Object.values(s.finer).every(Boolean)"
    " && (!s.view_tools.slow || s.view_tools.quality === 'rest')"
)
"""All answers are shown, the slices are sharp, and nothing moves any more."""


def photograph(patient: Path, cache: Path, out: Path) -> None:
    """Write a picture of the window with the plan to a nodule, its exits and its reach."""
    served = Served(
        PatientSource(folder=patient, system="lung-default", cache=cache, ct=patient / "ct.nii.gz")
    )
    try:
        with Page(*SIZE) as window:
            window.open(served.address.url)
            window.choose("nodule", TARGET)
            window.wait(f"s.asked.target === '{TARGET}' && {SETTLED}")
            window.screenshot(out)
    finally:
        served.stop()


def make() -> None:
    """Bring the picture up to date."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        output_of(COMMAND, folder)
        photograph(folder / "phantom", folder / "cache", folder / "explorer.png")
        Image.open(folder / "explorer.png").convert("RGB").save(IMAGES / "explorer.png", optimize=True)


if __name__ == "__main__":
    make()

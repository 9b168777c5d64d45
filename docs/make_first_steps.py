"""Make output and pictures of the tutorial anew, which are stored: `python -m docs.make_first_steps`.

Each command of `docs/tutorials/first_steps.md` is run in an empty folder; what it prints replaces the
`text` block behind it, of which `<!-- output: N lines -->` keeps the first N lines, and
`N lines and the last M` those, too. Chromium and chromedriver draw the pictures of the report page.
"""

from __future__ import annotations

import base64
import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from anatomy.io import read_volume
from tests.lungaccess.showing.report.browser import Browser

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "tutorials" / "first_steps.md"
IMAGES = ROOT / "docs" / "images"
WIDTH_PX = 1100
"""Wide enough to read on a page, small enough to be stored."""
LEAST_HU, GREATEST_HU = -1350.0, 150.0
"""The usual window for lungs."""
TALL_PX = 1100
"""Height of the window: every part that is shown fits into it, and the 3-D view has its usual shape."""
STEP = re.compile(
    r"(```console\n(?P<command>[^\n]+)\n```\n\n)"
    r"<!-- output: (?P<lines>\d+) lines(?: and the last (?P<last>\d+))? -->\n```text\n.*?```",
    re.DOTALL,
)
DRAWN = {
    "segmentation": "patient/segmentation.png",
    "tree": "info/tree.png",
    "overview": "plan/overview.png",
    "cost": "plan/cost_over_time.png",
}
"""Pictures that the commands write."""
SECTIONS = {
    "headline": ".first",
    "page": "#scene-figure .view",
    "slices": "section:has(#h-slices)",
    "charts": "section:has(#h-charts)",
    "risk": "section:has(#h-risk)",
    "cut": "#scene-figure .view",
}
"""Parts of the report page that are shown."""
BOX = """const part = document.querySelector(arguments[0]);
part.scrollIntoView({behavior: "instant"});
const at = part.getBoundingClientRect();
return {x: at.x, y: at.y, width: at.width, height: Math.min(at.height, 900), scale: 1}"""


def output_of(command: str, folder: Path) -> str:
    """Return what a command prints, without what stands on standard error."""
    code = "import sys; from lungaccess.cli.app import main; sys.exit(main())"
    words = [sys.executable, "-c", code, *shlex.split(command)[1:]]
    settings = os.environ | {
        "PYTHONPATH": str(ROOT),
        "COLUMNS": "100",
        "LUNGACCESS_CACHE": str(folder / "cache"),
    }
    done = subprocess.run(words, cwd=folder, env=settings, stdout=subprocess.PIPE, text=True, check=True)
    return "\n".join(line.rstrip() for line in done.stdout.rstrip().splitlines())


def run_commands(text: str, folder: Path) -> str:
    """Run the commands of a page; return the page with what they print."""

    def step(match: re.Match[str]) -> str:
        lines = output_of(match["command"], folder).splitlines()
        kept, last = int(match["lines"]), int(match["last"] or 0)
        behind = lines[-last:] if last else []
        shown = "\n".join([*lines[:kept], "...", *behind] if len(lines) > kept + last else lines)
        stated = f" and the last {last}" if last else ""
        return f"{match[1]}<!-- output: {kept} lines{stated} -->\n```text\n{shown}\n```"

    return STEP.sub(step, text)


def store(picture: Path, name: str) -> None:
    """Write a picture as small as it is shown, in all its colours."""
    image = Image.open(picture).convert("RGB")
    image.thumbnail((WIDTH_PX, 2 * WIDTH_PX))
    image.save(IMAGES / f"first-steps-{name}.png", optimize=True)


def draw_ct(file: Path, out: Path) -> None:
    """Draw an axial and a coronal slice of a CT of cubic voxels, in a window for lungs."""
    volume = read_volume(file).array
    _ni, nj, nk = volume.shape
    axial, coronal = volume[:, :, int(0.55 * nk)].T, volume[:, nj // 2, ::-1].T
    below = np.full((coronal.shape[0] - axial.shape[0], axial.shape[1]), LEAST_HU)
    both = np.hstack([np.vstack([axial, below]), coronal])
    grey = 255.0 * (np.clip(both, LEAST_HU, GREATEST_HU) - LEAST_HU) / (GREATEST_HU - LEAST_HU)
    Image.fromarray(grey.astype(np.uint8)).resize((2 * both.shape[1], 2 * both.shape[0])).save(out)


def settle(window: Browser) -> None:
    """Wait until the 3-D view is as fine as it gets: where the processor draws, once nothing moves."""
    while True:
        window.frame()
        view = window.state()["view_tools"]
        if view["quality"] == "fine" or not view["slow"]:
            return


def photograph(page: Path, folder: Path) -> None:
    """Store pictures of the sections of a report page, and of one in the dark and on a phone."""
    with Browser(1200, 1000) as window:
        size = {"width": 1200, "height": TALL_PX, "deviceScaleFactor": 1, "mobile": False}
        window.command("Emulation.setDeviceMetricsOverride", size)
        window.open(page)
        window.run("window.lungaccessReport.set(0.9)")
        for name, part in SECTIONS.items():
            if name == "page":
                window.run("document.querySelector('[data-fit=target]').click()")
            if name == "cut":
                window.run("window.lungaccessReport.set(1); document.getElementById('cut').click()")
            clip = window.run(BOX, part)
            settle(window)
            shot = window.command("Page.captureScreenshot", {"clip": clip})
            (folder / f"{name}.png").write_bytes(base64.b64decode(shot["data"]))
            store(folder / f"{name}.png", name)
    for name, window in (("dark", Browser(1200, 1000, dark=True)), ("phone", Browser(390, 844, phone=True))):
        with window:
            window.open(page)
            window.run("document.querySelector('section.stage').scrollIntoView()")
            settle(window)
            window.screenshot(folder / f"{name}.png")
        store(folder / f"{name}.png", name)


def make() -> None:
    """Bring page and pictures up to date."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        PAGE.write_text(run_commands(PAGE.read_text(encoding="utf-8"), folder), encoding="utf-8")
        draw_ct(folder / "phantom" / "ct.nii.gz", folder / "ct.png")
        store(folder / "ct.png", "ct")
        for picture, file in DRAWN.items():
            store(folder / file, picture)
        photograph(folder / "plan" / "report.html", folder)


if __name__ == "__main__":
    make()

"""Make the pictures of breathing and of the lobes anew, which are stored: `python -m docs.make_breathing`.

All are of phantoms.  Chromium and chromedriver draw the report page.
"""

from __future__ import annotations

import base64
import io
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from anatomy.io import read_volume
from docs.make_first_steps import BOX, GREATEST_HU, IMAGES, LEAST_HU, LET_GO, output_of
from lungaccess.showing.report.html.volumes import find_ct, resampled
from tests.lungaccess.showing.report.browser import Browser

COMMANDS = (
    "lungaccess phantom --out BREATHING --breathing",
    "lungaccess info BREATHING --out info",
    "lungaccess plan BREATHING --target lps:115,-55,-131 --iterations 20 --out plan",
    "lungaccess window plan/plan.json BREATHING --picture clock.png",
    "lungaccess report plan/plan.json BREATHING --samples 0 --no-instructions",
    "lungaccess segment BREATHING/ct.nii.gz --out patient",
)
STORED = {"breathing-motion": "info/motion.png", "breathing-clock": "clock.png"}
WIDTH_PX, MOVING_COLOURS = 900, 200
PHASES = np.linspace(0.0, 1.0, 9)
FRAME_MS, END_MS = 140, 700
CLOSER = 5
"""So many presses of + bring the view near."""
PARTS = {
    "#scene-figure .view": (0, 0, 600, 560),
    ".clock": (610, 0, 300, 219),
    "#slice-coronal": (610, 225, 300, 300),
}
SIZE, WORDS_AT = (910, 600), (8, 568)
LOBES = np.array(
    [(0, 0, 0), (86, 180, 233), (0, 114, 178), (230, 159, 0), (0, 158, 115), (204, 121, 167)], float
)
"""Colours of Okabe and Ito, of lobes 1 to 5."""
SHOWN_SHARE = 0.35


def picture_of(window: Browser, part: str) -> Image.Image:
    """Return what a part of the page shows."""
    clip = window.run(BOX, part)
    shot = window.command("Page.captureScreenshot", {"clip": clip, "captureBeyondViewport": True})
    return Image.open(io.BytesIO(base64.b64decode(shot["data"]))).convert("RGB")


def frames(page: Path) -> list[Image.Image]:
    """Return the report page in each phase: scene, clock and a slice, with the needle in place."""
    found = []
    with Browser(1200, 1000) as window:
        window.open(page)
        window.run(LET_GO)
        window.run("document.querySelector('button[data-view=front]').click()")
        window.run("document.getElementById('view-target').click()")
        for _ in range(CLOSER):
            window.press("#scene", "+")
        window.run(
            "const s = document.getElementById('field'); s.value = 60; s.dispatchEvent(new Event('change'))"
        )
        window.run("document.getElementById('phase-words').style.cssText = 'flex: none; width: 890px'")
        for phase in PHASES.tolist():
            window.run("window.lungaccessReport.set(1); window.lungaccessReport.breathe(arguments[0])", phase)
            window.frame()
            frame = Image.new("RGB", SIZE, "white")
            for part, (x, y, width, height) in PARTS.items():
                frame.paste(fitted(picture_of(window, part), width, height), (x, y))
            frame.paste(picture_of(window, "#phase-words"), WORDS_AT)
            found.append(frame)
    return found


def fitted(image: Image.Image, width: int, height: int) -> Image.Image:
    """Return the middle of an image, as large as fits a size."""
    scale = max(width / image.width, height / image.height)
    large = image.resize((round(scale * image.width), round(scale * image.height)), Image.Resampling.LANCZOS)
    left, top = (large.width - width) // 2, (large.height - height) // 2
    return large.crop((left, top, left + width, top + height))


def animate(pictures: list[Image.Image], path: Path) -> None:
    """Write a breath there and back."""
    all_colours = Image.fromarray(np.hstack([np.asarray(each) for each in pictures]))
    few = all_colours.quantize(MOVING_COLOURS, method=Image.Quantize.MAXCOVERAGE, kmeans=4)
    both = [*pictures, *pictures[-2:0:-1]]
    shown = [each.quantize(palette=few, dither=Image.Dither.NONE) for each in both]
    times = [END_MS if n in (0, len(pictures) - 1) else FRAME_MS for n in range(len(both))]
    shown[0].save(path, save_all=True, append_images=shown[1:], duration=times, loop=0, optimize=True)


def draw_lobes(patient: Path, ct: Path, path: Path) -> None:
    """Draw the lobes that were found on a CT, with fissures: white where seen, dark where inferred."""
    lobes, fissures = (read_volume(patient / f"{name}.nii.gz") for name in ("lobes", "fissures"))
    scan = resampled(read_volume(ct), lobes.grid, 1, LEAST_HU)
    grey = 255.0 * (np.clip(scan, LEAST_HU, GREATEST_HU) - LEAST_HU) / (GREATEST_HU - LEAST_HU)
    ni, nj, nk = scan.shape
    every, down = slice(None), slice(None, None, -1)
    planes = [
        (every, every, nk // 2),
        (every, nj // 2, down),
        (ni // 4, every, down),
        (3 * ni // 4, every, down),
    ]
    parts = []
    for plane in planes:
        base, lobe, fissure = (np.asarray(each[plane]).T for each in (grey, lobes.array, fissures.array))
        coloured = np.repeat(base[..., None], 3, axis=-1)
        inside = lobe > 0
        coloured[inside] += SHOWN_SHARE * (LOBES[lobe[inside].astype(int)] - coloured[inside])
        coloured[fissure == 1], coloured[fissure == 2] = (40, 40, 40), (255, 255, 255)
        parts.append(np.asarray(coloured, dtype=np.uint8))
    height = max(part.shape[0] for part in parts)
    padded = [np.pad(part, ((0, height - len(part)), (0, 4), (0, 0)), constant_values=255) for part in parts]
    image = Image.fromarray(np.hstack(padded))
    image = image.resize((WIDTH_PX, round(image.height * WIDTH_PX / image.width)), Image.Resampling.LANCZOS)
    image.save(path, optimize=True)


def make() -> None:
    """Bring the pictures up to date."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for command in COMMANDS:
            output_of(command, folder)
        for stored, file in STORED.items():
            image = Image.open(folder / file).convert("RGB")
            image.thumbnail((WIDTH_PX, WIDTH_PX))
            image.save(IMAGES / f"{stored}.png", optimize=True)
        ct = find_ct(folder / "BREATHING")
        if ct is not None:
            draw_lobes(folder / "patient", ct.path, IMAGES / "lobes.png")
        animate(frames(folder / "plan" / "report.html"), IMAGES / "breathing.gif")


if __name__ == "__main__":
    make()

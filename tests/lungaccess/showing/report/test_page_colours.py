"""Colours of a page: told apart by every vision, and text stands out."""

from __future__ import annotations

import re
from itertools import combinations

import numpy as np
import pytest

from lungaccess.showing.report import style
from lungaccess.showing.report.colours import DEVICE_COLOURS
from lungaccess.showing.report.html import charts, document

# Linear RGB as people without one kind of cone see it [Machado2009, severity 1].
VISIONS = {
    "full": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def lab(colour: str, vision: np.ndarray) -> np.ndarray:
    """Return CIE L*a*b* of "#rrggbb" as a vision sees it."""
    srgb = np.array([int(colour[n : n + 2], 16) for n in (1, 3, 5)]) / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    seen = np.clip(vision @ linear, 0.0, 1.0)
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) @ seen
    f = np.cbrt(np.maximum(xyz / np.array([0.9505, 1.0, 1.089]), 1e-6))
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


CHARTS = [colour for _name, colour, _dash in charts.STRUCTURES.values()]
COLOURS_TOGETHER = {
    "devices": [DEVICE_COLOURS[name] for name in ("scope", "outer", "needle")],
    "clearance of the needle": [
        DEVICE_COLOURS[name] for name in ("scope", "outer", "needle", "needle_with_room")
    ],
    "marks": [DEVICE_COLOURS[name] for name in ("needle", "target", "aim")],
    "plans beside each other": [DEVICE_COLOURS["needle"], *DEVICE_COLOURS["others"][:3]],
    "charts": CHARTS,
}
SAME_EVERYWHERE = (
    "slices.js",
    "voxel_image.js",
    "bronchoscopy.js",
    "plan.js",
    "no_plan.js",
    "plan.html",
    "no_plan.html",
    "style.css",
)


def test_pictures_have_the_colours_of_pages_and_no_page_has_others() -> None:
    assert tuple(DEVICE_COLOURS[name] for name in ("scope", "outer", "needle", "target", "aim")) == (
        style.SCOPE,
        style.TUBE,
        style.NEEDLE,
        style.TARGET,
        style.AIM,
    )
    # Colours that devices had where they were stated for each place by itself.
    for name in SAME_EVERYWHERE:
        assert not re.search("#3FA9E8|#FF4081|#1fb88c", document.asset(name), re.IGNORECASE), name


@pytest.mark.parametrize("vision", VISIONS)
def test_colours_are_told_apart_by_every_vision(vision: str) -> None:
    for name, colours in COLOURS_TOGETHER.items():
        for one, other in combinations(colours, 2):
            gap = np.linalg.norm(lab(one, VISIONS[vision]) - lab(other, VISIONS[vision]))
            assert gap > 20.0, (name, one, other)


def test_text_stands_out_in_light_and_dark() -> None:
    style = document.asset("style.css")
    schemes = [dict(re.findall(r"--(\w+): (#\w{6})", part)) for part in style.split("@media", 2)[:2]]
    assert len(schemes) == 2
    for scheme in schemes:
        for ink in ("ink", "faint", "accent", "good", "fair", "bad"):
            for paper in ("paper", "card"):
                assert contrast(scheme[ink], scheme[paper]) >= 4.5, (ink, paper)


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours as WCAG 2 defines it."""
    light = []
    for colour in (one, other):
        srgb = np.array([int(colour[n : n + 2], 16) for n in (1, 3, 5)]) / 255.0
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        light.append(float(linear @ [0.2126, 0.7152, 0.0722]))
    return (max(light) + 0.05) / (min(light) + 0.05)

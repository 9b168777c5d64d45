"""Colours, figures and files of the pictures."""

import os
from pathlib import Path

import matplotlib

matplotlib.use("Agg")

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from anatomy.base.files import atomic_write
from lungaccess.showing.report.colours import DEVICE_COLOURS

# Mostly Okabe and Ito's palette: distinct with every common colour vision, and in grey by lightness.
SCOPE, TUBE, NEEDLE, TARGET, AIM = (
    str(DEVICE_COLOURS[name]) for name in ("scope", "outer", "needle", "target", "aim")
)
NODULE = "#009E73"
AIRWAY = "#6FA8CC"
LUMEN = "#DCEBF5"
VESSEL = "#C4717A"
OUTSIDE = "#8D8D8D"
FISSURE = "#8F6FB8"
LUNG = "#F7F2EC"
FORBIDDEN = "#F6D5D0"
INK = "#222222"
FAINT_INK = "#6B6B6B"


DPI = 130
"""Pixels per inch at which the smallest letters stay sharp on a screen."""
PNG_LEVEL = 3
"""The compression goes from 0 to 9; this takes half the time of the usual 6 for files a tenth larger."""

plain_look = matplotlib.rc_context(
    {key: value for key, value in matplotlib.rcParamsDefault.items() if not key.startswith("backend")}
)
"""Decorates what draws: a matplotlibrc of the user, or settings made in a notebook, change no picture."""


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty white figure that belongs to no window."""
    return Figure(figsize=(width_in, height_in), dpi=DPI, facecolor="white")


def panel(figure: Figure, box_in: tuple[float, float, float, float]) -> Axes:
    """Add axes to a figure at left, bottom, width and height in inches."""
    width, height = figure.get_size_inches()
    left, bottom, across, up = box_in
    return figure.add_axes((left / width, bottom / height, across / width, up / height))


def heading(figure: Figure, text: str, *, size: float = 14.0) -> None:
    """Write the heading of a figure at its upper left."""
    width, height = figure.get_size_inches()
    figure.text(0.3 / width, 1 - 0.15 / height, text, va="top", fontsize=size, fontweight="bold", color=INK)


def save_png(figure: Figure, path: str | os.PathLike[str]) -> Path:
    """Write a figure to `path` in one step, so that no half-written picture can be seen.

    Raises FileError if the folder is missing or cannot be written.
    """
    target = Path(path)
    with atomic_write(target) as temporary:
        figure.savefig(
            temporary, format="png", dpi=DPI, metadata={"Software": "lungaccess"},
            pil_kwargs={"compress_level": PNG_LEVEL},
        )  # fmt: skip
    return target

"""Draw the figure of the paper from the stored results of two studies.

    python paper/figures.py [--results FOLDER] [--out FILE]

On the left, the lung tissue that a single proved arc of the needle reaches, by diameter of the bronchoscope
and least radius of the needle (`reachability_by_device`).  On the right, how often simulated procedures
succeed, by error model and by what is measured on the way (`procedures`).
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from anatomy.base.files import atomic_write
from experiments.support.results import small_png
from experiments.write_results import read_all
from lungaccess.showing.report import style

HERE = Path(__file__).resolve().parent
PATIENT = "Patient1"
RADII_MM = (30, 50, 75, 121, 200)
PROCEDURES = ("open-loop", "measured-scope", "measured-tip", "closed-loop")
ERRORS = ("gated-ct", "breath-hold", "expiratory-free", "vision-only", "inspiratory-ct")
QUANTITY = re.compile(rf"{PATIENT}: scope of ([\d.]+) mm, needle of (\d+) mm")


def values(results: Path, study: str) -> dict[str, float]:
    """Return what a study found in the full setting, by quantity."""
    rows: list[Any] = read_all(results)[study]["full"]["rows"]
    return {row.quantity: row.ours for row in rows}


def draw(results: Path) -> Figure:
    """Draw both panels."""
    figure = style.new_figure(9.5, 3.6)
    left, right = figure.subplots(1, 2)
    reach = {
        (int(match[2]), float(match[1])): share
        for quantity, share in values(results, "reachability_by_device").items()
        if (match := QUANTITY.fullmatch(quantity))
    }
    for number, radius in enumerate(RADII_MM):
        scopes = sorted(scope for of, scope in reach if of == radius)
        shares = [reach[radius, scope] for scope in scopes]
        left.plot(scopes, shares, "o-", color=f"C{number}", ms=4, label=f"needle of {radius} mm radius")
    left.set(xlabel="diameter of the bronchoscope, mm", ylabel="lung tissue within reach, %", ylim=(0, 100))
    success = values(results, "procedures")
    width = 0.8 / len(PROCEDURES)
    for number, procedure in enumerate(PROCEDURES):
        shares = [success[f"{errors}, {procedure}: succeed, median of the plans"] for errors in ERRORS]
        at = [place + width * (number - 1.5) for place in range(len(ERRORS))]
        right.bar(at, shares, width, color=f"C{number}", label=procedure)
    right.set_xticks(range(len(ERRORS)), ERRORS, rotation=20)
    right.set(xlabel="errors", ylabel="procedures that succeed, median, %", ylim=(0, 100))
    left.legend(frameon=False, fontsize=7)
    right.legend(frameon=False, fontsize=7, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return figure


def main() -> None:
    """Draw the figure and store it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, default=HERE.parent / "results")
    parser.add_argument("--out", type=Path, default=HERE / "reach_and_success.png")
    asked = parser.parse_args()
    with atomic_write(asked.out) as temporary:
        temporary.write_bytes(small_png(draw(asked.results)))


if __name__ == "__main__":
    main()

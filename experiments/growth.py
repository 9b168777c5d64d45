"""How CPU time and memory grow with voxels, targets, atlas entries, tubes and lesions.

    python -m experiments.growth [--quick] [--only NAME ...]

The work is that of the benchmarks (`benchmarks/workloads.py`).  Each size runs in a process of its own:
the least CPU time of several runs, all threads together, kernels compiled before, and the peak memory with
inputs.  An exponent is the slope of a line through the logarithms, and the last slope is that between the two
largest sizes: where it exceeds the exponent, time grows faster than the line says.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from anatomy.base.records import frozen_value
from benchmarks.workloads import WORKLOADS, Workload
from experiments.support.results import Result, setting_of, study_parser, write_result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

QUICK_SIZES = {
    "voxels": 256, "targets": 1000, "atlas entries": 10**6, "tubes": 5, "lesions": 30,
}  # fmt: skip
"""Largest sizes of the quick setting."""
OVERHEAD_S = 1e-3
"""Sizes that take less are left out of the fit where two longer ones are left: calls and threads dominate."""


@frozen_value
class Growth:
    """CPU time and peak memory of one workload for each amount of work, ascending."""

    name: str
    amounts: tuple[int, ...]
    cpu_s: tuple[float, ...]
    peak_mb: tuple[float, ...]

    @property
    def workload(self) -> Workload:
        """What was run."""
        return WORKLOADS[self.name]

    def fitted(self) -> tuple[float, float]:
        """Return exponent and logarithm of the factor of the line through the logarithms."""
        runs, least = self.workload.runs, self.workload.fitted_from
        pairs = enumerate(zip(self.amounts, self.cpu_s, strict=True))
        long = [i for i, (amount, s) in pairs if s * runs >= OVERHEAD_S and amount >= least]
        used = long if len(long) > 1 else list(range(len(self.cpu_s)))
        x, y = np.log(np.array(self.amounts)[used]), np.log(np.array(self.cpu_s)[used])
        slope, offset = np.polyfit(x, y, 1)
        return float(slope), float(offset)

    def last_slope(self) -> float:
        """Return the exponent between the two largest sizes."""
        (a, b), (s, t) = self.amounts[-2:], self.cpu_s[-2:]
        return float(np.log(t / s) / np.log(b / a))


def run(name: str, *, quick: bool) -> Growth:
    """Measure a workload at all its sizes, each in a process of its own."""
    workload = WORKLOADS[name]
    sizes = [size for size in workload.sizes if not quick or size <= QUICK_SIZES[workload.grows]]
    found = [_measured(name, size) for size in sizes]
    return Growth(
        name=name,
        amounts=tuple(workload.amount(size) for size in sizes),
        cpu_s=tuple(each["cpu_s"] for each in found),
        peak_mb=tuple(each["peak_mb"] for each in found),
    )


def _measured(name: str, size: int) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks.workloads", name, str(size)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    print(f"{name} {size}: {found['cpu_s']:.3g} s, {found['peak_mb']:.0f} MB", flush=True)
    return found


def add_rows(result: Result, growth: Growth) -> None:
    """Add time and memory at the largest size, and the exponents."""
    title, grows = growth.workload.title, growth.workload.grows
    at = f"at {growth.amounts[-1]:,} {grows}"
    slope, _offset = growth.fitted()
    promised = growth.workload.promised
    asked = "" if promised is None else f"; the algorithm promises {promised:g}"
    result.add(f"{title}: CPU time {at}", 1e3 * growth.cpu_s[-1], unit="ms", note=_all(growth))
    result.add(
        f"{title}: exponent of time over {grows}", slope,
        note=f"{growth.last_slope():.2f} between the two largest{asked}",
    )  # fmt: skip
    result.add(f"{title}: peak memory {at}", growth.peak_mb[-1], unit="MB", note="inputs included")


def _all(growth: Growth) -> str:
    pairs = zip(growth.amounts, growth.cpu_s, strict=True)
    return "ms: " + ", ".join(f"{1e3 * seconds:.3g} at {amount:,}" for amount, seconds in pairs)


def draw(found: Sequence[Growth]) -> Figure:
    """Draw time over work, both logarithmic, with the fitted lines; one panel for what grows."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    kinds = list(dict.fromkeys(growth.workload.grows for growth in found))
    figure, panels = plt.subplots(1, len(kinds), figsize=(3.4 * len(kinds), 3.6), squeeze=False)
    for panel, kind in zip(panels[0], kinds, strict=True):
        for growth in (each for each in found if each.workload.grows == kind):
            slope, offset = growth.fitted()
            amounts = np.array(growth.amounts, dtype=float)
            (dots,) = panel.loglog(amounts, growth.cpu_s, "o", markersize=4)
            panel.loglog(
                amounts, np.exp(offset) * amounts**slope, "-", color=dots.get_color(), linewidth=1,
                label=f"{growth.workload.title}: {slope:.2f}",
            )  # fmt: skip
        if growth.workload.grows != "voxels" and amounts[-1] < 100.0 * amounts[0]:
            panel.set_xticks(amounts, [f"{amount:g}" for amount in amounts])
        panel.minorticks_off()
        panel.set_xlabel(kind)
        panel.grid(True, which="major", alpha=0.3)
        panel.legend(fontsize=7, title="exponent", title_fontsize=7)
    panels[0, 0].set_ylabel("CPU time of one, s")
    figure.tight_layout()
    return figure


def main() -> None:
    """Measure, print, and write the result."""
    parser = study_parser(__doc__)
    parser.add_argument("--only", nargs="+", choices=sorted(WORKLOADS), default=list(WORKLOADS))
    options = parser.parse_args()
    result = Result(
        name="growth", title="Growth of time and memory with the work", setting=setting_of(options),
        conditions={
            "anatomy": "synthetic: scattered obstacles, phantom chest (seed 3), random airways (seeds 0 to "
            "4); for the index, deployments of an atlas of the phantom, drawn and moved by up to 0.5 mm",
            "time": "CPU time of all threads, least of several runs, each size in a process of its own",
            "fit": f"least squares on the logarithms, without sizes below {1e3 * OVERHEAD_S:g} ms and below "
            "100 targets",
        },
        seeds=[0],
    )  # fmt: skip
    found = [run(name, quick=options.quick) for name in options.only]
    for growth in found:
        add_rows(result, growth)
    result.figure = draw(found)
    print(write_result(result, options.results))


if __name__ == "__main__":
    main()

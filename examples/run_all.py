"""Run the examples in the order of the gallery: `python examples/run_all.py FOLDER` writes their pictures there."""

from __future__ import annotations

import os
import runpy
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
NAMES = (
    "patient",
    "sites",
    "tubes",
    "coupled_plan",
    "needle",
    "diverse_plans",
    "device",
    "risk",
    "study",
)


def run(name: str) -> None:
    """Run one example in the current folder, as `python examples/NAME.py` does."""
    runpy.run_path(str(HERE / f"{name}.py"), run_name="__main__")


def main(folder: str) -> None:
    """Run all examples in a folder; it is made if it is not there."""
    os.environ.setdefault("MPLBACKEND", "agg")
    Path(folder).mkdir(parents=True, exist_ok=True)
    os.chdir(folder)
    for name in NAMES:
        began = time.perf_counter()
        run(name)
        print(f"{name}: {time.perf_counter() - began:.1f} s", file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1])

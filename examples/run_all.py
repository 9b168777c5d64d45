"""Run the examples in the order of the gallery: `python examples/run_all.py OUT` puts pictures in OUT."""

from __future__ import annotations

import os
import runpy
import shutil
import sys
import tempfile
import time
from contextlib import chdir
from pathlib import Path

HERE = Path(__file__).parent
NAMES = (
    "patient",
    "scope_motions",
    "advisor",
    "tubes",
    "needle",
    "coupled_plan",
    "objective",
    "diverse_plans",
    "planner",
    "goal",
    "risk",
    "success",
    "device",
    "study",
)
"""Later examples use the patient and the plan that earlier ones write."""


def run_all(out: Path) -> None:
    """Run each example as `python examples/NAME.py` does, in a folder that is then thrown away."""
    os.environ.setdefault("MPLBACKEND", "agg")
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        for name in NAMES:
            began = time.perf_counter()
            runpy.run_path(str(HERE / f"{name}.py"), run_name="__main__")
            shutil.copy(f"{name}.png", out)
            print(f"{name}: {time.perf_counter() - began:.1f} s", file=sys.stderr)


if __name__ == "__main__":
    run_all(Path(sys.argv[1]).absolute())

"""What commands cost on a synthetic patient that is prepared, each in a new process."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.fresh import ROOT

PATIENT, PLAN = "PATIENT", "plan/plan.json"
RUN = "from lungaccess.cli.app import main; raise SystemExit(main())"
FIRST_PLAN = """
import sys, time
from lungaccess.cli import app, plan_search
def told(self, plan):
    print(time.process_time())
    raise KeyboardInterrupt
plan_search.CostHistory.on_plan = told
app.main(sys.argv[1:])
"""
"""Says the CPU seconds from the start of the process until the first plan is saved, and ends the search."""
CPU = f"import time\ntry:\n    {RUN}\nfinally:\n    print('CPU', time.process_time())"
SEARCH = ("plan", PATIENT, "--nodule", "1", "--iterations", "50", "--out", "plan")
COMMANDS = {
    "plan": SEARCH,
    "plan without pictures": (*SEARCH, "--no-pictures"),
    "report": ("report", PLAN, PATIENT),
    "risk": ("risk", PLAN, PATIENT),
}


def run(folder: str, code: str, *words: str) -> str:
    """Run code with the words of a command in a folder, its cache beside it; return what it prints."""
    environment = {**os.environ, "LUNGACCESS_CACHE": str(Path(folder) / "cache"), "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, "-c", code, *words], check=True, env=environment, cwd=folder, capture_output=True,
        text=True,
    )  # fmt: skip
    return done.stdout


class Prepared:
    """A synthetic patient whose anatomy, atlas, pictures and kernels are cached."""

    timeout = 900
    unit = "s"

    def setup_cache(self) -> str:
        """Make the patient, and run each command once."""
        folder = tempfile.mkdtemp()
        words = ("phantom", "--out", PATIENT, "--size", "adult", "--spacing", "1.25", "--seed", "1")
        for each in (words, *COMMANDS.values()):
            run(folder, RUN, *each)
        return folder


class Commands(Prepared):
    """CPU seconds of whole commands, start of the interpreter and imports among them."""

    params = tuple(COMMANDS)
    param_names = ("command",)

    def track_cpu_s(self, folder: str, command: str) -> float:
        """Return the CPU seconds of a command."""
        return float(run(folder, CPU, *COMMANDS[command]).rsplit("CPU", 1)[1])


class FirstPlan(Prepared):
    """CPU seconds from the start of the interpreter until the first plan is saved."""

    def track_cpu_s(self, folder: str) -> float:
        """Return the CPU seconds."""
        return float(run(folder, FIRST_PLAN, *SEARCH, "--no-pictures").split()[0])

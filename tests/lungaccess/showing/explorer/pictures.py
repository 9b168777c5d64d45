"""What a picture of the explorer costs where the processor draws: slider, turning, cross of the slices.

Run `python -m tests.lungaccess.showing.explorer.pictures PATIENT [--cache FOLDER]`; it prints the rows of
docs/measurements/explorer.md.  Processor time is that of all processes of the browser.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path
from typing import Any

from lungaccess.showing.explorer import PatientSource
from tests.lungaccess.showing.explorer.windows import PLANNED, Page, Served

PICTURES = 60
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
MOVES = {
    "slider of the deployment": "const e = document.getElementById('position'); e.value = 1000 * share;"
    " e.dispatchEvent(new Event('input'))",
    "turning": "const { orbit } = window.lungaccessExplorer; orbit.yaw += 0.05; orbit.changed()",
    "cross of the slices": "const { views } = window.lungaccessExplorer; const [x, y, z] = views.place;"
    " views.moveTo([x + 0.3, y + 0.3, z + 0.3])",
}
LOOP = (
    "let n = 0; const step = () => { if (n >= %d) { done(n); return; } const share = n / %d; n += 1; %s;"
    " requestAnimationFrame(step); }; requestAnimationFrame(step)"
)


def family(pid: int) -> list[int]:
    """Return a process and all that it has started."""
    found = [pid]
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            found += family(int(child))
    return found


def processor_s(pids: list[int]) -> float:
    """Return the processor time of processes, user and system."""
    total = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        total += int(fields[11]) + int(fields[12])
    return total / TICKS_PER_S


def main() -> None:
    """Read the arguments, move and show."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("patient", type=Path)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--ct", type=Path)
    given: Any = parser.parse_args()
    served = Served(
        PatientSource(folder=given.patient, system="lung-default", cache=given.cache, ct=given.ct)
    )
    try:
        with Page(1440, 1000) as window:
            window.open(served.address.url)
            window.run("window.lungaccessExplorer.state.set({ target: 'nodule 1', iterations: 100 })")
            window.wait(f"{PLANNED} && s.reach && s.reach.share === 1")
            pids = family(window.driver_pid)
            for name, move in MOVES.items():
                window.run_async(LOOP % (5, 5, move))
                before, began = processor_s(pids), time.monotonic()
                window.run_async(LOOP % (PICTURES, PICTURES, move))
                used, took = processor_s(pids) - before, time.monotonic() - began
                print(f"| {name} | {1000 * used / PICTURES:.0f} ms | {PICTURES / took:.1f} |", flush=True)
    finally:
        served.stop()


if __name__ == "__main__":
    main()

"""A long session in a real browser: clicks, memory, requests, and plans against those of the command.

Run `python -m tests.lungaccess.showing.explorer.session PATIENT [--clicks 500] [--cache FOLDER]`; it prints
the rows of docs/measurements/explorer.md.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from experiments.explorer_speed import memory_mb, targets
from lungaccess.showing.explorer import PatientSource
from tests.lungaccess.showing.explorer.windows import PLANNED, Page, Served

ITERATIONS = 50
WINDOW = 700, 620
"""Small: where the processor draws, pictures take most of the time."""
SLICES = ("slice-axial", "slice-coronal", "slice-sagittal")
CLICKED_PX = 40.0, 180.0
"""Clicks into slices are so far from their upper left, where the list of views stands."""
NO_PLAN = "!document.getElementById('no-plan').hidden"
SHOWN = f"(s.failure || {NO_PLAN} || (s.exits && s.exits.complete && (s.plan || !s.exits.count)))"
"""A click is answered: with a plan, with no exit, with the reasons for no plan, or with why not."""
DECIDED = f"(s.failure || ({PLANNED}) || {NO_PLAN})"
NO_TARGET = "TargetError"
"""What is said of a point that cannot be a target, such as one in a vessel."""
EXPORTED = """const page = window.lungaccessExplorer; let address = null;
page.asker.ask('export', { plan: '%s', what: 'plan.json', slot: 'session' }, (each) => {
  if (each.answer === 'link') address = each.address;
}).then(() => fetch(address)).then((file) => file.text()).then(done, (error) => done(String(error)))"""
"""The plan with a digest, as the page exports it."""
RUN = "import sys; from lungaccess.cli.app import main; sys.exit(main())"
GROWTH = 1.15
"""Memory at the end may be so much more than after a fifth of the clicks: caches of the kernels fill late."""


@dataclass
class Session:
    """What was seen: memory in MB by process after each part, and what went wrong."""

    memory: dict[str, list[float]] = field(default_factory=dict)
    messages: list[str] = field(default_factory=list)
    hosts: set[str] = field(default_factory=set)
    clicks: int = 0
    requests: int = 0
    plans: int = 0
    compared: int = 0
    differing: list[str] = field(default_factory=list)

    def add(self, name: str, value: float) -> None:
        """Take over a measured memory."""
        self.memory.setdefault(name, []).append(value)

    def growth(self, name: str) -> float:
        """Return the memory at the end, as a share of that after a fifth of the session."""
        values = self.memory[name]
        return values[-1] / values[len(values) // 5]


Telling = Callable[[Session], None]
"""Is told what was seen so far, after each part of a session."""


def click_through(
    window: Page, served: Served, points: np.ndarray, parts: int, compare: int, told: Telling
) -> Session:
    """Click many targets, by mouse in a slice and by coordinates in turns; compare every so-manieth plan."""
    made, rng = Session(), np.random.default_rng(0)
    window.run("window.lungaccessExplorer.state.set({ iterations: arguments[0] })", ITERATIONS)
    part = max(len(points) // parts, 1)
    for n, point in enumerate(points, start=1):
        if n % 2 == 0:
            before = json.dumps(window.state()["asked"]["target"])
            window.press_at(SLICES[n // 2 % 3], *rng.uniform(*CLICKED_PX, 2).tolist())
            state = window.wait(f"s.asked.target !== {before} && {SHOWN}")
        else:
            text = "lps:" + ",".join(f"{value:.1f}" for value in point)
            window.run("document.getElementById('target-text').value = arguments[0]", text)
            window.run("document.getElementById('target-form').requestSubmit()")
            state = window.wait(f"s.asked.target === {json.dumps(text)} && {SHOWN}")
            if state["plan"] and made.plans // compare >= made.compared:
                compare_with_command(window, made)
            made.plans += state["plan"] is not None
        if state["failure"] not in (None, NO_TARGET):
            made.messages.append(f"{state['failure']}: {window.text('headline-text')}")
        if n % part == 0:
            take_memory(window, served, made)
            made.messages += window.messages()
            take_requests(window, made)
            made.clicks = n
            told(made)
    return made


def compare_with_command(window: Page, made: Session) -> None:
    """Run the command that the page states, and compare its plan with the one that the page exports."""
    state = window.wait(DECIDED)
    if not state["plan"]:
        return
    digest, command = state["plan"]["digest"], state["plan"]["command"]
    text = str(window.run_async(EXPORTED % digest))
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-c", RUN, *shlex.split(command)[1:], "--no-pictures"]
        done = subprocess.run(words, cwd=folder, env=os.environ, capture_output=True, check=False)
        file = Path(folder) / "plan" / "plan.json"
        written = file.read_text() if file.is_file() else done.stderr.decode()
    made.compared += 1
    if without_times(text) != without_times(written):
        made.differing.append(command)


def without_times(text: str) -> str:
    """Return a plan as text without its times."""
    try:
        values = json.loads(text)
    except ValueError:
        return text
    values.pop("timing")
    return json.dumps(values, sort_keys=True)


def take_memory(window: Page, served: Served, made: Session) -> None:
    """Measure server, processes and page, the page after its garbage was collected."""
    made.add("server", memory_mb(os.getpid()))
    for name, pid in served.explorer.processes.items():
        if pid is not None:
            made.add(name, memory_mb(pid))
    window.command("HeapProfiler.collectGarbage", {})
    made.add("page: heap", window.command("Runtime.getHeapUsage", {})["usedSize"] / 2**20)
    counted = window.command("Memory.getDOMCounters", {})
    made.add("page: nodes", counted["nodes"])
    made.add("page: listeners", counted["jsEventListeners"])


def take_requests(window: Page, made: Session) -> None:
    """Take over where the page has asked."""
    asked = [u for u in window.requests() if not u.startswith(("data:", "blob:", "about:", "chrome:"))]
    made.requests += len(asked)
    made.hosts |= {url.split("/")[2] for url in asked}


def show(made: Session) -> None:
    """Print what was seen so far."""
    print(f"after {made.clicks} clicks:")
    for name, values in made.memory.items():
        print(f"| {name} | {', '.join(f'{value:.0f}' for value in values)} | {made.growth(name):.2f} |")
    print(f"{made.plans} plans to stated points; {made.compared} compared, {len(made.differing)} differ")
    print(f"{made.requests} requests, to {', '.join(sorted(made.hosts))}; {len(made.messages)} messages")
    print(*made.differing, *made.messages[:5], sep="\n", flush=True)


def main() -> None:
    """Read the arguments, click and show."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("patient", type=Path)
    parser.add_argument("--clicks", type=int, default=500)
    parser.add_argument("--compare", type=int, default=15, help="every so-manieth plan")
    parser.add_argument("--cache", type=Path)
    given: Any = parser.parse_args()
    source = PatientSource(folder=given.patient, system="lung-default", cache=given.cache)
    points = targets(given.patient, given.cache, given.clicks)
    served = Served(source)
    try:
        with Page(*WINDOW) as window:
            window.open(served.address.url)
            click_through(window, served, points, 20, given.compare, show)
    finally:
        served.stop()


if __name__ == "__main__":
    main()

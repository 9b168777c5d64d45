"""From the empty page to a checked plan on a CT that the project does not hold, by the buttons of the page.

Run `python -m tests.lungaccess.showing.explorer.from_empty CT --nodule x,y,z --out SCREENS` in an empty
folder; it writes a picture of the window after each step and prints seconds, memory and where the page asked.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from experiments.explorer_speed import memory_mb
from lungaccess.showing.explorer import PatientSource
from tests.lungaccess.showing.explorer.pictures import processor_s
from tests.lungaccess.showing.explorer.windows import PLANNED, Page, Served, explored, press

DECIDED = f"({PLANNED}) || s.failure !== null || !document.getElementById('no-plan').hidden"


def settled(page: Page, condition: str) -> dict[str, Any]:
    """Wait until a condition of the state `s` holds, however slow the machine is, and return the state."""
    script = f"const s = window.lungaccessReport.state(); return Boolean({condition})"
    while not page.run(script):
        time.sleep(0.1)
    return page.state()


class Walk:
    """One way through the page: each step is timed, and its picture kept.

    Args:
        out: Folder of the pictures.
    """

    def __init__(self, served: Served, page: Page, out: Path) -> None:
        self.served, self.page, self.out = served, page, out
        self.count = 0

    def step(self, words: str, doing: Callable[[], Any]) -> Any:
        """Do a step, and tell how long it took, by the clock and by processors, and the memory after it."""
        began, cpu = time.monotonic(), self._cpu_s()
        found = doing()
        took, cpu = time.monotonic() - began, self._cpu_s() - cpu
        self.count += 1
        name = f"{self.count}-{words.replace(' ', '-')}"
        self.page.frame()
        self.page.screenshot(self.out / f"{name}.png")
        memory = {each: round(memory_mb(pid)) for each, pid in self._pids()}
        print(f"| {words} | {took:.1f} s | {cpu:.1f} s of processors | {memory} MB |", flush=True)
        return found

    def _pids(self) -> list[tuple[str, int]]:
        processes = self.served.explorer.processes.items()
        return [("server", os.getpid()), *((name, pid) for name, pid in processes if pid is not None)]

    def _cpu_s(self) -> float:
        return sum(processor_s([pid]) for _, pid in self._pids())


def accepted(page: Page, accept: bool) -> dict[str, Any]:
    """Wait for masks; a question on the way is answered and printed, as is what is not answered."""
    while True:
        state = settled(page, "!s.busy")
        question = state["question"]
        if "Go on all the same" in question and accept:
            print("   question:", question)
            press(page, "Go on all the same")
        elif "Proposed" in question:
            print("   series:", question)
            press(page, "Proposed")
        else:
            return state


def walk(ct: Path, nodule: list[float], out: Path, served: Served, page: Page, accept: bool) -> None:
    """Go from the empty page to the plan."""
    on = Walk(served, page, out)
    on.step("empty page", lambda: page.open(served.address.url))
    page.run("document.getElementById('path').value = arguments[0]", str(ct))

    def segmented() -> dict[str, Any]:
        page.click("take")
        time.sleep(0.5)
        return accepted(page, accept)

    state = on.step("segmented", segmented)
    print("   page:", state["problem"] or state["question"])
    if state["problem"]:
        return
    settled(page, "document.getElementById('picture').naturalWidth > 0")

    def exploring() -> None:
        press(page, "The masks are right")
        explored(page)

    on.step("explored", exploring)
    page.run("window.lungaccessExplorer.moveTo(arguments[0])", nodule)
    on.step("cross moved", lambda: settled(page, "s.place !== null"))
    if page.run("return document.getElementById('outline').hidden"):
        page.click("cross-target")
    else:

        def outlined() -> None:
            page.click("outline")
            settled(
                page,
                "document.getElementById('outline').textContent.startsWith('Add this nodule')"
                " || document.getElementById('target-error').textContent",
            )

        on.step("outlined", outlined)
        print("   page:", page.text("outline"), page.text("target-error"))
        if page.text("target-error"):
            page.click("cross-target")
        else:

            def added() -> None:
                page.run("window.before = true")
                page.click("outline")
                explored(page)

            on.step("added", added)
    on.step("planned", lambda: settled(page, DECIDED))
    print("   page:", page.text("headline-text"), page.text("no-plan-why"))
    print("   state:", json.dumps({key: page.state()[key] for key in ("failure", "target_lps")}))


def main() -> None:
    """Read the arguments and walk."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ct", type=Path)
    parser.add_argument("--nodule", required=True, help="x,y,z of a place in the nodule, LPS mm")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--accept", action="store_true", help="go on where the page asks")
    given: Any = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    served = Served(PatientSource(folder=None, system="lung-default", cache=given.cache))
    try:
        with Page(1440, 900) as page:
            nodule = [float(value) for value in given.nodule.split(",")]
            walk(given.ct.resolve(), nodule, given.out, served, page, given.accept)
            print("messages:", page.messages())
            hosts = {url.split("/")[2] for url in page.requests() if url.startswith(("http", "ws"))}
            print("hosts:", hosts)
    finally:
        served.stop()


if __name__ == "__main__":
    main()

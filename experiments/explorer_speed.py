"""How soon the explorer answers, and whether its memory stays flat: random clicks over its own socket.

Run `python -m experiments.explorer_speed PATIENT [--clicks 500] [--cache FOLDER]`; it prints the rows of
docs/measurements/explorer.md.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np

from anatomy.structures import obstacle_bits
from lungaccess import load_patient
from lungaccess.showing.explorer import Address, Explorer, PatientSource
from lungaccess.showing.explorer.messages import read_frame

LAST = ("end", "error", "superseded")
RADII_MM = (121.0, 90.0, 60.0, 150.0)
SEED = 0
CLICK = {"exits": "clicks", "plan": "plans"}
"""The process that answers each question of a click."""


@dataclass
class Measured:
    """Times in ms by what was measured."""

    rows: dict[str, list[float]] = field(default_factory=dict)

    def add(self, what: str, value: float) -> None:
        self.rows.setdefault(what, []).append(value)

    def print(self) -> None:
        for what, values in self.rows.items():
            print(f"| {what} | {np.median(values):.0f} | {np.max(values):.0f} | {len(values)} |")


def targets(patient: Path, cache: Path | None, count: int) -> np.ndarray:
    """Return random points of free tissue, LPS mm, in nodules and in all of the lung alike."""
    lung = load_patient(patient, cache=cache)
    rng = np.random.default_rng(SEED)
    found: list[np.ndarray] = []
    shape = np.array(lung.grid.shape)
    while len(found) < count:
        ijk = rng.integers(0, shape)
        if lung.labels[tuple(ijk)] & obstacle_bits(True) == 0:
            found.append(lung.grid.lps(ijk[None])[0])
    return np.array(found)


def memory_mb(pid: int) -> float:
    """Return the memory of a process that is its own, MB."""
    status = Path(f"/proc/{pid}/status").read_text()
    return float(status.split("RssAnon:")[1].split()[0]) / 1024.0


def processor_ms(pid: int) -> np.ndarray:
    """Return the processor time of the main thread of a process, and how long it waited for a processor."""
    used, waited, _slices = Path(f"/proc/{pid}/schedstat").read_text().split()
    return np.array([int(used), int(waited)]) / 1e6


class Page:
    """A page without a browser."""

    def __init__(self, socket: aiohttp.ClientWebSocketResponse, explorer: Explorer) -> None:
        self._socket, self._explorer, self._number = socket, explorer, 0

    async def click(self, measured: Measured, stop_at: dict[str, str], **asked: dict[str, Any]) -> None:
        """Ask several questions at once; wait for the answer of each that `stop_at` names, or its last one.

        A plan is not waited for where no exit is feasible: the search may then take long.
        """
        began, before = time.perf_counter(), self._processor_ms()
        names = {}
        for name, values in asked.items():
            self._number += 1
            names[self._number] = name
            await self._socket.send_str(json.dumps({"ask": name, "id": self._number, **values}))
        while names:
            message, _arrays = read_frame((await self._socket.receive()).data)
            name = names.get(message["id"])
            if name is None:
                continue
            if message["answer"] == stop_at.get(name):
                measured.add(name, 1000.0 * (time.perf_counter() - began))
                if name in before:
                    used, waited = self._processor_ms()[name] - before[name]
                    measured.add(f"{name}: processor time of its process", used)
                    measured.add(f"{name}: its process waited for a processor", waited)
            if message["answer"] in (stop_at.get(name), *LAST):
                del names[message["id"]]
            if message["answer"] == "exits" and message["complete"] and not message["deployments"]:
                names = {}

    def _processor_ms(self) -> dict[str, np.ndarray]:
        """Return the processor times of the processes that answer a click."""
        pids = self._explorer.processes
        return {ask: processor_ms(pid) for ask, name in CLICK.items() if (pid := pids[name]) is not None}


async def measure(source: PatientSource, points: np.ndarray) -> None:
    """Click, change the needle, and watch the memory."""
    explorer = Explorer(source)
    address: Address = await explorer.start()
    headers = {"Cookie": f"{address.cookie}={address.token}", "Origin": address.origin}
    async with (
        aiohttp.ClientSession() as session,
        session.ws_connect(f"{address.origin}/socket", headers=headers, max_msg_size=0) as socket,
    ):
        page, nothing = Page(socket, explorer), Measured()
        await page.click(nothing, {}, prepare={})
        await page.click(nothing, {}, ready={})
        clicks, memory = Measured(), []
        for point in points:
            target = "lps:" + ",".join(f"{value:.1f}" for value in point)
            await page.click(
                clicks, {"exits": "exits", "plan": "plan"}, exits={"target": target},
                plan={"target": target, "iterations": 100},
            )  # fmt: skip
            pids = explorer.processes
            memory.append([memory_mb(pid) for name in CLICK.values() if (pid := pids[name]) is not None])
        clicks.print()
        tenth = max(len(memory) // 10, 1)
        for name, values in zip(CLICK.values(), np.transpose(memory), strict=True):
            kept = ", ".join(f"{value:.0f}" for value in values[tenth - 1 :: tenth])
            print(f"memory of {name}, MB, after each tenth: {kept}")
        changes, around = Measured(), points[0].tolist()
        await page.click(nothing, {}, reach={"around": around})
        for radius in RADII_MM * 5:
            asked = {"around": around, "what_if": {"needle_radius_mm": radius}}
            await page.click(changes, {"reach": "reach"}, reach=asked)
        changes.print()
    await explorer.stop()


def main() -> None:
    """Read the arguments and measure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("patient", type=Path)
    parser.add_argument("--clicks", type=int, default=500)
    parser.add_argument("--cache", type=Path)
    given = parser.parse_args()
    source = PatientSource(folder=given.patient, system="thin-scope", cache=given.cache)
    asyncio.run(measure(source, targets(given.patient, given.cache, given.clicks)))


if __name__ == "__main__":
    main()

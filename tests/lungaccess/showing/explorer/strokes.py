"""How long a stroke takes until it is seen, until there is another plan, and until the plan is final.

Time is that by the clock, and that of the processors; memory is told as well.

Run `python -m tests.lungaccess.showing.explorer.strokes PATIENT --structure vessel`; what was painted is
taken back at the end.  On a machine that others use, processor time is what counts.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np

import lungaccess as la
from experiments.explorer_speed import memory_mb
from lungaccess.showing.explorer import Explorer, PatientSource
from tests.lungaccess.showing.explorer.client import LAST, Client, with_client
from tests.lungaccess.showing.explorer.pictures import processor_s

SYSTEM = "lung-default"


def places(lung: la.Lung, structure: str, seed: int, count: int) -> np.ndarray:
    """Return places in free tissue, 6 mm from obstacles, or on thin airways."""
    rng = np.random.default_rng(seed)
    if structure == "airway":
        points = lung.tree.points_lps[lung.tree.n_points // 2 :]
    else:
        points = lung.grid.lps(np.argwhere(lung.labels[::6, ::6, ::6] == 0) * 6)
        points = points[lung.fields["obstacle"].lower_bound_mm(points) > 6.0]
    return points[rng.integers(len(points), size=count)]


def spent_s(before: dict[str, float], after: dict[str, float]) -> dict[str, float]:
    """Return the processor time of the processes that did anything."""
    spent = {name: round(now - before.get(name, 0.0), 2) for name, now in after.items()}
    return {name: each for name, each in spent.items() if each >= 0.01}


def main() -> None:
    """Read the arguments, paint and show."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("patient", type=Path)
    parser.add_argument("--structure", default="vessel")
    parser.add_argument("--strokes", type=int, default=5)
    parser.add_argument("--target", help="lps:x,y,z or the name of a target; else a place that is drawn")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--cache", type=Path)
    given: Any = parser.parse_args()
    lung = la.load_patient(given.patient, cache=given.cache)
    target = given.target
    if target is None:
        point, *_ = places(lung, "vessel", given.seed, 1).tolist()
        target = f"lps:{','.join(f'{value:.1f}' for value in point)}"
    asked: dict[str, Any] = {"target": target, "what_if": {"system": SYSTEM}}

    async def talk(client: Client, explorer: Explorer) -> None:
        async def timed(words: str, ask: str, first: str = "", **values: Any) -> None:
            def used() -> dict[str, float]:
                return {
                    name: processor_s([pid]) for name, pid in explorer.processes.items() if pid is not None
                }

            before, began = used(), time.monotonic()
            number, said, early = await client.send(ask, **values), "", ""
            while said not in LAST:
                found = (await client.next())[0]
                said = found["answer"] if found["id"] == number else said
                if said == first and not early:
                    early = f"{first} after {time.monotonic() - began:.1f} s, {spent_s(before, used())}; "
            took = time.monotonic() - began
            spent = spent_s(before, used())
            memory = {name: round(memory_mb(explorer.processes[name] or 0)) for name in spent}
            print(f"| {words} | {early}{said} after {took:.1f} s, {spent} s | {memory} MB |", flush=True)

        await timed("exits", "prepare", what_if=asked["what_if"])
        await timed("first plan", "plan", **asked)
        await timed("masks", "paint", tool="open", what_if=asked["what_if"])
        for place in places(lung, given.structure, given.seed + 1, given.strokes):
            stroke = {"tool": "paint", "structure": given.structure, "points": [place.tolist()]}
            await timed("stroke", "paint", "painted", **stroke, radius_mm=2.0, what_if=asked["what_if"])
            await timed("its plan", "plan", "plan", **asked)
        for _ in range(given.strokes):
            await client.ask("paint", tool="undo", what_if=asked["what_if"])

    source = PatientSource(folder=given.patient.resolve(), system=SYSTEM, cache=given.cache)
    with_client(source, talk)


if __name__ == "__main__":
    main()

"""Damage the files of targets again and again, and read them.

    python -m tests.fuzz.run bytes|numbers SEED COUNT KEEP TARGET...

Each input has at most two million calls and 20 s of processor time, and all together 4 GiB.  A line of JSON
for each target says how many of COUNT inputs were refused, and what went wrong.  A crash ends the process;
the file KEEP then holds the input.
"""

from __future__ import annotations

import json
import resource
import signal
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from anatomy.base.errors import LungaccessError
from anatomy.grid import Volume
from tests.fuzz.targets import Target, damaged, targets, with_a_number

MOST_BYTES, MOST_SECONDS, MOST_CALLS = 4 << 30, 20, 2_000_000


class TooMuchWork(BaseException):
    """An input makes its reader call more functions than any file needs."""


def main(kind: str, name: str, seed: int, count: int, keep: Path) -> dict[str, Any]:
    """Return how many inputs were refused, how many read, and the traceback of each fault."""
    resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
    signal.signal(signal.SIGVTALRM, _too_long)
    target, ends, faults = targets()[name], Counter[str](), []
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        target.make(folder)
        content = (folder / target.file).read_bytes()
        intact = target.read(folder)
        damage = with_a_number if kind == "numbers" else damaged
        for number in range(seed, seed + count):
            new, same_voxels = damage(np.random.default_rng(number), target, content)
            (folder / target.file).write_bytes(new)
            keep.write_bytes(new)
            fault = _fault(target, folder, intact, same_voxels, ends)
            if fault:
                faults.append({"seed": number, "fault": fault})
    return {"refused": ends["refused"], "read": ends["read"], "faults": faults}


def _fault(target: Target, folder: Path, intact: Any, same_voxels: bool, ends: Counter[str]) -> str:
    calls = 0

    def counted(frame: object, event: str, argument: object) -> None:
        nonlocal calls
        calls += event == "call"
        if calls > MOST_CALLS:
            raise TooMuchWork(f"more than {MOST_CALLS} calls")

    signal.setitimer(signal.ITIMER_VIRTUAL, MOST_SECONDS)
    sys.setprofile(counted)
    try:
        found = target.read(folder)
    except LungaccessError:
        ends["refused"] += 1
        return ""
    except BaseException:
        return traceback.format_exc(limit=-4)
    finally:
        sys.setprofile(None)
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    ends["read"] += 1
    odd = set(not_finite(found)) - set(not_finite(intact))
    if odd:
        return f"a number that is none was read: {sorted(odd)[:3]}"
    if isinstance(found, Volume):
        return _silent_change(found, intact, same_voxels)
    return ""


def _silent_change(found: Volume, intact: Volume, same_voxels: bool) -> str:
    """Tell if voxels moved although the grid is the same; a scale or another type may change their values."""
    if not same_voxels or found.grid.shape != intact.grid.shape:
        return ""
    if (np.abs(found.grid.lps_from_ijk - intact.grid.lps_from_ijk) > 1e-3).any():
        return ""
    for value in np.unique(intact.array):
        there = found.array[intact.array == value]
        if not (there == there.flat[0]).all():
            return "voxels changed in silence"
    return ""


def not_finite(found: Any, place: str = "") -> Iterator[str]:
    """Yield the places of what is read that hold NaN or an infinity."""
    if isinstance(found, np.ndarray | np.generic | float):
        if np.asarray(found).dtype.kind == "f" and not np.isfinite(found).all():
            yield place
    elif isinstance(found, Mapping):
        for key, value in found.items():
            yield from not_finite(value, f"{place}.{key}")
    elif isinstance(found, list | tuple):
        for number, value in enumerate(found):
            yield from not_finite(value, f"{place}.{number}")
    elif hasattr(found, "__dataclass_fields__"):
        yield from not_finite({name: getattr(found, name) for name in found.__dataclass_fields__}, place)


def _too_long(signum: int, frame: object) -> None:
    raise TimeoutError(f"more than {MOST_SECONDS} s")


if __name__ == "__main__":
    stated_kind, stated_seed, stated_count, stated_keep, *names = sys.argv[1:]
    for stated in names:
        said = main(stated_kind, stated, int(stated_seed), int(stated_count), Path(stated_keep))
        print(json.dumps({"target": stated, **said}), flush=True)

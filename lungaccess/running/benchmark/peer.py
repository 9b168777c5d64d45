"""Recorded results of another planner on the same queries."""

import json
import math
import re
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from statistics import median
from typing import Any

from anatomy.base.errors import FileError
from anatomy.base.files import DAMAGE, reason
from anatomy.base.records import frozen_value
from lungaccess.running.benchmark.published import UNC_EXEMPT_MM

Key = tuple[int, int, float]
"""Number of the patient, number of the start, and radius of curvature in mm."""


@frozen_value
class PeerResult:
    """What was recorded for one query: the kind of run that solved it most often, and then soonest.

    Parameters
    ----------
    planner : str
    runs, solved : int
        Of this kind.
    first_cpu_ms, length_mm : float or None
        Medians of its solved runs: processor time to the first path, and the length of the last one with the
        distance that it leaves to the target.
    refused : bool
        Whether the peer refused the query before planning: no run was made.
    """

    planner: str
    runs: int
    solved: int
    first_cpu_ms: float | None
    length_mm: float | None
    refused: bool


def read_peer(path: Path) -> Mapping[Key, PeerResult]:
    """Read recorded results: runs of one thread that ignore obstacles within 3 mm of the start.

    Raises
    ------
    FileError
        If the file cannot be read or holds something else.
    """
    try:
        runs = json.loads(path.read_text(encoding="utf-8"))["runs"]
        found: dict[Key, dict[str, list[dict[str, Any]]]] = defaultdict(lambda: defaultdict(list))
        for run in runs:
            if run["threads"] == 1 and run["start_exemption_mm"] == UNC_EXEMPT_MM:
                key = (int(run["patient"]), int(run["start"]), float(run["radius_mm"]))
                found[key][str(run["planner"])].append(run)
        return {key: _best(kinds) for key, kinds in found.items()}
    except DAMAGE as error:
        raise FileError(
            f"{path} holds no recorded results ({type(error).__name__}: {reason(error)})",
            expected='a JSON file {"runs": [...]} with patient, start, radius_mm, start_exemption_mm,'
            " planner, threads, valid_problem, solved, first_cpu_s, length_end_mm of every run",
            remedy="Leave out --peer to run without them",
        ) from error


def _best(kinds: Mapping[str, list[dict[str, Any]]]) -> PeerResult:
    def of(name: str) -> PeerResult:
        runs = [run for run in kinds[name] if run["valid_problem"]]
        solved = [run for run in runs if run["solved"]]
        firsts = [1e3 * run["first_cpu_s"] for run in solved if run["first_cpu_s"] is not None]
        lengths = [run["length_end_mm"] + (run["goal_error_mm"] or 0.0) for run in solved]
        return PeerResult(
            planner=name,
            runs=len(runs),
            solved=len(solved),
            first_cpu_ms=median(firsts) if firsts else None,
            length_mm=median(lengths) if lengths else None,
            refused=not runs,
        )

    results = [of(name) for name in kinds]
    return max(results, key=lambda r: (r.solved / max(r.runs, 1), -(r.first_cpu_ms or math.inf)))


def patient_number(name: str) -> int:
    """Return the number in the name of a patient's folder; 0 if there is none."""
    digits = re.search(r"\d+", name)
    return int(digits[0]) if digits else 0

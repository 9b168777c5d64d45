"""Several lesions in one procedure, as in section III of [Pan2025], and the exact shortest tour beside it.

    python experiments/pan2025_tour.py [PATIENT] [--models 100] [--lesions 3 9] [--out FILE] [--cache DIR]

Random bronchial models of eight orders with random lesions; the airway of a patient with five lesions if one
is given.  Distances are from the top of the trachea; at constant speed they are times.  Three ways of
working are compared: one lesion at a time with a return to the root in between (the paper's baseline), the
best open tour over the exits of least resistance, and the shortest tour over all choices of exits.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

import lungaccess as la
from anatomy.airway_tree import AirwayTree
from anatomy.grid import Float
from anatomy.io.files import atomic_write
from anatomy.lung import Lung
from stages.scope.tour.circuit import circuits
from stages.scope.tour.exits import Exit, find_exits
from stages.scope.tour.itinerary import itinerary, one_by_one_mm
from stages.scope.tour.models import random_airway, random_lesions
from stages.scope.tour.shortest import shortest_tour
from stages.scope.tour.ways import Ways, ways_to

PATIENT_LESIONS = 5
PATIENT_REACH_MM = (12.0, 35.0)
CLEAR_MM = 3.0


def compare(ways: Ways) -> dict[str, float]:
    """Return the lengths of all ways of working, and what they took to plan."""
    began = time.perf_counter()
    best = shortest_tour(ways)
    exact_s = time.perf_counter() - began
    began = time.perf_counter()
    found = circuits(ways)
    circuits_s = time.perf_counter() - began
    row: dict[str, float] = {
        "exact_mm": best.length_mm,
        "exact_ms": 1e3 * exact_s,
        "circuits_ms": 1e3 * circuits_s,
        "circuits": found.count,
        "distinct": found.distinct(),
        "exact_one_by_one_mm": one_by_one_mm(ways, best.chosen),
        "most_passes": int(best.passes.max()),
        "most_loops": int(best.loops.max()),
    }
    for reading in ("printed", "reduced"):
        tour = itinerary(ways, found.choice(reading))  # type: ignore[arg-type]
        row[f"{reading}_mm"] = tour.length_mm
        row[f"{reading}_one_by_one_mm"] = one_by_one_mm(ways, tour.chosen)
    depth = ways.depth_mm[ways.exit_vertex]
    nearest = [
        next(x for x in range(len(ways.exits)) if _is_nearest(ways.exits[x], m))
        for m in range(ways.n_lesions)
    ]
    row["nearest_mm"] = itinerary(ways, nearest).length_mm
    row["nearest_one_by_one_mm"] = float(2 * depth[nearest].sum() - depth[nearest].max())
    return row


def _is_nearest(each: Exit, lesion: int) -> bool:
    return each.lesion == lesion and bool({"P2", "inside"} & set(each.roles))


def study(models: int, fewest: int, most: int) -> dict[int, list[dict[str, float]]]:
    """Plan tours to all numbers of lesions on all models."""
    compare(_ways(random_airway(0), random_lesions(random_airway(0), 3, 0)))
    rows: dict[int, list[dict[str, float]]] = {count: [] for count in range(fewest, most + 1)}
    for seed in range(models):
        tree = random_airway(seed)
        for count, of_count in rows.items():
            of_count.append(compare(_ways(tree, random_lesions(tree, count, seed))))
    return rows


def _ways(tree: AirwayTree, lesions: Float) -> Ways:
    return ways_to(tree, find_exits(tree, lesions))


def show(rows: dict[int, list[dict[str, float]]]) -> None:
    """Print savings and gaps by number of lesions, and over all."""
    sys.stdout.write(
        "lesions  saved against one by one, %      gap to the exact tour, %: mean (largest)     "
        " equal   exact ms\n"
        "         printed  reduced  exact     printed        reduced        nearest       printed\n"
    )
    for count, of_count in rows.items():
        sys.stdout.write(f"{count:7d}  {_line(of_count)}\n")
    everything = [row for of_count in rows.values() for row in of_count]
    sys.stdout.write(f"    all  {_line(everything)}\n")
    saved = _saved(everything, "printed")
    sys.stdout.write(
        f"saved, printed choice: mean {saved.mean():.1f} %, RMSE {saved.std():.2f} % "
        "(paper: 76 %, RMSE 5.37 %)\n"
    )
    passes = max(row["most_passes"] for row in everything)
    loops = max(row["most_loops"] for row in everything)
    sys.stdout.write(f"most passes of a stretch {passes:.0f}; most loops through one {loops:.0f}\n")


def _saved(rows: list[dict[str, float]], name: str) -> Float:
    return np.array([100.0 * (1.0 - row[f"{name}_mm"] / row[f"{name}_one_by_one_mm"]) for row in rows])


def _line(rows: list[dict[str, float]]) -> str:
    saved = "  ".join(f"{_saved(rows, name).mean():7.1f}" for name in ("printed", "reduced", "exact"))
    gaps = {
        name: np.array([100.0 * (row[f"{name}_mm"] / row["exact_mm"] - 1.0) for row in rows])
        for name in ("printed", "reduced", "nearest")
    }
    table = "  ".join(f"{gap.mean():5.1f} ({gap.max():5.1f})" for gap in gaps.values())
    equal = 100.0 * float((gaps["printed"] < 1e-6).mean())
    times = np.array([row["exact_ms"] for row in rows])
    return f"{saved}   {table}  {equal:5.0f} %  {np.median(times):6.2f} ({times.max():.1f})"


def patient_lesions(lung: Lung, seed: int) -> Float:
    """Return places in the lung, away from obstacles and near enough to the airway, on both sides."""
    rng = np.random.default_rng(seed)
    found: list[Float] = []
    near, far = PATIENT_REACH_MM
    while len(found) < PATIENT_LESIONS:
        place = lung.grid.lps(rng.uniform(0.0, np.array(lung.grid.shape) - 1.0))
        left = place[0] > lung.tree.carina_lps[0]
        distance = float(np.linalg.norm(lung.tree.points_lps[lung.tree.nearest_point(place)] - place))
        clear = float(lung.obstacle_field(with_fissures=True).lower_bound_mm(place)[0])
        if left == (len(found) % 2 == 0) and near < distance < far and clear > CLEAR_MM:
            found.append(place)
    return np.array(found)


def patient_study(path: str, cache: str | None, seeds: int = 20) -> dict[str, Any]:
    """Plan tours to five lesions of a patient, for several draws of the lesions."""
    lung = la.load_patient(path, cache=cache)
    rows = [compare(_ways(lung.tree, patient_lesions(lung, seed))) for seed in range(seeds)]
    sys.stdout.write(
        f"\n{lung.name}, {PATIENT_LESIONS} lesions, {seeds} draws (paper, another lung: more than 60 %)\n"
    )
    sys.stdout.write(f"         {_line(rows)}\n")
    distinct = np.array([row["distinct"] for row in rows])
    sys.stdout.write(
        f"distinct circuits {distinct.min():.0f} to {distinct.max():.0f}, median {np.median(distinct):.0f} "
        f"(paper: 45 in its example)\n"
    )
    return {"patient": lung.name, "rows": rows}


def main() -> None:
    """Run the study, print the tables and store the rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("patient", nargs="?")
    parser.add_argument("--models", type=int, default=100)
    parser.add_argument("--lesions", type=int, nargs=2, default=(3, 9), metavar=("FEWEST", "MOST"))
    parser.add_argument("--cache", default=None)
    parser.add_argument("--out", type=Path, default=None)
    options = parser.parse_args()
    rows = study(options.models, *options.lesions)
    show(rows)
    record: dict[str, Any] = {"models": {str(count): of_count for count, of_count in rows.items()}}
    if options.patient:
        record["patient"] = patient_study(options.patient, options.cache)
    if options.out:
        with atomic_write(options.out) as temporary:
            temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()

"""The bronchoscope advisor of Rosell et al. 2012 on segmented lungs: speed, fig. 6, and success by radius.

    python experiments/rosell2012.py DATA [--part speed|fig6|ends] [--seeds 10] [--out FOLDER] [--quick]

DATA holds `med-rad/PatientN` (masks).  Speed: Patient 1 resampled to the paper's voxels, its trachea cut so
that as many voxels are left as the paper has; CPU time, kernels compiled before (set OMP_NUM_THREADS=1).
Fig. 6: the paper's rules, from the trachea to the ends of all airways; a goal is the last voxel before the
end with two voxels more than eq. 1 asks.  Ends: the scope's true radius, by radius, and how often eq. 1 lets
a scope touch the wall.
"""

from __future__ import annotations

import argparse
import csv
import json
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from scipy import ndimage, stats
from scipy.spatial import cKDTree

from anatomy.grid import Grid, Volume
from anatomy.lung import Lung
from lungaccess.patients import load_patient
from stages.scope.advisor import Advisor, start_state
from stages.scope.best_motion import Weights, best_motion
from stages.scope.collision import Scene
from stages.scope.kernels.field import widest_ways
from stages.scope.kinematics import ScopeModel, joints
from stages.scope.lumen import Lumen, lumen_of_lung, lumen_of_mask
from stages.scope.navigation import Goal, goal_at, navigation_field
from stages.scope.path import ScopePath
from stages.scope.retreat import PathSettings

matplotlib.use("Agg")

PAPER_VOXELS = 116_758
PAPER_SPACING_MM = (0.7, 0.7, 0.6)
PAPER_S = {"field": 10.0, "best motion": 0.3, "path": 31.0}
WEIGHTS = {
    "(1, 0, 0)": Weights(nf1=1.0, clearance=0.0, twist=0.0),
    "(0.6, 0.2, 0.2)": Weights(nf1=0.6, clearance=0.2, twist=0.2),
    "(0.4, 0.4, 0.2)": Weights(nf1=0.4, clearance=0.4, twist=0.2),
}
COLOURS = ("tab:red", "tab:green", "tab:blue")
RADII_MM = (0.5, 1.0, 1.5, 2.0, 2.5, 3.1)
REPEATS = 20
NEAR_MM = 10.0
SPARE_MM = 0.25
ROOM_VOXELS = 2
LOOK_AHEAD_MM = 5.0
ARRIVED_MM = 0.5 * LOOK_AHEAD_MM + 0.5
"""By the printed rules a scope stops where its look-ahead goes as far beyond the goal as it is before it."""


def resampled(mask: Volume, spacing_mm: tuple[float, float, float]) -> Volume:
    """Return a mask on a grid of other voxels along the LPS axes: the value at the nearest voxel centre."""
    inside = mask.grid.lps(np.argwhere(mask.array))
    low, high = inside.min(axis=0) - 2.0, inside.max(axis=0) + 2.0
    grid = Grid.from_spacing(np.ceil((high - low) / spacing_mm), spacing_mm, low)
    centres = grid.lps(np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1))
    ijk = np.floor(mask.grid.ijk(centres) + 0.5).astype(np.int64)
    within = ((ijk >= 0) & (ijk < mask.grid.shape)).all(axis=-1)
    array = np.zeros(grid.shape, dtype=bool)
    array[within] = mask.array[tuple(ijk[within].T)]
    return Volume(grid=grid, array=array)


def paper_sized(lung: Lung) -> Lumen:
    """Return a lumen with the paper's voxels: resampled, its trachea cut from above to the paper's count."""
    volume = resampled(lung.mask("lumen"), PAPER_SPACING_MM)
    above = np.cumsum(volume.array.sum(axis=(0, 1))[::-1])[::-1]
    kept = volume.array.copy()
    kept[:, :, int(np.argmin(np.abs(above[0] - above - PAPER_VOXELS))) :] = False
    return lumen_of_mask(Volume(grid=volume.grid, array=kept), lung.tree.carina_lps)


def ends(lung: Lung) -> list[int]:
    """Return the tree points where airways end."""
    return [int(lung.tree.branch_points(int(branch))[-1]) for branch in lung.tree.leaf_branches]


def goal_with_room(lumen: Lumen, lung: Lung, point: int, model: ScopeModel, spare_voxels: int) -> Goal:
    """Return the last voxel before an airway's end with so many voxels of clearance more than eq. 1 asks."""
    end = goal_at(lumen, lung.tree.points_lps[point])
    field = navigation_field(lumen, end.voxel, metric="voxels")
    start, _away = lumen.nearest_voxel(lung.tree.carina_lps)
    width = np.zeros(lumen.count, dtype=np.int64)
    widest_ways(lumen.neighbours, lumen.steps_to_wall.astype(np.int64), start, width)
    roomy = np.flatnonzero(width > model.link_mm / lumen.grid.spacing_mm.max() + spare_voxels)
    voxel = int(roomy[np.argmin(field.potential[roomy])])
    return goal_at(lumen, lumen.centres(voxel), 0.5 * float(lumen.grid.spacing_mm.min()))


def median_s(work: Callable[[], Any], repeats: int) -> float:
    """Return the median time of a piece of work, after one run to warm up."""
    work()
    times = []
    for _ in range(repeats):
        began = time.process_time()
        work()
        times.append(time.process_time() - began)
    return statistics.median(times)


def speed(lung: Lung, repeats: int) -> list[dict[str, Any]]:
    """Measure field, best motion and paths on the paper's number of voxels."""
    lumen = paper_sized(lung)
    print(f"\nSpeed: {lumen.count} voxels of {PAPER_SPACING_MM} mm ({lumen.count / PAPER_VOXELS - 1:+.1%})")
    model, rows = ScopeModel(), []
    state = start_state(lumen, lung.tree, model)
    goals = [goal_with_room(lumen, lung, point, model, ROOM_VOXELS) for point in ends(lung)]
    field_s = median_s(lambda: navigation_field(lumen, goals[0].voxel, metric="voxels"), repeats)
    rows.append({"what": "field", "s": field_s, "worst_s": None})
    for name, reproduction in (("printed rules", True), ("true radius", False)):
        options = PathSettings(retreats=0)
        advisors = [Advisor(lumen, model, goal, options, reproduction=reproduction) for goal in goals]
        found = [advisor.path(state, seed=1) for advisor in advisors]
        paths = [median_s(partial(advisor.path, state, seed=1), max(repeats // 4, 1)) for advisor in advisors]
        motions = [
            median_s(
                partial(best_motion, advisors[n].scene, path.state(number), LOOK_AHEAD_MM, options.weights), 3
            )
            for n, path in enumerate(found)
            for number in range(0, path.count, 20)
        ]
        rows.append(
            {"what": f"best motion, {name}", "s": statistics.median(motions), "worst_s": max(motions)}
        )
        rows.append({"what": f"path, {name}", "s": statistics.median(paths), "worst_s": max(paths)})
        arrived = sum(path.distance_mm <= ARRIVED_MM for path in found)
        print(f"  {name}, no retreats: {arrived} of {len(goals)} within {ARRIVED_MM:g} mm of the goal")
    rows += retried(lumen, lung, repeats)
    for row in rows:
        paper = PAPER_S[row["what"].split(",")[0]]
        worst = "" if row["worst_s"] is None else f", slowest {1e3 * row['worst_s']:.2f} ms"
        ratio = f"paper {paper:g} s: {paper / row['s']:.0f} times"
        print(f"  {row['what']:<38} {1e3 * row['s']:8.3f} ms{worst}; {ratio}")
    return rows


def retried(lumen: Lumen, lung: Lung, repeats: int) -> list[dict[str, Any]]:
    """Measure paths with retreats, by true radius, to the last voxels with a little room to spare."""
    model = ScopeModel(twist_low_deg=-90.0, bend_low_deg=-120.0)
    state = start_state(lumen, lung.tree, model)
    width = lumen.width_from(lumen.nearest_voxel(lung.tree.carina_lps)[0])
    fits = width >= model.radius_mm + SPARE_MM
    goals = set()
    for goal in _goals(lumen, lung):
        field = navigation_field(lumen, goal.voxel)
        goals.add(int(np.flatnonzero(fits)[np.argmin(field.potential[fits])]))
    first, more = [], []
    for voxel in sorted(goals):
        advisor = Advisor(lumen, model, goal_at(lumen, lumen.centres(voxel)))
        path = advisor.path(state, seed=1)
        if path.reached:
            took = median_s(partial(advisor.path, state, seed=1), max(repeats // 4, 1))
            (more if path.retreats else first).append(took)
    print(
        f"  true radius, {SPARE_MM} mm to spare at the goal: {len(first)} of {len(goals)} reached at once, "
        f"{len(more)} more with retreats"
    )
    return [
        {"what": f"path, true radius, reached {how}", "s": statistics.median(times), "worst_s": max(times)}
        for how, times in (("at once", first), ("with retreats", more))
        if times
    ]


def measures(path: ScopePath, scene: Scene, length_mm: float) -> dict[str, float]:
    """Return mean distance (voxels) and change of twist (deg/mm) on the first part of a path, and its end."""
    part = path.states[np.cumsum(path.steps_mm) <= length_mm + 1e-9]
    return {
        "distance": float(scene.distances(part).mean()),
        "twist": float(np.degrees(np.abs(np.diff(part[:, 12])).sum()) / max(length_mm, 1e-9)),
        "arrived": float(path.distance_mm <= ARRIVED_MM),
        "length": path.length_mm,
    }


def fig6(lung: Lung, seeds: int, out: Path) -> dict[str, Any]:
    """Compare the three weights of fig. 6 over all ends and seeds, each on the way that all three went."""
    lumen, model = lumen_of_lung(lung), ScopeModel()
    state = start_state(lumen, lung.tree, model)
    values: dict[str, list[list[dict[str, float]]]] = {name: [] for name in WEIGHTS}
    longest = 0.0
    for point in ends(lung):
        goal = goal_with_room(lumen, lung, point, model, ROOM_VOXELS)
        advisor = Advisor(lumen, model, goal, reproduction=True)
        rows: dict[str, list[dict[str, float]]] = {name: [] for name in WEIGHTS}
        for seed in range(seeds):
            paths = {}
            for name, weights in WEIGHTS.items():
                advisor.options = PathSettings(weights=weights, retreats=0)
                paths[name] = advisor.path(state, seed=seed)
            common = min(path.length_mm for path in paths.values())
            for name, path in paths.items():
                rows[name].append(measures(path, advisor.scene, common))
            if common > longest:
                longest = common
                draw_fig6(paths, advisor.scene, out / f"fig6_{lung.name}.png")
        for name in WEIGHTS:
            values[name].append(rows[name])
    return compare(lung, values)


def compare(lung: Lung, values: dict[str, list[list[dict[str, float]]]]) -> dict[str, Any]:
    """Print medians over ends and paired tests; an airway's end counts once, with the median of its seeds."""
    names = list(values)
    print(f"\nFig. 6, {lung.name}: {len(values[names[0]])} ends, {len(values[names[0]][0])} seeds")
    result: dict[str, Any] = {name: {} for name in names}
    for key in ("distance", "twist", "length"):
        columns = [
            np.array([np.median([run[key] for run in runs]) for runs in values[name]]) for name in names
        ]
        for name, column in zip(names, columns, strict=True):
            result[name][key] = float(np.median(column))
        print(f"  {key:<9}" + "".join(f"{name}: {result[name][key]:.2f}   " for name in names))
        if key in ("distance", "twist"):
            result[f"p_{key}"] = tests(names, columns)
    share = {name: np.mean([[run["arrived"] for run in runs] for runs in values[name]]) for name in names}
    print(
        f"  runs that came within {ARRIVED_MM:g} mm of the goal: "
        + ", ".join(f"{name} {part:.1%}" for name, part in share.items())
    )
    return result


def tests(names: list[str], columns: list[np.ndarray]) -> dict[str, float]:
    """Return and print the p of Friedman's test and of Wilcoxon's signed-rank tests of each pair."""
    found = {"Friedman": float(stats.friedmanchisquare(*columns).pvalue)}
    for a, b in ((0, 1), (0, 2), (1, 2)):
        found[f"{names[a]} - {names[b]}"] = float(stats.wilcoxon(columns[a], columns[b]).pvalue)
    print("    p: " + ", ".join(f"{name} {p:.2g}" for name, p in found.items()))
    return found


def draw_fig6(curves: dict[str, ScopePath], scene: Scene, file: Path) -> None:
    """Draw distance and twist along a path for each set of weights."""
    from matplotlib import pyplot as plt

    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(8, 6))
    for (name, path), colour in zip(curves.items(), COLOURS, strict=True):
        way = np.cumsum(path.steps_mm)
        above.plot(way, scene.distances(path.states), color=colour, label=name)
        below.plot(way, np.degrees(path.states[:, 12]), color=colour)
    above.set_ylabel("distance (sum of clearances, voxels)")
    above.legend(title="weights")
    below.set_ylabel("twist (deg)")
    below.set_xlabel("advance (mm)")
    figure.tight_layout()
    figure.savefig(file, dpi=120)
    plt.close(figure)


class Wall:
    """Exact distances to the voxels around a lumen, by a search tree and nothing of the planner's.

    Looked at are the nearest centres of wall voxels; a box whose centre is not among them is farther away.
    """

    NEAREST = 48
    SPACING_MM = 0.5

    def __init__(self, lumen: Lumen) -> None:
        solid = lumen.index < 0
        near = ndimage.binary_dilation(~solid, np.ones((3, 3, 3))) & solid
        self._grid, self._spacing = lumen.grid, lumen.grid.spacing_mm
        self._centres = np.argwhere(near) * self._spacing
        self._tree = cKDTree(self._centres)

    def distance_mm(self, points_lps: np.ndarray) -> np.ndarray:
        """Return distances `(N,)` to the nearest wall voxel as a box."""
        local = self._grid.ijk(points_lps) * self._spacing
        _, index = self._tree.query(local, k=self.NEAREST)
        gap = np.maximum(np.abs(local[:, None] - self._centres[index]) - 0.5 * self._spacing, 0.0)
        return np.sqrt((gap**2).sum(axis=2)).min(axis=1)

    def room_mm(self, path: ScopePath) -> np.ndarray:
        """Return for every pose by how much its tip, and its share of the shaft, clear the scope's radius."""
        share = np.arange(0.0, 1.0, self.SPACING_MM / path.model.link_mm)[:, None]
        room = np.zeros(path.count)
        chains = joints(path.model, path.states)
        for number in range(path.count):
            ends = zip(chains[number, :-1], chains[number, 1:], strict=True)
            points = [a + share * (b - a) for a, b in ends] + [chains[number, -1:]]
            if number:
                points.append(np.array([path.between(number, f)[9:12] for f in (0.25, 0.5, 0.75)]))
            room[number] = self.distance_mm(np.concatenate(points)).min() - path.model.radius_mm
        return room


def success(lung: Lung, radii: tuple[float, ...], retreats: int) -> list[dict[str, Any]]:
    """Return for every radius how many airway ends are reached, and how near the others are come to."""
    lumen, rows = lumen_of_lung(lung), []
    judge = Wall(lumen)
    fields = [(goal, navigation_field(lumen, goal.voxel)) for goal in _goals(lumen, lung)]
    print(f"\nEnds, {lung.name}: {len(fields)} airways, {lumen.count} voxels")
    for radius in radii:
        model = ScopeModel(radius_mm=radius, twist_low_deg=-90.0, bend_low_deg=-120.0)
        state = start_state(lumen, lung.tree, model)
        fits = lumen.width_from(lumen.nearest_voxel(lung.tree.carina_lps)[0]) >= radius
        reached, far, touching, poses, least, left = 0, 0, 0, 0, np.inf, []
        began = time.process_time()
        for goal, field in fields:
            advisor = Advisor(lumen, model, goal, PathSettings(retreats=retreats))
            path = advisor.path(state, seed=1)
            reached += path.reached
            left.append(path.distance_mm)
            far += path.reached or path.potentials[path.nearest] <= field.potential[fits].min() + 1.0
            room = judge.room_mm(path)
            touching += int((room < 0.0).sum())
            least = min(least, float(room.min()))
            poses += path.count
        rows.append(
            {
                "radius_mm": radius,
                "ends": len(fields),
                "reached": reached,
                "near": int((np.array(left) <= NEAR_MM).sum()),
                "as_far_as_a_ball": int(far),
                "median_left_mm": float(np.median(left)),
                "touching_poses": touching,
                "least_room_mm": least,
                "poses": poses,
                "s_per_end": (time.process_time() - began) / len(fields),
            }
        )
        print("  " + ", ".join(f"{key} {value:.3g}" for key, value in rows[-1].items()))
    return rows


def touching(lung: Lung, seeds: int) -> dict[str, Any]:
    """Return how many poses of paths by the printed rules bring the scope of radius l into the wall."""
    lumen, model = lumen_of_lung(lung), ScopeModel()
    state = start_state(lumen, lung.tree, model)
    poses = touched = violating = paths_touched = paths = 0
    for point in ends(lung):
        goal = goal_with_room(lumen, lung, point, model, 0)
        advisor = Advisor(lumen, model, goal, PathSettings(retreats=0), reproduction=True)
        strict = Scene(model=model, field=advisor.field)
        for seed in range(seeds):
            path = advisor.path(state, seed=seed)
            wrong = ~strict.fits(path.states)
            poses += path.count
            touched += int(wrong.sum())
            violating += int((~advisor.scene.fits(path.states)).sum())
            paths_touched += bool(wrong.any())
            paths += 1
    print(
        f"  eq. 1, scope of {2 * model.link_mm:g} mm: {touched} of {poses} poses touch the wall "
        f"({touched / poses:.1%}), in {paths_touched} of {paths} paths; {violating} poses violate eq. 1"
    )
    return {
        "poses": poses,
        "touching": touched,
        "violating": violating,
        "paths": paths,
        "paths_touching": paths_touched,
    }


def _goals(lumen: Lumen, lung: Lung) -> list[Goal]:
    return [goal_at(lumen, lung.tree.points_lps[point]) for point in ends(lung)]


def main() -> None:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--part", choices=("speed", "fig6", "ends", "all"), default="all")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--out", type=Path, default=Path("rosell2012"))
    parser.add_argument("--quick", action="store_true", help="one patient, two seeds, three radii")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    seeds = 2 if given.quick else given.seeds
    radii = (1.0, 1.5, 2.0) if given.quick else RADII_MM
    results: dict[str, Any] = {}
    for name in ("Patient1",) if given.quick else ("Patient1", "Patient2"):
        lung = load_patient(given.data / "med-rad" / name)
        results[name] = {}
        if given.part in ("speed", "all") and name == "Patient1":
            results[name]["speed"] = speed(lung, REPEATS)
        if given.part in ("fig6", "all"):
            results[name]["fig6"] = fig6(lung, seeds, given.out)
        if given.part in ("ends", "all"):
            rows = success(lung, radii, PathSettings().retreats)
            results[name]["ends"], results[name]["eq1"] = rows, touching(lung, seeds)
            with (given.out / f"ends_{name}.csv").open("w", newline="") as file:
                writer = csv.DictWriter(file, list(rows[0]))
                writer.writeheader()
                writer.writerows(rows)
    (given.out / f"{given.part}.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()

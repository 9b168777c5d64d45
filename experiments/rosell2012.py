"""The bronchoscope advisor of [Rosell2012] on segmented lungs: speed, fig. 6, and how deep a true scope gets.

    python -m experiments.rosell2012 [--quick] [--seed 1] [--results FOLDER] [--patients NAME ...]

Speed: the first patient resampled to the paper's voxels, its trachea cut so that as many voxels are left as
the paper has; CPU time, kernels compiled before.  Fig. 6: the paper's rules, from the trachea to the ends of
all airways; a goal is the last voxel before the end with two voxels more than eq. 1 asks.  Ends: the scope's
true radius, and how often eq. 1 lets a scope touch the wall.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy import stats

from anatomy.lung import Lung
from experiments.support.anatomies import anatomy, default_anatomies
from experiments.support.results import Result, setting_of, study_parser, write_result
from experiments.support.scope.ends import NEAR_MM, success, touching
from experiments.support.scope.goals import PAPER_SPACING_MM, ends, goal_with_clearance
from experiments.support.scope.speed import ARRIVED_MM, SPARE_VOXELS, measure_speed
from lungaccess.showing.report import style
from stages.scope.advisor.advisor import Advisor, PathSettings, start_state
from stages.scope.advisor.best_motion import Weights
from stages.scope.advisor.environment import ScopeEnvironment
from stages.scope.advisor.kinematics import ScopeModel
from stages.scope.advisor.lumen import lumen_of_lung
from stages.scope.advisor.path import ScopePath

WEIGHTS = {
    "(1, 0, 0)": Weights(nf1=1.0, clearance=0.0, twist=0.0),
    "(0.6, 0.2, 0.2)": Weights(nf1=0.6, clearance=0.2, twist=0.2),
    "(0.4, 0.4, 0.2)": Weights(nf1=0.4, clearance=0.4, twist=0.2),
}
COLOURS = (style.VESSEL, style.NODULE, style.SCOPE)
RADII_MM = (0.5, 1.0, 1.5, 2.0, 2.5, 3.1)
QUICK_RADII_MM = (1.0, 2.0)
REPEATS = 20
MEASURES = {"distance": "mean distance, voxels", "twist": "change of twist, deg/mm"}
NOT_REPRODUCED = [
    "The curves of fig. 6 themselves: the paper prints no numbers for them and its CT cannot be had.  "
    "What it says of them is tested on all ends of our airways instead.",
    "The three lesions and the haptic guidance of figs. 7 and 8.",
]

Curves = tuple[dict[str, ScopePath], ScopeEnvironment | None]
Values = dict[str, list[dict[str, float]]]


def measures(path: ScopePath, environment: ScopeEnvironment, length_mm: float) -> dict[str, float]:
    """Return mean distance (voxels) and change of twist (deg/mm) on the first part of a path, and its end."""
    part = path.states[np.cumsum(path.steps_mm) <= length_mm + 1e-9]
    return {
        "distance": float(environment.distances(part).mean()),
        "twist": float(np.degrees(np.abs(np.diff(part[:, 12])).sum()) / max(length_mm, 1e-9)),
        "arrived": float(path.distance_mm <= ARRIVED_MM),
    }


def compare_weights(lung: Lung, seeds: list[int]) -> tuple[Values, Curves]:
    """Run the three weights of fig. 6 to all ends, each measured over the length that all three went.

    Returns for each end the median over the seeds, and the curves of the longest common length.
    """
    lumen, model = lumen_of_lung(lung), ScopeModel()
    state = start_state(lumen, lung.tree, model)
    values: Values = {name: [] for name in WEIGHTS}
    longest, curves = -1.0, ({}, None)
    for point in ends(lung):
        goal = goal_with_clearance(lumen, lung, point, model, SPARE_VOXELS)
        advisor = Advisor(lumen, model, goal, reproduction=True)
        runs: Values = {name: [] for name in WEIGHTS}
        for seed in seeds:
            paths = {}
            for name, weights in WEIGHTS.items():
                advisor.options = PathSettings(weights=weights, retreats=0)
                paths[name] = advisor.path(state, seed=seed)
            common = min(path.length_mm for path in paths.values())
            for name, path in paths.items():
                runs[name].append(measures(path, advisor.environment, common))
            if common > longest:
                longest, curves = common, (paths, advisor.environment)
        for name, of_seeds in runs.items():
            middle = {key: float(np.median([run[key] for run in of_seeds])) for key in MEASURES}
            values[name].append({**middle, "arrived": float(np.mean([run["arrived"] for run in of_seeds]))})
    return values, curves


def add_weights(result: Result, lung: Lung, values: Values) -> None:
    """Add a row for each weight and measure, with paired tests over the ends."""
    names = list(values)
    for key, words in MEASURES.items():
        columns = [np.array([run[key] for run in values[name]]) for name in names]
        every = stats.friedmanchisquare(*columns).pvalue
        for name, column in zip(names, columns, strict=True):
            note = f"{len(column)} ends; Friedman p = {every:.1g}"
            if name != names[0]:
                pair = stats.wilcoxon(columns[0], column).pvalue
                note = f"against (1, 0, 0): Wilcoxon p = {pair:.1g}"
            label = f"fig. 6, {lung.name}, weights {name}: {words.partition(', ')[0]}"
            result.add(label, float(np.median(column)), unit=words.partition(", ")[2], note=note)
        for name, column in zip(names[1:], columns[1:], strict=True):
            if (np.median(column) > np.median(columns[0])) == (key == "twist"):
                less = "Fewer changes of twist" if key == "twist" else "More clearance"
                result.not_reproduced.append(f"{less} by weights {name} on {lung.name}: see the table.")
    for name in names:
        share = 100.0 * float(np.mean([run["arrived"] for run in values[name]]))
        label = f"fig. 6, {lung.name}, weights {name}: within {ARRIVED_MM:g} mm of the goal"
        result.add(label, share, unit="%")


def add_ends(result: Result, lung: Lung, radii: tuple[float, ...], seeds: list[int]) -> None:
    """Add how deep true scopes get, and how often the paper's rule lets one touch the wall."""
    for row in success(lung, radii, PathSettings().retreats):
        result.add(
            f"{lung.name}, scope of {2.0 * row['radius_mm']:g} mm: gets as deep as a ball of its radius",
            100.0 * row["as_far_as_a_ball"] / row["ends"], unit="%",
            note=f"{row['ends']} ends: {row['reached']} reached, {row['near']} within {NEAR_MM:g} mm, median "
            f"{row['median_left_mm']:.1f} mm left; {row['touching_poses']} of {row['poses']} poses touch; "
            f"{row['s_per_end']:.2f} s an end",
        )  # fmt: skip
    found = touching(lung, seeds)
    result.add(
        f"{lung.name}, printed rules: poses that touch the wall", 100.0 * found["touching"] / found["poses"],
        unit="%", note=f"of {found['poses']} poses, in {found['paths_touching']} of {found['paths']} paths; "
        f"{found['violating']} violate eq. 1",
    )  # fmt: skip


def draw_fig6(curves: Curves) -> Figure:
    """Draw distance and twist along a path for each set of weights, as in fig. 6."""
    paths, environment = curves
    figure = style.new_figure(8.0, 5.6)
    above, below = figure.subplots(2, 1, sharex=True)
    for (name, path), colour in zip(paths.items(), COLOURS, strict=True):
        arc_length_mm = np.cumsum(path.steps_mm)
        above.plot(arc_length_mm, environment.distances(path.states), color=colour, label=name)
        below.plot(arc_length_mm, np.degrees(path.states[:, 12]), color=colour)
    above.set_ylabel("distance (sum of clearances, voxels)")
    above.legend(title="weights NF1, clearance, twist", frameon=False, fontsize=9)
    below.set(ylabel="twist (deg)", xlabel="advance (mm)")
    for axes in (above, below):
        axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    return figure


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--patients", nargs="+", metavar="NAME", help="default: all; --quick: the first")
    options = parser.parse_args()
    names = options.patients or default_anatomies()[: 1 if options.quick else None]
    count, radii = (2, QUICK_RADII_MM) if options.quick else (10, RADII_MM)
    result = Result(
        name="rosell2012", title="Bronchoscope advisor", setting=setting_of(options),
        source="Rosell et al. 2012, section VI and fig. 6", not_reproduced=NOT_REPRODUCED,
        seeds=list(range(options.seed, options.seed + count)),
        conditions={
            "speed": f"first anatomy resampled to {' x '.join(map(str, PAPER_SPACING_MM))} mm, trachea cut "
            "to the paper's number of voxels; CPU seconds of one core, kernels compiled before, median",
            "fig. 6": "printed rules, all airway ends, median of the seeds, over the length that all three "
            "weights went; look-ahead 5 mm, sub-step 1 mm",
            "ends": "chain of 10 mm, bends of 120 degrees and twists of 90 degrees to either side",
        },
    )  # fmt: skip
    for number, name in enumerate(names):
        lung = anatomy(name)
        result.conditions[f"anatomy {number + 1}"] = lung.name
        if number == 0:
            measure_speed(result, lung, REPEATS)
        values, curves = compare_weights(lung, result.seeds)
        add_weights(result, lung, values)
        if number == 0:
            result.figure = draw_fig6(curves)
        add_ends(result, lung, radii, result.seeds)
    write_result(result, options.results)


if __name__ == "__main__":
    main()

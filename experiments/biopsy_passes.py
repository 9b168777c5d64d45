"""Several passes planned together, by size of the nodule and tool, and counted by brute force.

    python -m experiments.biopsy_passes [--quick] [--results FOLDER] [--procedure open-loop] [--tools core]
        [--places 1] [--lungs 3 Patient1] [--sizes 8] [--picture FILE]

Nodules are drawn at peripheral targets: balls, and lumps whose radius varies by a quarter.  Of each, one pass
at the centre, three passes at the same point, and three planned together are counted by the same draws, which
no search saw, under `breath-hold`.  In open loop, draws of another seed are counted voxel by voxel, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

import lungaccess as la
from anatomy.base.errors import LungaccessError
from anatomy.base.typed import Bool, Float
from anatomy.build import build_lung
from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.phantom import make_phantom
from experiments.support.anatomies import anatomy
from experiments.support.results import Result, setting_of, small_png, study_parser, write_result
from lungaccess.judging.checking import check
from lungaccess.planning.one_system import run
from lungaccess.planning.success.estimate import estimate_success
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.procedures import load_procedure
from lungaccess.problem.request import Request
from lungaccess.problem.system import with_tool
from lungaccess.problem.tools import load_tool
from lungaccess.uncertainty.risk.assessor import RiskAssessor
from lungaccess.uncertainty.risk.statistics import share_of

SIZES_MM = (6.0, 8.0, 12.0, 20.0, 30.0)
SYSTEM, PASSES, SEED = "ultrathin", 3, 5
BRUTE_DRAWS, DRAWS = 100_000, 20_000
STEP_MM = 0.1


def with_nodule(lung: Lung, centre: Float, diameter_mm: float, rng: np.random.Generator | None) -> Lung:
    """Return a lung whose one nodule is a ball, or with random numbers a lump."""
    grid = lung.grid
    reach = np.ceil(diameter_mm / grid.spacing_mm).astype(int)
    low = np.maximum(grid.voxels(centre) - reach, 0)
    high = np.minimum(grid.voxels(centre) + reach + 1, grid.shape)
    voxels = np.argwhere(np.ones(high - low, dtype=bool)) + low
    points = grid.lps(voxels) - centre
    away = np.linalg.norm(points, axis=1)
    radius = np.full(len(away), 0.5 * diameter_mm)
    if rng is not None:
        ways = rng.normal(size=(6, 3))
        ways /= np.linalg.norm(ways, axis=1, keepdims=True)
        lobes = np.exp(4.0 * (points @ ways.T / np.maximum(away, 1e-9)[:, None] - 1.0)).max(axis=1)
        radius *= 0.75 + 0.5 * lobes
    inside = np.zeros(grid.shape, dtype=bool)
    inside[tuple(voxels[away <= radius].T)] = True
    return replace(lung, nodules=Volume(grid=grid, array=inside))


def brute(plan: Plan, lung: Lung, draws: int, seed: int) -> Bool:
    """Return which draws succeed `(N,)`, by the voxels in which points of the tool's axis lie."""
    tool, model = plan.system.tool, load_errors()
    whole = RiskAssessor(plan, lung)
    errors = whole.draws(draws, seed).deviations(model)
    total, clear = np.zeros(draws), np.ones(draws, dtype=bool)
    along = np.arange(tool.from_tip_mm + 0.5 * STEP_MM, tool.to_tip_mm, STEP_MM)
    for one, own in zip(plan.passes, (errors, *errors.further), strict=True):
        found = RiskAssessor(one, lung)
        outcomes = found.outcomes(replace(own, further=()))
        clear &= found.touches_nothing(outcomes.touched)
        for part in np.array_split(np.arange(draws), max(1, draws // 2000)):
            ends = outcomes.ends[part] if len(outcomes.ends) else outcomes.ends
            points = ends[:, None, :3] + along[:, None] * ends[:, None, 3:6] - own.target_mm[part, None]
            inside = lung.nodules.at(points.reshape(-1, 3), False).reshape(len(part), -1)
            total[part] += STEP_MM * inside.sum(axis=1)
    return clear & (total >= tool.least - 0.5 * STEP_MM)


def planned(lung: Lung, atlas: la.Atlas, centre: Float, tool: str, procedure: str, passes: int) -> Plan:
    """Return the plan for success with so many passes at most."""
    request = Request.of(
        lung, with_tool(la.load_system(SYSTEM), load_tool(tool)), la.point_target(lung, centre),
        passes=passes, procedure=load_procedure(procedure), iterations=0, seed=SEED,
    )  # fmt: skip
    return list(run(request, atlas=atlas, counterfactuals=False))[-1]


def cases(names: Sequence[str], places: int) -> Iterator[tuple[str, Lung, la.Atlas, Float]]:
    """Yield lungs with peripheral places; a name is the seed of a phantom, or a patient of the data."""
    for name in names:
        made = make_phantom(seed=int(name), size="small") if name.isdigit() else None
        lung = anatomy(name) if made is None else build_lung(made.images)
        atlas = la.build_atlas(lung, la.load_system(SYSTEM))
        drawn = (
            each for each in la.peripheral_targets(lung, 10 * places, SEED) if reached(lung, atlas, each)
        )
        for number, centre in enumerate(islice(drawn, places)):
            yield f"{name}, place {number}", lung, atlas, centre


def reached(lung: Lung, atlas: la.Atlas, centre: Float) -> bool:
    """Tell whether a plan of the core needle to the middle of a nodule of 12 mm is found."""
    try:
        planned(with_nodule(lung, centre, 12.0, None), atlas, centre, "core", "open-loop", 1)
    except (NoPlan, LungaccessError):
        return False
    return True


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--procedure", default="open-loop")
    parser.add_argument("--tools", nargs="+", default=["core"])
    parser.add_argument("--places", type=int, default=1)
    parser.add_argument("--lungs", nargs="+", default=["3", "21", "8"])
    parser.add_argument("--sizes", type=float, nargs="+", default=SIZES_MM)
    parser.add_argument("--picture", default="")
    options = parser.parse_args()
    name = f"biopsy_passes_{options.procedure}"
    result = Result(
        name=name, title=f"Passes planned together, {options.procedure}", setting=setting_of(options),
        seeds=[SEED], conditions={"errors": "breath-hold", "system": SYSTEM},
    )  # fmt: skip
    samples = DRAWS if options.procedure == "open-loop" else 1000
    shares: dict[tuple[str, float], list[list[float]]] = {}
    within = []
    for where, lung, atlas, centre in cases(options.lungs[: 1 if options.quick else None], options.places):
        for tool in options.tools:
            for number, size in enumerate(options.sizes):
                rng = np.random.default_rng(number) if number % 2 else None
                drawn = with_nodule(lung, centre, size, rng)
                case = f"{where}, {size:g} mm {'lump' if number % 2 else 'ball'}, {tool}"
                try:
                    one = planned(drawn, atlas, centre, tool, options.procedure, 1)
                    several = planned(drawn, atlas, centre, tool, options.procedure, PASSES)
                except (NoPlan, LungaccessError) as reason:
                    print(case, "no plan", str(reason)[:80], flush=True)
                    continue
                plans = (one, one.with_further([one] * (PASSES - 1)), several)
                accepted = all(check(each, drawn).accepted for each in plans)
                counted = [
                    estimate_success(
                        each, drawn, errors=load_errors(), procedure=load_procedure(options.procedure),
                        samples=samples, seed=SEED + 99,
                    ).succeeds
                    for each in plans
                ]  # fmt: skip
                shares.setdefault((tool, size), []).append([each.value for each in counted])
                truth = ""
                if options.procedure == "open-loop" and load_tool(tool).unit == "mm":
                    for each, share in zip(plans, counted, strict=True):
                        low, high = share.interval
                        counts = share_of(brute(each, drawn, BRUTE_DRAWS, SEED + 7))
                        within.append(low <= counts.value <= high)
                        truth += f" {counts.value:.3f} in {low:.3f}-{high:.3f}"
                words = " ".join(f"{each.value:.3f}" for each in counted)
                print(
                    case, len(several.passes), "accepted" if accepted else "REFUSED", words, truth, flush=True
                )
                note = f"one {counted[0].value:.3f}, three at one point {counted[1].value:.3f}"
                result.add(f"{case}: chance of three together", counted[2].value, note=note)
    every = np.array([each for rows in shares.values() for each in rows])
    gains = 100.0 * (every[:, 2:] - every[:, :2])
    for column, other in enumerate(("one pass", "three at one point")):
        gain = gains[:, column]
        note = f"least {gain.min():.1f}, {len(gain)} nodules"
        result.add(f"points gained on {other}, mean", float(gain.mean()), note=note)
        print(other, gain.mean(), gain.min(), flush=True)
    if within:
        result.add("brute force within the interval", float(np.mean(within)), note=f"{len(within)} plans")
        print("within", np.mean(within), len(within))
    if options.picture:
        draw(shares, options.picture)
    print(write_result(result, options.results))


def draw(shares: dict[tuple[str, float], list[list[float]]], path: str) -> None:
    """Draw the mean chance by size, of one pass and of several, for each tool."""
    from pathlib import Path

    from matplotlib.figure import Figure

    tools = sorted({tool for tool, _size in shares})
    figure = Figure(figsize=(4.0 * len(tools), 3.4), layout="constrained")
    for axes, tool in zip(np.atleast_1d(figure.subplots(1, len(tools), sharey=True)), tools, strict=True):
        sizes = sorted(size for own, size in shares if own == tool)
        means = 100.0 * np.array([np.mean(shares[tool, size], axis=0) for size in sizes])
        for mean, style, label in zip(
            means.T, ("o:", "s--", "D-"), ("one pass", "three at one point", "three together"), strict=True
        ):
            axes.plot(sizes, mean, style, label=label)
        axes.set(title=tool, xlabel="size of the nodule, mm", ylim=(0.0, 100.0))
    np.atleast_1d(figure.axes)[0].set_ylabel("enough tissue, of 100")
    np.atleast_1d(figure.axes)[0].legend(frameon=False)
    Path(path).write_bytes(small_png(figure))


if __name__ == "__main__":
    main()

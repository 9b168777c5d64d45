"""Several passes planned together, by size of the nodule and tool, and counted by brute force.

    python -m experiments.biopsy_passes [--quick] [--results FOLDER] [--procedure open-loop] [--tools core]
        [--errors breath-hold] [--nodules 60] [--lungs 8 Patient1] [--sizes 8]

Nodules are drawn at peripheral targets that a single arc reaches: balls, and lumps whose radius varies by a
quarter.  Of each, one pass at the centre, three passes at the same point, and three planned together are
counted by the same draws, which no search saw.  In open loop, draws of another seed are counted voxel by
voxel in every third nodule.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

import lungaccess as la
from anatomy.base.errors import LungaccessError
from anatomy.base.typed import Bool, Float
from anatomy.build import build_lung
from anatomy.grid import Volume
from anatomy.lung import Lung
from anatomy.phantom import make_phantom
from experiments.support.anatomies import anatomy
from experiments.support.results import Result, setting_of, study_parser, write_result
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
from lungaccess.uncertainty.risk.patient_errors import model_for
from lungaccess.uncertainty.risk.statistics import share_of
from stages.needle import direct_arcs, needle_environment

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def brute(plan: Plan, lung: Lung, model: la.ErrorModel, draws: int, seed: int) -> Bool:
    """Return which draws succeed `(N,)`, by the voxels in which points of the tool's axis lie."""
    tool, nodules, model = plan.system.tool, lung.nodules, model_for(model, plan, lung)
    if tool is None or nodules is None:
        raise ValueError("Voxels of a nodule are counted in a tool: the plan has none, or the lung has none")
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
            inside = nodules.at(points.reshape(-1, 3), False).reshape(len(part), -1)
            total[part] += STEP_MM * inside.sum(axis=1)
    return clear & (total >= tool.least - 0.5 * STEP_MM)


def lungs_of(names: Sequence[str]) -> Iterator[tuple[str, Lung]]:
    """Yield lungs with their names: a name is the seed of a phantom, or a patient of the data."""
    for name in names:
        yield (
            (f"phantom {name}", build_lung(make_phantom(seed=int(name), size="small").images))
            if name.isdigit()
            else (name, anatomy(name))
        )


def cases(
    names: Sequence[str], nodules: int, sizes: Sequence[float]
) -> Iterator[tuple[str, float, Lung, la.Atlas]]:
    """Yield nodules drawn at peripheral places, lung by lung in turn: name, size, lung with it, and atlas."""
    there = [(name, lung, la.build_atlas(lung, la.load_system(SYSTEM))) for name, lung in lungs_of(names)]
    places = [reached_places(atlas, nodules) for _name, _lung, atlas in there]
    for number in range(nodules):
        size, solid = sizes[number % len(sizes)], number // len(sizes) % 2 == 0
        for (name, lung, atlas), centres in zip(there, places, strict=True):
            if number >= len(centres):
                continue
            rng = None if solid else np.random.default_rng(number)
            case = f"{name}, {size:g} mm {'ball' if solid else 'lump'} {number + 1}"
            yield case, size, with_nodule(lung, centres[number], size, rng), atlas


def reached_places(atlas: la.Atlas, count: int) -> list[Float]:
    """Return peripheral points that a single arc reaches that is proved clear."""
    entries, system, found = atlas.deployments, la.load_system(SYSTEM), list[Float]()
    environment = needle_environment(
        atlas.lung, system.require_needle("A place"), system.margins, with_fissures=atlas.with_fissures
    )
    for target in la.peripheral_targets(atlas.lung, 10 * count, SEED):
        near, _lengths = atlas.index.holding(environment, target)
        at = entries.positions[near], entries.tangents[near], entries.branch[near]
        if len(found) < count and (direct_arcs(environment, *at, target)[0] == 0).any():
            found.append(target)
    return found


def main() -> None:
    """Run the study and store its result, anew after every nodule."""
    parser = study_parser(__doc__)
    parser.add_argument("--procedure", default="open-loop")
    parser.add_argument("--errors", nargs="+", default=["breath-hold", "expiratory-free"])
    parser.add_argument("--tools", nargs="+", default=["core"])
    parser.add_argument("--nodules", type=int, default=60, help="nodules a lung (default: %(default)s)")
    parser.add_argument("--lungs", nargs="+", default=["8", "11", "14", "Patient1"])
    parser.add_argument("--sizes", type=float, nargs="+", default=SIZES_MM)
    options = parser.parse_args()
    nodules = 5 if options.quick else options.nodules
    lungs = options.lungs[: 1 if options.quick else None]
    result = Result(
        name=f"biopsy_passes_{options.procedure}", title=f"Passes planned together, {options.procedure}",
        setting=setting_of(options), seeds=[SEED],
        conditions={"system": SYSTEM, "lungs": ", ".join(lungs), "nodules": "drawn at peripheral places"},
    )  # fmt: skip
    counted = Counted(options.procedure, with_brute=options.procedure == "open-loop")
    for number, (case, size, lung, atlas) in enumerate(cases(lungs, nodules, options.sizes)):
        for errors in options.errors:
            for tool in options.tools:
                counted.add(
                    f"{case}, {tool}, {errors}", (errors, tool, size), lung, atlas, brutally=number % 3 == 0
                )
        counted.fill(result)
        write_result(result, options.results)


class Counted:
    """What was counted so far: chances by errors, tool and size.

    Each nodule has three numbers: how often one pass, three at its point and three planned together succeed.
    In open loop it has two more: how often the first two touch nothing forbidden, which is the most that they
    can succeed.
    """

    def __init__(self, procedure: str, *, with_brute: bool) -> None:
        self.procedure, self._with_brute = load_procedure(procedure), with_brute
        self.samples = DRAWS if self.procedure.is_open_loop else 1000
        self.shares: dict[tuple[str, str, float], list[list[float]]] = {}
        self.within: list[bool] = []
        self.accepted: list[bool] = []
        self.none = 0

    def add(
        self, case: str, key: tuple[str, str, float], lung: Lung, atlas: la.Atlas, *, brutally: bool
    ) -> None:
        """Plan for a nodule, and count."""
        model, tool = load_errors(key[0]), load_tool(key[1])
        target = la.resolve_target(lung, nodule=1)
        found = []
        try:
            for passes in (1, PASSES):
                request = Request.of(
                    lung, with_tool(la.load_system(SYSTEM), tool), target, passes=passes, errors=model,
                    procedure=self.procedure, iterations=0, seed=SEED,
                )  # fmt: skip
                found.append(list(run(request, atlas=atlas, counterfactuals=False))[-1])
        except (NoPlan, LungaccessError) as reason:
            self.none += 1
            print(case, "no plan:", str(reason)[:80], flush=True)
            return
        one, several = found
        plans = (one, one.with_further([one] * (PASSES - 1)), several)
        self.accepted.append(check(several, lung).accepted)
        estimates = [
            estimate_success(
                each, lung, errors=model, procedure=self.procedure, samples=self.samples, seed=SEED + 99
            )
            for each in plans
        ]
        shares = [each.succeeds.value for each in estimates]
        shares += (
            [touches_nothing(each, lung, model) for each in plans[:2]] if self.procedure.is_open_loop else []
        )
        self.shares.setdefault(key, []).append(shares)
        truth = ""
        if brutally and self._with_brute and tool.unit == "mm":
            low, high = estimates[-1].succeeds.interval
            counts = share_of(brute(several, lung, model, BRUTE_DRAWS, SEED + 7))
            self.within.append(low <= counts.value <= high)
            truth = f"brute {counts.value:.4f} in {low:.4f} to {high:.4f}"
        words = " ".join(f"{each:.3f}" for each in shares)
        print(case, len(several.passes), words, truth, "" if self.accepted[-1] else "REFUSED", flush=True)

    def fill(self, result: Result) -> None:
        """Fill the table and the figure of a result."""
        result.rows = []
        for errors in sorted({key[0] for key in self.shares}):
            own = {key: np.array(rows) for key, rows in self.shares.items() if key[0] == errors}
            _add_gains(result, errors, np.concatenate(list(own.values())))
            for (_errors, tool, size), rows in sorted(own.items()):
                mean = 100.0 * rows.mean(axis=0)
                note = f"one {mean[0]:.1f}, three at one point {mean[1]:.1f}; {len(rows)} nodules"
                quantity = f"{errors}, {tool}, {size:g} mm: three together"
                result.add(quantity, float(mean[2]), unit="%", note=note)
        result.add("nodules without a plan", float(self.none))
        refused = len(self.accepted) - sum(self.accepted)
        result.add("plans refused by the check", float(refused), note=f"of {len(self.accepted)}")
        if self.within:
            note = f"{sum(self.within)} of {len(self.within)} plans, {BRUTE_DRAWS:,} draws"
            share = 100.0 * float(np.mean(self.within))
            result.add("brute force within the interval", share, unit="%", note=note)
        result.figure = self.figure() if self.shares else None

    def figure(self) -> Figure:
        """Return the mean chance by size, of one pass and of several, for each tool and errors."""
        from matplotlib.figure import Figure

        panels = sorted({key[:2] for key in self.shares})
        figure = Figure(figsize=(4.0 * len(panels), 3.4), layout="constrained")
        every = np.atleast_1d(figure.subplots(1, len(panels), sharey=True))
        for axes, panel in zip(every, panels, strict=True):
            sizes = sorted(key[2] for key in self.shares if key[:2] == panel)
            means = 100.0 * np.array([np.mean(self.shares[(*panel, size)], axis=0)[:3] for size in sizes])
            styles = (("o:", "one pass"), ("s--", "three at one point"), ("D-", "three together"))
            for mean, (style, label) in zip(means.T, styles, strict=True):
                axes.plot(sizes, mean, style, label=label)
            axes.set(title=", ".join(panel), xlabel="size of the nodule, mm", ylim=(0.0, 100.0))
        every[0].set_ylabel("enough tissue, of 100")
        every[0].legend(frameon=False)
        return figure


def _add_gains(result: Result, errors: str, every: Float) -> None:
    """Add how much three passes together gain, and how much there is to gain."""
    for column, other in enumerate(("one pass", "three at one point")):
        gain = 100.0 * (every[:, 2] - every[:, column])
        note = f"least {gain.min():.1f}, most {gain.max():.1f}, {len(gain)} nodules"
        result.add(f"{errors}: points gained on {other}, mean", float(gain.mean()), note=note)
    if every.shape[1] > 3:
        left = 100.0 * (every[:, 3] - every[:, 1])
        note = "how often one pass touches nothing, less how often three at one point succeed"
        result.add(f"{errors}: points left above three at one point, mean", float(left.mean()), note=note)


def touches_nothing(plan: Plan, lung: Lung, model: la.ErrorModel) -> float:
    """Return how often a plan touches nothing forbidden as it stands."""
    assessor = RiskAssessor(plan, lung)
    found = assessor.outcomes(assessor.draws(5000, SEED + 99).deviations(model))
    return float(assessor.touches_nothing(found.touched).mean())


if __name__ == "__main__":
    main()

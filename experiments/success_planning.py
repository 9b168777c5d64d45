"""Planning for success against planning for least cost, under every error model, open loop and measured.

    python -m experiments.success_planning [--quick] [--seed 1] [--results FOLDER] [--patient NAME]
        [--system NAME]

Random peripheral targets are planned for with the goals of the default cost and of success, for each error
model that ships and the procedures `open-loop` and `measured-tip`.  Both plans are then counted on
the same draws, which neither search has seen.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

import lungaccess as la
from anatomy.base.records import frozen_value
from anatomy.lung import Lung
from experiments.procedures import ITERATIONS, plans_of
from experiments.support.anatomies import anatomy, default_anatomies
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.planning.success import estimate_success
from lungaccess.problem.error_files import error_preset_names, load_errors
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.procedures import Procedure, load_procedure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PROCEDURES = ("open-loop", "measured-tip")
TARGETS = {"quick": (3, 2), "full": (20, 6)}
"""Targets of each procedure: one that measures takes a thousand times as long."""
VARIATIONS = {"quick": (5, 0), "full": (60, 10)}
"""What the search for success tries after its pool."""
DRAWS = {"quick": (10_000, 60), "full": (10_000, 300)}
"""A share of one half is then known to 1 % open loop, and measured to 13 or 6 %."""
COUNT_SEED = 3 << 20
"""Added to the seed for the draws of the comparison, which no search sees."""
COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D81B60", "#785EF0", "#000000")


@frozen_value
class Pair:
    """The chances of two plans to one target on the same draws, and the CPU time of the second search."""

    cost: float
    success: float
    cpu_s: float


def compare(
    plan: la.Plan,
    lung: Lung,
    atlas: la.Atlas,
    errors: ErrorModel,
    procedure: Procedure,
    size: tuple[int, int],
    seed: int,
) -> Pair:
    """Plan for success to the target of a plan of least cost, with its seed, and count both.

    Args:
        size: Variations of the search, and draws of the comparison.
        seed: Of the comparison.
    """
    variations, draws = size
    target, began = la.point_target(lung, plan.target_lps), time.process_time()
    *_, best = la.plan(
        lung, plan.system, target, goal="success", errors=errors, procedure=procedure, seed=plan.seed,
        iterations=variations, atlas=atlas,
    )  # fmt: skip
    cpu_s = time.process_time() - began
    cost, success = (
        estimate_success(
            each, lung, errors=errors, procedure=procedure, samples=draws, seed=seed + COUNT_SEED
        ).succeeds.value
        for each in (plan, best)
    )
    return Pair(cost=cost, success=success, cpu_s=cpu_s)


def add_rows(result: Result, name: str, pairs: list[Pair]) -> None:
    """Add the medians of both, and how much the search for success gains or loses."""
    cost, success, cpu_s = (
        np.array([getattr(each, field) for each in pairs]) for field in ("cost", "success", "cpu_s")
    )
    gain = 100.0 * (success - cost)
    result.add(
        f"{name}: success planned for, median", 100.0 * float(np.median(success)), unit="%",
        note=f"least cost {100.0 * np.median(cost):.0f} %; difference least {gain.min():+.1f}, median "
        f"{np.median(gain):+.1f}, greatest {gain.max():+.1f} points; {len(pairs)} targets; "
        f"{np.median(cpu_s):.1f} s of CPU time a search",
    )  # fmt: skip


def drawn(found: dict[tuple[str, str], list[Pair]]) -> Figure:
    """Return a picture: each target by the chance of both plans, one panel a procedure."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 4.6), layout="constrained")
    for axes, procedure in zip(figure.subplots(1, len(PROCEDURES)), PROCEDURES, strict=True):
        axes.plot((0, 100), (0, 100), color="0.6", linewidth=1)
        for errors, colour in zip(error_preset_names(), COLOURS, strict=True):
            pairs = found[errors, procedure]
            x, y = ([100.0 * getattr(each, field) for each in pairs] for field in ("cost", "success"))
            axes.scatter(x, y, s=26, color=colour, alpha=0.8, label=errors)
        axes.set(
            xlim=(-2, 102), ylim=(-2, 102), aspect="equal", title=procedure,
            xlabel="plan of least cost succeeds, %", ylabel="plan for success succeeds, %",
        )  # fmt: skip
    axes.legend(loc="lower right")
    return figure


def main() -> None:
    """Run the study and store its result."""
    parser = study_parser(__doc__)
    parser.add_argument("--patient", default=default_anatomies()[-1], metavar="NAME")
    parser.add_argument("--system", default="lung-default", metavar="NAME")
    options = parser.parse_args()
    setting = setting_of(options)
    result = Result(
        name="success_planning", title="Planning for success against least cost, by error model",
        setting=setting, seeds=[options.seed],
    )  # fmt: skip
    system = la.load_system(options.system, fissures_allowed=True)
    lung = anatomy(options.patient)
    atlas = la.open_atlas(lung, system)
    plans = plans_of(lung, atlas, max(TARGETS[setting]), options.seed)
    targets, draws = (" and ".join(map(str, sizes[setting])) for sizes in (TARGETS, DRAWS))
    result.conditions = {
        "anatomy": f"{lung.name}, system {system.name}",
        "targets": f"peripheral ones; {targets} for {' and '.join(PROCEDURES)}",
        "least cost": f"{ITERATIONS} iterations",
        "counted": f"both plans on the same draws, {draws} of them; a success ends within 5 mm of the target "
        "and touches nothing forbidden",
    }
    found: dict[tuple[str, str], list[Pair]] = {}
    for errors in error_preset_names():
        for n, procedure in enumerate(PROCEDURES):
            size = (VARIATIONS[setting][n], DRAWS[setting][n])
            found[errors, procedure] = [
                compare(plan, lung, atlas, load_errors(errors), load_procedure(procedure), size, options.seed)
                for plan in plans[: TARGETS[setting][n]]
            ]
            add_rows(result, f"{errors}, {procedure}", found[errors, procedure])
    result.figure = drawn(found)
    write_result(result, options.results)


if __name__ == "__main__":
    main()

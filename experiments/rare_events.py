"""Importance sampling against plain counting, for touches that seldom happen.

    python -m experiments.rare_events [--quick]

Three plans in synthetic patients are carried out with small errors.  The chance that a structure is touched
is estimated with weights from twenty thousand draws (`lungaccess.uncertainty.risk.rare_share`), and counted
in a hundred million.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

import lungaccess as la
from anatomy.base.records import frozen_value
from anatomy.build import build_lung
from anatomy.phantom import make_phantom
from experiments.support.results import Result, setting_of, study_parser, write_result
from lungaccess.problem.error_files import load_errors
from lungaccess.uncertainty.risk import RiskAssessor, rare_touch
from lungaccess.uncertainty.risk.statistics import Share

BATCH = 1_000_000
WEIGHTED = 20_000


@frozen_value
class Case:
    """A plan and errors so small that it seldom touches a structure.

    Args:
        system: Name of a preset.
        errors: Name of a preset, all of whose errors are multiplied by `scale`.
    """

    phantom_seed: int
    system: str
    errors: str
    scale: float
    structure: str

    def assessor(self) -> RiskAssessor:
        """Make the patient and the plan."""
        lung = build_lung(make_phantom(seed=self.phantom_seed, size="small").images)
        found = la.plan(
            lung, la.load_system(self.system), la.resolve_target(lung), iterations=30, goal="default"
        )
        return RiskAssessor(list(found)[-1], lung)


CASES = (
    Case(phantom_seed=0, system="ultrathin", errors="gated-ct", scale=0.1, structure="airway"),
    Case(phantom_seed=3, system="ultrathin", errors="breath-hold", scale=0.45, structure="vessel"),
    Case(phantom_seed=5, system="ultrathin", errors="gated-ct", scale=0.11, structure="vessel"),
)
"""The scales make one to fifteen touches in 100,000 draws."""


def counted(case: Case, assessor: RiskAssessor, draws: int, seed: int) -> Iterator[int]:
    """Count touches in batches of fresh draws."""
    model, flag = load_errors(case.errors).scaled(case.scale), assessor.structures[case.structure]
    for begin in range(0, draws, BATCH):
        batch = assessor.draws(min(BATCH, draws - begin), seed + 1 + begin // BATCH)
        yield int(np.count_nonzero(assessor.outcomes(batch.deviations(model)).touched & flag))


def main() -> None:
    """Estimate, count, print, and write the result."""
    options = study_parser(__doc__).parse_args()
    draws = 1_000_000 if options.quick else 100_000_000
    result = Result(
        name="rare_events", title="Rare touches: importance sampling against plain counting",
        setting=setting_of(options),
        conditions={
            "anatomy": "synthetic patients of a child's size",
            "weighted": f"{WEIGHTED:,} draws, and as many for each spread in which events are looked for",
            "counted": f"{draws:,} draws",
        },
        seeds=[options.seed],
    )  # fmt: skip
    for case in CASES:
        assessor = case.assessor()
        model = load_errors(case.errors).scaled(case.scale)
        found = rare_touch(assessor, model, case.structure, WEIGHTED, options.seed)
        plain = Share(count=sum(counted(case, assessor, draws, options.seed)), samples=draws)
        low, high = (1e6 * each for each in found.interval)
        of = f"{case.structure}, errors {case.errors} x {case.scale:g}, phantom {case.phantom_seed}"
        result.add(
            f"{of}: estimated with weights", 1e6 * found.value, unit="per million",
            note=f"{low:.3g} to {high:.3g} (95 %)",
        )  # fmt: skip
        low, high = (1e6 * each for each in plain.interval)
        result.add(
            f"{of}: counted", 1e6 * plain.value, unit="per million", note=f"{low:.3g} to {high:.3g} (95 %)"
        )
    print(write_result(result, options.results))


if __name__ == "__main__":
    main()

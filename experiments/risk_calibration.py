"""Whether the stated chance of success agrees with a count of fresh draws, by plan and error model.

python -m experiments.risk_calibration PATIENT PLAN.json [PLAN.json ...]
"""

from __future__ import annotations

import argparse

import lungaccess as la
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import error_preset_names, load_errors
from lungaccess.uncertainty.risk import RiskAssessor

PREDICTED, COUNTED = 10_000, 100_000
SEED, FRESH_SEED = 0, 1_000_003
"""Each plan has seeds of its own: under one luck for all plans, all would be off at once."""


def main() -> None:
    """Print predicted interval and counted share of each plan, and how many counts lie within."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("patient")
    parser.add_argument("plans", nargs="+")
    options = parser.parse_args()
    lung = la.load_patient(options.patient)
    within = total = 0
    for number, path in enumerate(options.plans):
        assessor = RiskAssessor(Plan.load(path), lung)
        for name in error_preset_names():
            model = load_errors(name)
            predicted = assessor.success(assessor.draws(PREDICTED, SEED + number), model)
            counted = assessor.success(assessor.draws(COUNTED, FRESH_SEED + number), model)
            low, high = predicted.interval
            holds = low <= counted.value <= high
            within, total = within + holds, total + 1
            print(f"{path} {name}: {low:.4f} to {high:.4f}, counted {counted.value:.4f}, {holds}")
    print(f"{within} of {total} counts lie within the predicted interval")


if __name__ == "__main__":
    main()

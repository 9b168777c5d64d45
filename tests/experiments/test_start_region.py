"""The study of the safe start region: deviated tips and rank correlations with known answers."""

from __future__ import annotations

import numpy as np
import pytest

import experiments.start_region as study
import lungaccess as la
from anatomy.lung import Lung
from lungaccess.uncertainty.risk import RiskAssessor
from lungaccess.uncertainty.risk.deviations import Deviations, deviated_pieces, deviated_starts


@pytest.mark.slow
def test_tubes_without_errors_end_where_the_plan_says(small_lung: Lung, small_atlas: la.Atlas) -> None:
    target = la.resolve_target(small_lung)
    plan = next(
        la.plan(small_lung, small_atlas.system, target, atlas=small_atlas, iterations=1, goal="default")
    )
    assessor = RiskAssessor(plan, small_lung)
    none = Deviations(**assessor.no_deviations(1))
    start, pieces = deviated_starts(plan, small_lung, none)[0], deviated_pieces(plan, none)[0]
    tip = study.tip_after(start, pieces[: len(pieces) - assessor.n_arcs])
    np.testing.assert_allclose(tip[:3, 2:], plan.tube.lps_from_tip[:3, 2:], atol=1e-9)
    assert 0.0 <= study.share_of_tips(plan, small_lung, 5.0) <= 1.0
    region = la.safe_start_region(plan, small_lung)
    assert study.share_at(plan, small_lung, region, 1.0) == 1.0


def test_ranks_are_compared_within_a_group() -> None:
    """The second patient is shifted: over all plans the order is lost, within each it is perfect."""
    rows = [{"a": float(n), "b": float(n) ** 3} for n in range(5)]
    rows += [{"a": 100.0 + n, "b": -100.0 + n} for n in range(5)]
    assert study.correlation(rows, ["x"] * 5 + ["y"] * 5, "a", "b") == pytest.approx(1.0)
    assert study.correlation(rows, ["x"] * 10, "a", "b") < 0.0

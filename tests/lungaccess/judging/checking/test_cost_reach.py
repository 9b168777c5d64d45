"""The recomputed cost knows how far obstacles are, also where they are far: few vessels, wide lungs."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lungaccess.judging.checking.outcome import inverse_clearance


@pytest.mark.parametrize("distance_mm", [5.0, 19.9, 20.0, 45.0])
def test_the_cost_of_a_needle_at_one_distance_from_everything(distance_mm: float) -> None:
    def boxes(_select: Any, reach_mm: float) -> Any:
        capped = min(distance_mm, reach_mm)
        return SimpleNamespace(distance_mm=lambda points: np.full(len(points), capped))

    curve = SimpleNamespace(
        arc_mm=np.linspace(0.0, 30.0, 61), points=np.linspace((0.0, 0.0, 0.0), (0.0, 0.0, 30.0), 61)
    )
    plan = SimpleNamespace(fissures_are_obstacles=False)
    cost = inverse_clearance(plan, SimpleNamespace(boxes=boxes), curve)  # type: ignore[arg-type]
    assert cost == pytest.approx(30.0 / distance_mm)

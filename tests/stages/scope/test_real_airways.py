"""The scope in segmented airways: no pose touches the wall, and the field is exact there, too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from anatomy.lung import Lung
from lungaccess.problem.patients import load_patient
from stages.scope.advisor.advisor import Advisor, start_state, why_stopped
from stages.scope.advisor.kinematics import ScopeModel
from stages.scope.advisor.lumen import Lumen, lumen_of_lung
from stages.scope.advisor.nf1 import entering_costs, goal_at, navigation_field
from tests.stages.scope.advisor.test_nf1 import dijkstra_of
from tests.stages.scope.airways import wall_mm

pytestmark = [pytest.mark.slow, pytest.mark.data]


@pytest.fixture(scope="module", params=["Patient1", "Patient2"])
def airways(request: pytest.FixtureRequest, data_dir: Path) -> tuple[Lung, Lumen]:
    lung = load_patient(data_dir / "med-rad" / request.param)
    return lung, lumen_of_lung(lung)


def ends(lung: Lung, count: int) -> list[np.ndarray]:
    leaves = lung.tree.leaf_branches
    chosen = leaves[np.linspace(0, len(leaves) - 1, count).astype(int)]
    return [np.array(lung.tree.points_lps[lung.tree.branch_points(int(branch))[-1]]) for branch in chosen]


@pytest.mark.parametrize("radius", [1.0, 2.0])
def test_every_path_keeps_the_scopes_radius_and_says_why_it_ends(
    airways: tuple[Lung, Lumen], radius: float
) -> None:
    lung, lumen = airways
    model = ScopeModel(radius_mm=radius, twist_low_deg=-90.0, bend_low_deg=-120.0)
    start = start_state(lumen, lung.tree, model)
    for end in ends(lung, 4):
        advisor = Advisor(lumen, model, goal_at(lumen, end))
        path = advisor.path(start, seed=1)
        for number in range(0, path.count, 5):
            assert wall_mm(lumen, path.body(number, 1.0)[-200:], radius + 1.0).min() >= radius
        assert path.reached == (why_stopped(path, advisor.field, lung.tree) == "")
        assert lumen.voxel_at(path.lps_from_tip[:3, 3]) >= 0


def test_the_field_is_dijkstras_on_a_real_lumen(airways: tuple[Lung, Lumen]) -> None:
    lung, lumen = airways
    field = navigation_field(lumen, goal_at(lumen, ends(lung, 2)[1]).voxel)
    costs = entering_costs(field.clearance, field.largest_clearance)
    expected = dijkstra_of(lumen, lumen.grid.spacing_mm, costs, field.goal)
    np.testing.assert_array_equal(field.potential, expected)

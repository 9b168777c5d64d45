"""Direct arcs with bounds, and their random improvement."""

from __future__ import annotations

import math

import numpy as np
import pytest

import lungaccess as la
from anatomy.lung import Lung
from lungaccess.planning.coupled.kernels.direct_arcs import PRUNED_BY_BOUND
from lungaccess.planning.coupled.search.atlas_search import AtlasSearch
from lungaccess.planning.coupled.search.base import different
from lungaccess.planning.coupled.search.local_search import SHIFTS_MM, LocalSearch, path_through
from lungaccess.plans.candidate import Candidate
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from stages.scope import MotionProver, in_tip_region
from tests.lungaccess.cli.ahead import turned_candidates
from tests.lungaccess.planning.coupled.planning import SYSTEM


@pytest.fixture(scope="module")
def search(small_lung: Lung, target: Target, atlas: la.Atlas) -> AtlasSearch:
    task = Task(lung=small_lung, system=SYSTEM, target=target)
    return AtlasSearch(task, atlas)


def first_clear(search: AtlasSearch, place: int = 0) -> Candidate:
    """Return the direct arc at a place among those that are clear, the nearest first."""
    arcs = search.arcs
    found = arcs.proved(int(arcs.in_workspace[arcs.blockers(arcs.in_workspace)[0] == 0][place]))
    assert found is not None
    return found


class TestDirectArcs:
    """Direct arcs with a running best, and lower bounds."""

    def test_what_is_not_pruned_is_evaluated_as_by_the_needle_stage(self, search: AtlasSearch) -> None:
        near = search.arcs.in_workspace
        labels, _lengths, inverse = search.arcs.blockers(near)
        blockers, costs, _best = search.arcs.evaluate(near, math.inf)
        assert (blockers == labels).all() and (costs[labels == 0] == inverse[labels == 0]).all()
        blockers, costs, best = search.arcs.evaluate(near, 1.0)
        pruned = blockers == PRUNED_BY_BOUND
        assert 0 < pruned.sum() < len(near) and (blockers[~pruned] == labels[~pruned]).all()
        assert best == costs[blockers == 0].min() == inverse[labels == 0].min()
        assert (inverse[pruned & (labels == 0)] >= best).all()

    def test_lower_bounds_are_below_exact_costs(self, search: AtlasSearch) -> None:
        ordered, bounds = search.arcs.by_bound
        assert set(ordered.tolist()) == set(search.arcs.in_workspace.tolist())
        assert (np.diff(bounds[ordered]) >= 0.0).all()
        clear = ordered[search.arcs.blockers(ordered)[0] == 0]
        for entry in clear[:: max(len(clear) // 60, 1)].tolist():
            candidate = search.arcs.proved(entry)
            assert candidate is not None and 0.0 < bounds[entry] <= search.evaluator.cost(candidate)

    def test_different_deployments_are_the_first_of_their_kind(self, search: AtlasSearch) -> None:
        entries, near = search.atlas.deployments, search.arcs.in_workspace
        kept = different(entries, near)
        assert kept[0] == near[0] and 0 < len(kept) < len(near)
        assert (np.diff([near.tolist().index(n) for n in kept.tolist()]) > 0).all()
        assert set(entries.branch[kept]) == set(entries.branch[near])
        assert (different(entries, kept) == kept).all()


def local_search_of(search: AtlasSearch) -> LocalSearch:
    return LocalSearch(search.evaluator, np.random.default_rng(0))


class TestLocalSearch:
    """Random improvement in compiled batches."""

    @pytest.mark.parametrize("turned", [False, True])
    def test_costs_only_fall_and_every_result_is_proved(
        self, search: AtlasSearch, small_lung: Lung, atlas: la.Atlas, turned: bool
    ) -> None:
        if turned:
            search, begun = next(turned_candidates(small_lung, atlas))
        else:
            begun = first_clear(search, 200)  # Estimates are coarse where an arc is almost stopped.
        local_search = local_search_of(search)
        run = local_search.begin(begun)
        assert run is not None
        again = local_search.candidate(run)
        assert again is not None and np.allclose(again.path.arcs, begun.path.arcs, atol=1e-9)
        costs = []
        for _ in range(12):
            local_search.advance(run, 50)
            costs.append(run.cost)
            found = local_search.candidate(run)
            assert found is not None
            assert search.evaluator.evaluate(found) == pytest.approx(run.cost, rel=0.05)
        assert costs == sorted(costs, reverse=True)
        assert costs[-1] < 0.99 * search.evaluator.cost(begun)

    def test_perturbed_runs_find_back_to_what_is_proved(self, search: AtlasSearch) -> None:
        local_search, begun, finite = local_search_of(search), first_clear(search), 0
        for _ in range(8):
            run = local_search.begin(begun)
            assert run is not None
            local_search.perturb(run)
            local_search.advance(run, 300)
            if math.isfinite(run.cost):
                finite += 1
                found = local_search.candidate(run)
                assert found is not None and math.isfinite(search.evaluator.evaluate(found))
        assert finite >= 1

    def test_rows_hold_tips_with_proved_motions(self, search: AtlasSearch, small_lung: Lung) -> None:
        prover = MotionProver(small_lung, SYSTEM.scope)
        for site in range(0, search.atlas.motions.count, 60):
            row = search.evaluator.tip_rows.along(search.atlas.motions.tip(site), SHIFTS_MM)
            allowed = row.proved
            assert allowed[len(SHIFTS_MM) // 2]
            for index in np.flatnonzero(allowed)[::4].tolist():
                tip = search.evaluator.tip_rows.tip(row, index)
                assert isinstance(prover.prove(tip.motion), float)
                assert np.allclose(tip.motion.lps_from_tip, tip.lps_from_scope_tip, atol=1e-9)
            inside = in_tip_region(small_lung.tree, row.tips)[1]
            assert inside[allowed & (SHIFTS_MM != 0.0)].all()

    def test_paths_lead_through_their_points(self, search: AtlasSearch) -> None:
        begun = first_clear(search)
        target = search.task.target.lps_mm
        vias = begun.path.sample(2.0)[0][[3, 6]] + 0.3
        path = path_through(begun.deployment, vias, target)
        assert np.allclose(path.frames()[1:, :3, 3], [*vias, target], atol=1e-9)

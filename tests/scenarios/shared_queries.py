"""Recorded needle queries on real patients, with the path of each planner judged voxel by voxel."""

from __future__ import annotations

from pathlib import Path

from experiments.support.needle.queries import Validator, environment_of, hard_queries, load_obstacles
from lungaccess.running.benchmark.published import UncObstacles
from stages.needle import path as needle_query
from stages.needle.search.planners import searches
from tests.scenarios.cases import NEEDLE_ITERATIONS, SHARED_QUERIES
from tests.scenarios.runs import Answer


class SharedQueries:
    """The recorded queries of `SHARED_QUERIES`; masks are read once."""

    def __init__(self, data: Path) -> None:
        found = {query.name: query for query in hard_queries(data / "needle")}
        self._queries = [found[name] for name in SHARED_QUERIES]
        self._obstacles: dict[int, UncObstacles] = {
            number: load_obstacles(data / "med-rad" / f"Patient{number}")
            for number in sorted({query.patient for query in self._queries})
        }

    def answers(self, planner: str) -> list[Answer]:
        """Plan for each query by length, and walk each path again against all obstacle voxels."""
        out = []
        for query in self._queries:
            environment = environment_of(self._obstacles[query.patient], query)
            asked = needle_query.Query(lps_from_start=query.lps_from_start, target=query.target_lps)
            search = searches()[planner](environment, asked, 0)
            search.advance(NEEDLE_ITERATIONS)
            path = search.path
            if path is None:
                out.append(Answer(cost=None, digest=""))
                continue
            faults = tuple(Validator(environment, query).faults(path))
            out.append(Answer(cost=search.cost, digest=path.arcs.tobytes().hex(), faults=faults))
        return out

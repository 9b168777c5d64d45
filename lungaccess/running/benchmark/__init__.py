"""Published needle queries run with our planners and OMPL's, by our rules or those of a peer."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.running.benchmark.published import (
        UNC_EXEMPT_MM,
        UNC_GOAL_TOLERANCE_MM,
        UNC_MAX_LENGTH_MM,
        UNC_NEEDLE_DIAMETER_MM,
        PeerResult,
        PublishedQuery,
        UncObstacles,
        patients_of,
        published_queries,
        read_peer,
        unc_needle,
        unc_obstacles,
    )
    from lungaccess.running.benchmark.runs import (
        BenchmarkRow,
        posed_by_unc,
        posed_in_lung,
        run_query,
        summary_rows,
        write_rows,
    )

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""The needle problem in OMPL: an SE(3) control problem, and planners whose search is a compiled kernel.

The only package that imports OMPL; docs/explanation/ompl.md tells how it is used and which traps it avoids.
What OMPL's own planners propagate is proved clear step by step; what they find is proved once more as arcs.
"""

from anatomy.base.errors import MissingLibraryError

try:
    import ompl.base
    import ompl.control
except ImportError as error:
    raise MissingLibraryError(
        f"OMPL cannot be imported ({error}), and its planners run in it",
        expected="the library ompl, which has no wheels for Windows, Linux on ARM, Python 3.14 and macOS 14",
        remedy="Choose a planner of our own, such as rrt or optimal, or install ompl where it exists",
    ) from error

from stages.needle.ompl.planner import NeedleGoal, NeedlePlanner, Question, path_of, read_state, write_state
from stages.needle.ompl.problem import Allocator, NeedleProblem, SearchFactory, seed_ompl

__all__ = [
    "Allocator",
    "NeedleGoal",
    "NeedlePlanner",
    "NeedleProblem",
    "Question",
    "SearchFactory",
    "path_of",
    "read_state",
    "seed_ompl",
    "write_state",
]

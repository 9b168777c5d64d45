"""The task of a search: patient, devices, target and objective, tested together."""

from anatomy.base.records import frozen_record
from anatomy.lung import Lung
from anatomy.organ import Organ
from lungaccess.problem.system import System
from lungaccess.problem.target import Target, require_free
from stages.needle import DEFAULT, Objective


@frozen_record
class Task:
    """What a search for plans is asked: they keep the objective small, and state the search's name, `method`.

    `needle_planner` is one of `stages.needle.NEEDLE_PLANNERS`, or "" for the method's own.  TargetError is
    raised if the target lies outside the lung or inside an obstacle.
    """

    lung: Lung
    system: System
    target: Target
    objective: Objective = Objective(inverse_clearance=1.0)
    method: str = "atlas"
    needle_planner: str = ""
    seed: int = 0

    def __post_init__(self) -> None:
        require_free(self.lung, self.target.lps_mm)

    @property
    def with_fissures(self) -> bool:
        """Whether fissures are obstacles."""
        return fissures_are_obstacles(self.lung, self.system)


def objective_of(lung: Organ, stated: str | Objective = DEFAULT) -> Objective:
    """Return what is to be made small in a lung, clearance alone without a map; errors of `Objective.of`."""
    weighed = Objective.of(stated)
    return weighed.without_map if stated == DEFAULT and lung.cost is None else weighed


def fissures_are_obstacles(lung: Lung, system: System) -> bool:
    """Tell whether fissures are obstacles: the lung has a mask of them, and the system may not cross them."""
    return lung.has_fissures and not system.fissures_allowed

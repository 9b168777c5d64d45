"""Tours of the airway to several nodules in one procedure [Pan2025]."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from stages.scope.tour.itinerary import Itinerary, one_by_one_mm, plan_itinerary, shortest_tour
    from stages.scope.tour.subtree import (
        MOST_COMBINATIONS,
        MOST_LESIONS,
        Circuits,
        Exit,
        ExitRule,
        ExitTest,
        Reading,
        Resistances,
        Subtree,
        circuits,
        combinations,
        exits_of,
        find_exits,
        subtree_to,
    )

__getattr__, __dir__ = lazy_exports(__name__, __file__)

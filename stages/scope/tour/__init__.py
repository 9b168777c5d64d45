"""Tours of the airway to several nodules in one procedure [Pan2025]."""

from __future__ import annotations

from typing import TYPE_CHECKING

from anatomy.facade import lazy_exports

if TYPE_CHECKING:
    from stages.scope.tour.circuit import MOST_COMBINATIONS as MOST_COMBINATIONS
    from stages.scope.tour.circuit import SAME_RESISTANCE as SAME_RESISTANCE
    from stages.scope.tour.circuit import Circuits as Circuits
    from stages.scope.tour.circuit import Reading as Reading
    from stages.scope.tour.circuit import circuits as circuits
    from stages.scope.tour.circuit import combinations as combinations
    from stages.scope.tour.exits import Exit as Exit
    from stages.scope.tour.exits import ExitRule as ExitRule
    from stages.scope.tour.exits import ExitTest as ExitTest
    from stages.scope.tour.exits import exits_of as exits_of
    from stages.scope.tour.exits import find_exits as find_exits
    from stages.scope.tour.itinerary import Itinerary as Itinerary
    from stages.scope.tour.itinerary import one_by_one_mm as one_by_one_mm
    from stages.scope.tour.itinerary import plan_itinerary as plan_itinerary
    from stages.scope.tour.resistance import Resistances as Resistances
    from stages.scope.tour.resistance import branch_resistances as branch_resistances
    from stages.scope.tour.shortest import shortest_tour as shortest_tour
    from stages.scope.tour.subtree import MOST_LESIONS as MOST_LESIONS
    from stages.scope.tour.subtree import Subtree as Subtree
    from stages.scope.tour.subtree import subtree_to as subtree_to

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""From a request to plans, and from a measurement to the next step."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.planning.diverse_plans import Alternative, with_front
    from lungaccess.planning.driver import TIP_WITHIN_MM, ProgressEvent, atlas_event, tips_near
    from lungaccess.planning.one_system import run
    from lungaccess.planning.searches import NEED_A_NEEDLE, planners, register_planner
    from lungaccess.planning.tour import TourAnswer, lesions_of, plan_tour, read_lesions, tour_record

__getattr__, __dir__ = lazy_exports(__name__, __file__)

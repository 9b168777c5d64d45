"""Pictures of plans, searches and anatomy; the only package that draws."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.showing.report.clock import window_png
    from lungaccess.showing.report.cost_history import CostPoint, cost_over_time_csv
    from lungaccess.showing.report.motion import motion_png
    from lungaccess.showing.report.needle import needle_png
    from lungaccess.showing.report.no_plan import no_plan_png
    from lungaccess.showing.report.overview import overview_png
    from lungaccess.showing.report.reach import reach_png
    from lungaccess.showing.report.search import cost_over_time_png, front_png
    from lungaccess.showing.report.tree import organ_png, tree_png
    from lungaccess.showing.report.tubes import tubes_png

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""Report pages: one HTML file each, complete in itself, for a plan, no plan, or a reachability map."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.showing.report.html.movie import bronchoscopy_webp
    from lungaccess.showing.report.html.page_of_no_plan import no_plan_page
    from lungaccess.showing.report.html.page_of_plan import PageOptions, plan_page
    from lungaccess.showing.report.html.page_of_reach import reach_page
    from lungaccess.showing.report.html.trade_off import trade_off_svg

__getattr__, __dir__ = lazy_exports(__name__, __file__)

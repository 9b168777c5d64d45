"""Report pages: one HTML file each, complete in itself, for a plan or for a reachability map."""

from __future__ import annotations

from lungaccess.report.html.movie import bronchoscopy_webp
from lungaccess.report.html.page_of_plan import PageOptions, plan_page
from lungaccess.report.html.page_of_reach import reach_page

__all__ = ["PageOptions", "bronchoscopy_webp", "plan_page", "reach_page"]

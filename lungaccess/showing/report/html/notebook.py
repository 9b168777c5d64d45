"""The page of a plan inside a notebook."""

from __future__ import annotations

import html
import tempfile
from pathlib import Path

from anatomy.base.records import frozen_value
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.showing.report.html.page_of_plan import PageOptions, plan_page


@frozen_value
class PageView:
    """A page that a notebook shows in a frame of its own; nothing is fetched, and nothing leaves it."""

    page: str
    height_px: int

    def _repr_html_(self) -> str:
        """Return the frame, which Jupyter shows; the page stays in it after the notebook is saved."""
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" sandbox="allow-scripts" width="100%" '
            f'height="{self.height_px}" style="border:0"></iframe>'
        )


def view(plan: Plan, lung: Lung, options: PageOptions | None = None, *, height_px: int = 800) -> PageView:
    """Return the page of a plan for the last line of a cell: it plays in 3-D, with slices, charts and risk.

    Args:
        options: As of `plan_page`.

    Raises:
        PlanFileError, AnatomyError: As `plan_page`.

    Examples:
        >>> la.view(plan, lung)  # doctest: +SKIP
    """
    with tempfile.TemporaryDirectory() as folder:
        return PageView(
            page=plan_page(plan, lung, Path(folder) / "plan.html", options).read_text(encoding="utf-8"),
            height_px=height_px,
        )

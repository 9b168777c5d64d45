"""Pictures of plans, searches and anatomy; the only package that draws."""

from __future__ import annotations

from lungaccess.report.overview import overview_png
from lungaccess.report.reach import reach_png
from lungaccess.report.search import CostPoint, cost_over_time_csv, cost_over_time_png
from lungaccess.report.tree import tree_png
from lungaccess.report.tubes import tubes_png

__all__ = [
    "CostPoint",
    "cost_over_time_csv",
    "cost_over_time_png",
    "overview_png",
    "reach_png",
    "tree_png",
    "tubes_png",
]

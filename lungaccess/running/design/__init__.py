"""The search over the numbers of a device: which device reaches most of a cohort, or most often succeeds."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.running.design.search import DesignFound, run_design
    from lungaccess.running.design.settings import CRITERIA, Contender, Design, Number, design_of, read_design

__getattr__, __dir__ = lazy_exports(__name__, __file__)

"""Plans that succeed: the search for the plan whose procedure most often ends well under given errors."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from lungaccess.planning.success.estimate import Estimate, chance_of, estimate_success

__getattr__, __dir__ = lazy_exports(__name__, __file__)

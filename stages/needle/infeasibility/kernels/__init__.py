"""Compiled kernels of the infeasibility proofs, and those that other proofs call."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from stages.needle.infeasibility.kernels.backward_reach import BackwardReach, never_along
    from stages.needle.infeasibility.kernels.bounds import escape_depth

__getattr__, __dir__ = lazy_exports(__name__, __file__)

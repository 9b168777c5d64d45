"""Airway trees made from lumen masks and from centreline graphs."""

from typing import TYPE_CHECKING

from anatomy.base.facade import lazy_exports

if TYPE_CHECKING:
    from anatomy.tree.build import tree_from_graph, tree_from_mask

__getattr__, __dir__ = lazy_exports(__name__, __file__)

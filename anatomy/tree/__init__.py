"""Make airway trees from lumen masks and from centreline graphs."""

from __future__ import annotations

from anatomy.tree.build import tree_from_graph, tree_from_mask

__all__ = ["tree_from_graph", "tree_from_mask"]

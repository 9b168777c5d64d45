"""Find the trachea in an unrooted skeleton tree, or say why there is none.

The rule is stated with its reasons in `docs/explanation/airway_tree.md`.
"""

from typing import NoReturn

import numpy as np

from anatomy.base.errors import AnatomyError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float
from anatomy.base.words import percent
from anatomy.tree.skeleton import SkeletonTree

BEYOND_RADII = 3.0
"""The width of a branch is judged from 1 to this many radii beyond where it begins."""

MAX_TILT_COS = 0.5
"""The trachea runs within 60 degrees of the body axis."""


@frozen_record
class Trunk:
    """An end of the tree followed inwards over thin side branches to where it divides, or else ends.

    The radius is the median of its nodes, the length goes along them.
    """

    nodes: list[int]
    radius_mm: float
    length_mm: float
    divides: bool


def find_trachea(tree: SkeletonTree, lps_from_mm: Float) -> Trunk:
    """Return the trachea of a tree that is pruned; its first node is the root.

    `lps_from_mm` (3, 3) turns the directions of the tree's own frame into LPS.

    Raises:
        AnatomyError: If nothing is like a trachea: the message says what is there instead.
    """
    trunks = [follow_trunk(tree, end) for end in tree.ends()]
    # A trachea is about twelve radii long; of one that the image cuts, a quarter is enough to know it by.
    long_ones = [t for t in trunks if t.divides and t.length_mm >= 3.0 * t.radius_mm]
    if not long_ones:
        _refuse(f"it has {len(trunks)} ends and none is a tube that is longer than wide and divides in two")
    trunk = max(long_ones, key=lambda t: t.radius_mm)
    radius, length = trunk.radius_mm, trunk.length_mm
    size = f"the widest tube that divides has the radius {radius:.1f} mm and the length {length:.0f} mm"
    # Half of the tracheal diameter of a newborn is 2 mm.
    if radius < 2.0:
        _refuse(f"{size}, too narrow for any trachea")
    # The least radius of an adult trachea; lobar bronchi are thinner, and must not pass for one by size.
    if radius < 5.0:
        # A trachea is about 12 radii long at any age; bronchi are 4 to 7 [Weibel1963].
        if length < 6.0 * radius:
            _refuse(f"{size}: too narrow for an adult's and too short for a child's trachea")
        share = _lesser_lung_share(tree, trunk)
        # Each main bronchus of a child must carry this share of the tree: a small vessel has a twig on one
        # side.
        if share < 0.15:
            _refuse(f"{size}, but all but {percent(share)} of the tree are on one side of its division")
    widest = _widest_elsewhere(tree, trunk)
    if widest > 1.25 * radius:
        _refuse(f"{size}, but other parts are wider ({widest:.1f} mm)")
    _require_upright(tree, trunk, lps_from_mm, size)
    return trunk


def follow_trunk(tree: SkeletonTree, end: int) -> Trunk:
    """Follow the tree from an end to the first place where it divides into two wide branches."""
    nodes = tree.chain(end, tree.neighbours[end][0])
    while True:
        radius = float(np.median(tree.depth_mm[nodes]))
        onwards = [tree.chain(nodes[-1], n) for n in tree.neighbours[nodes[-1]] if n != nodes[-2]]
        # Both main bronchi are wider than this fraction of the trachea; a twig on its wall is thinner.
        wide = [c for c in onwards if not _is_bulge(tree, c) and _beyond(tree, c) >= 0.4 * radius]
        if len(wide) != 1:
            divides = len(wide) > 1
            return Trunk(nodes=nodes, radius_mm=radius, length_mm=tree.length_mm(nodes), divides=divides)
        nodes = nodes + wide[0][1:]


def _is_bulge(tree: SkeletonTree, nodes: list[int]) -> bool:
    """Tell whether a branch is a dead end so near to where it begins that it is a bulge of the wall.

    A trachea has one at its edges where its back wall is pressed in, as after breathing out.
    """
    offset = float(np.linalg.norm(tree.mm[nodes[-1]] - tree.mm[nodes[0]]))
    return len(tree.neighbours[nodes[-1]]) == 1 and offset < BEYOND_RADII * tree.depth_mm[nodes[0]]


def _beyond(tree: SkeletonTree, nodes: list[int]) -> float:
    """Return the median depth of a branch just outside the sphere inscribed where it begins."""
    offset = np.linalg.norm(tree.mm[nodes] - tree.mm[nodes[0]], axis=1)
    radius = tree.depth_mm[nodes[0]]
    outside = np.array(nodes)[(offset > radius) & (offset < BEYOND_RADII * radius)]
    return float(np.median(tree.depth_mm[outside if len(outside) else nodes[-1:]]))


def _widest_elsewhere(tree: SkeletonTree, trunk: Trunk) -> float:
    """Return the 95th percentile of the radius among nodes away from the trunk."""
    away = np.array([bool(near) for near in tree.neighbours])
    away[trunk.nodes] = False
    end = trunk.nodes[-1]
    away &= np.linalg.norm(tree.mm - tree.mm[end], axis=1) > tree.depth_mm[end]
    return float(np.percentile(tree.depth_mm[away], 95)) if away.any() else 0.0


def _lesser_lung_share(tree: SkeletonTree, trunk: Trunk) -> float:
    """Return the share of the nodes beyond the trunk that hang on the second largest branch there."""
    end = trunk.nodes[-1]
    counts = []
    for first in tree.neighbours[end]:
        if first == trunk.nodes[-2]:
            continue
        stack, count = [(first, end)], 0
        while stack:
            node, came_from = stack.pop()
            count += 1
            stack += [(other, node) for other in tree.neighbours[node] if other != came_from]
        counts.append(count)
    return sorted(counts)[-2] / sum(counts)


def _require_upright(tree: SkeletonTree, trunk: Trunk, lps_from_mm: Float, size: str) -> None:
    """Refuse a trunk that does not come from above, or whose branches do not go down or sideways."""
    down = lps_from_mm @ (tree.mm[trunk.nodes[-1]] - tree.mm[trunk.nodes[0]])
    tilt_cos = -float(down[2]) / float(np.linalg.norm(down))
    if tilt_cos <= -MAX_TILT_COS:
        raise AnatomyError(
            f"The airway is upside down: {size} and leads upwards",
            expected="the trachea above the bronchi (LPS +z is superior)",
            remedy="Check the orientation in the header of the mask",
        )
    if tilt_cos < MAX_TILT_COS:
        _refuse(f"{size} and lies across the body axis ({np.degrees(np.arccos(tilt_cos)):.0f} degrees)")


def _refuse(found: str) -> NoReturn:
    raise AnatomyError(
        f"No trachea was found in the airway mask: {found}",
        expected="one connected lumen with the trachea at its superior end, dividing into two main bronchi",
        remedy="Give a mask of the airway lumen that includes the trachea down to the carina",
    )

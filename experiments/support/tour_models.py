"""Random bronchial models of eight orders, and random lesions in their lungs [Pan2025, section III-A]."""

from __future__ import annotations

import numpy as np

from anatomy.airway_tree import AirwayTree, TreeReport
from anatomy.base.errors import SettingsError
from anatomy.base.typed import Float
from anatomy.tree.branches import Strand, assemble
from stages.scope.tour.subtree import ExitRule

ORDERS = 8
FIRST_ANGLE_ORDER, FIRST_ANGLE_DEG = 5, 21.0
LAST_ANGLE_ORDER, LAST_ANGLE_DEG = 15, 50.0
ANTERIOR_SHARE = 0.85
"""The branch towards the front leaves by a smaller angle than the one towards the back."""

TRACHEA_LENGTH_MM, TRACHEA_RADIUS_MM = 110.0, 8.5
LENGTH_FACTORS = (0.42, 0.6, 0.8)
"""Length of a branch over that of its parent: main bronchi, lobar bronchi, all others."""
RADIUS_FACTOR = 2.0 ** (-1.0 / 2.8)
SPREAD = 0.15
"""Standard deviation of lengths and angles, as a share of them."""
SPACING_MM = 1.0
MOST_TRIES = 10_000


def random_airway(seed: int, *, orders: int = ORDERS) -> AirwayTree:
    """Make a random binary airway tree.

    The paper states the number of orders, the angles of branching, about 21 degrees at order 5 growing to
    50 at order 15, and that the front branch leaves by the smaller one.  Lengths, radii and planes of
    branching are ours: planes turn by about 90 degrees from one order to the next.

    Args:
        seed: Not negative.
        orders: The trachea has order 1.

    Raises:
        SettingsError: If there are fewer than 2 orders, or more than 12.

    References:
        .. [Pan2025] docs/reference/bibliography.md
    """
    if not 2 <= orders <= 12:
        raise SettingsError(f"A random airway of {orders} orders", expected="2 to 12 orders")
    rng = np.random.default_rng(seed)
    down, across = np.array((0.0, 0.0, -1.0)), np.array((1.0, 0.0, 0.0))
    strands = [_strand(np.zeros(3), down, TRACHEA_LENGTH_MM, TRACHEA_RADIUS_MM, -1, -1, first=True)]
    front = [(0, down, across, TRACHEA_LENGTH_MM, TRACHEA_RADIUS_MM)]
    for order in range(2, orders + 1):
        grown = []
        for parent, direction, plane, length, radius in front:
            start = strands[parent].points_lps[-1]
            hook = len(strands[parent].points_lps) - 1
            for toward in _children(direction, plane, order, rng):
                factor = LENGTH_FACTORS[min(order - 2, 2)]
                new_length = length * factor * float(np.clip(rng.normal(1.0, SPREAD), 0.5, 1.5))
                new_radius = radius * RADIUS_FACTOR
                strands.append(_strand(start, toward, new_length, new_radius, parent, hook))
                side = np.cross(toward, plane - (plane @ toward) * toward)
                grown.append((len(strands) - 1, toward, side / np.linalg.norm(side), new_length, new_radius))
        front = grown
    return assemble(strands, TreeReport())


def _children(direction: Float, plane: Float, order: int, rng: np.random.Generator) -> list[Float]:
    """Return the directions of two branches in the plane of `direction` and `plane`, a little turned."""
    share = max(order - FIRST_ANGLE_ORDER, 0) / (LAST_ANGLE_ORDER - FIRST_ANGLE_ORDER)
    mean = FIRST_ANGLE_DEG + share * (LAST_ANGLE_DEG - FIRST_ANGLE_DEG)
    sideways = plane - (plane @ direction) * direction
    sideways /= np.linalg.norm(sideways)
    turned = np.cross(direction, sideways)
    phi = rng.normal(0.0, SPREAD)
    sideways = np.cos(phi) * sideways + np.sin(phi) * turned
    found = []
    for sign in (1.0, -1.0):
        # -y is anterior.
        anterior = sign * sideways[1] < 0.0
        angle = np.radians(
            mean * (ANTERIOR_SHARE if anterior else 1.0) * np.clip(rng.normal(1.0, SPREAD), 0.5, 1.5)
        )
        found.append(np.cos(angle) * direction + np.sin(angle) * sign * sideways)
    return found


def _strand(
    start: Float,
    direction: Float,
    length: float,
    radius: float,
    parent: int,
    attach: int,
    *,
    first: bool = False,
) -> Strand:
    """Return a straight branch; but for the trachea it begins one step after the point it hangs on."""
    count = max(int(np.ceil(length / SPACING_MM)), 1)
    along = np.linspace(0.0, length, count + 1)[0 if first else 1 :]
    return Strand(
        points_lps=start + along[:, None] * direction,
        radius_mm=np.full(len(along), radius),
        parent=parent,
        attach=attach,
    )


def random_lesions(tree: AirwayTree, count: int, seed: int, *, rule: ExitRule | None = None) -> Float:
    """Return lesions `(count, 3)`, LPS mm, evenly distributed in the hull of the bronchi.

    The hull of all points below the carina replaces the lungs; a place farther from the airway than the
    needle reaches is drawn again.

    Raises:
        SettingsError: If no such place is found.
    """
    from scipy.spatial import ConvexHull

    rng = np.random.default_rng((seed, count))
    reach = (rule or ExitRule()).reach_mm
    points = tree.points_lps[tree.branch_start[1] :]
    sides = ConvexHull(points).equations
    low, high = points.min(axis=0), points.max(axis=0)
    found: list[Float] = []
    for _ in range(MOST_TRIES):
        if len(found) == count:
            return np.array(found)
        place = rng.uniform(low, high)
        near = np.linalg.norm(tree.points_lps[tree.nearest_point(place)] - place) <= reach
        if near and (sides[:, :3] @ place + sides[:, 3] <= 0.0).all():
            found.append(place)
    raise SettingsError(f"No {count} places for lesions were found", expected="airways that fill a volume")

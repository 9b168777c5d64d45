"""Pulmonary vessels: an artery beside every airway, veins grown into the gaps between them."""

import re
from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_record
from anatomy.base.typed import Float, Int
from anatomy.lobes import LEFT_LOWER, LEFT_UPPER, RIGHT_LOWER, RIGHT_MIDDLE, RIGHT_UPPER
from anatomy.phantom.branching import STEP_MM, Clearance, GrowthRule, Sprouts, grow, overlap_mm, smooth_line
from anatomy.phantom.territory import Territory
from anatomy.poses import unit
from anatomy.tree.branches import children_of

LEFT_MAIN = 2
CENTRAL_KNOTS = {
    0: ((14.0, -46.0, -58.0), (10.0, -40.0, -40.0), (6.0, -31.0, -23.0)),
    1: ((6.0, -31.0, -23.0), (-6.0, -22.0, -24.0)),
    LEFT_MAIN: ((6.0, -31.0, -23.0), (18.0, -17.0, -2.0), (30.0, 2.0, 3.0)),
}
"""Points of the trunk and of the right and left artery of an adult, LPS mm from the carina, as in atlases."""
CENTRAL_ARTERIES = ("pulmonary trunk", "right pulmonary artery", "left pulmonary artery")

# Per lobe: from the left atrium past the hilum to where the lobar vein begins to divide (adult, LPS mm).
LOBAR_VEINS = {
    RIGHT_UPPER: ((-12.0, 4.0, -56.0), (-24.0, -16.0, -46.0), (-36.0, -27.0, -26.0)),
    RIGHT_MIDDLE: ((-12.0, 4.0, -59.0), (-22.0, -12.0, -60.0), (-34.0, -24.0, -66.0)),
    RIGHT_LOWER: ((-12.0, 12.0, -66.0), (-18.0, 20.0, -72.0), (-26.0, 30.0, -84.0)),
    LEFT_UPPER: ((22.0, 2.0, -54.0), (34.0, -14.0, -44.0), (50.0, -24.0, -28.0)),
    LEFT_LOWER: ((24.0, 12.0, -62.0), (34.0, 20.0, -70.0), (44.0, 32.0, -78.0)),
}
ATRIUM_LPS = (5.0, 8.0, -60.0)
FAR_SHARE = 0.5
"""Veins grow in the half of a lobe that is farther from airways: they run between segments."""
NEIGHBOURS = 12
"""Enough of the nearest balls that the one whose surface is nearest is among them."""


@frozen_record
class Obstacles:
    """Balls that vessels keep away from: centres `(N, 3)` LPS mm, radii `(N,)` mm."""

    centres: Float
    radii: Float

    def clearance(self) -> Clearance:
        """Return the function that tells how far (mm) points `(N, 3)` are from the nearest ball."""
        from scipy.spatial import cKDTree

        finder = cKDTree(self.centres)

        def distance_mm(points: Float) -> Float:
            distance, nearest = finder.query(points, k=NEIGHBOURS // 2)
            return np.asarray((distance - self.radii[nearest]).min(axis=1))

        return distance_mm


def _beside(line: Float, start_offset: Float, end_offset: Float) -> Float:
    """Return `line` `(K, 3)` shifted sideways, from the first offset vector to the last, never nearer."""
    t = np.linspace(0, 1, len(line))[:, None]
    sizes = np.linalg.norm(start_offset), np.linalg.norm(end_offset)
    quick = np.exp(-3 * t) - t * np.exp(-3)
    size = sizes[1] + (sizes[0] - sizes[1]) * quick
    side = unit((1 - t) * unit(start_offset) + t * unit(end_offset))
    tangent = unit(np.gradient(line, axis=0))
    middle = 4 * t * (1 - t)
    side = unit(side - middle * (side * tangent).sum(axis=1, keepdims=True) * tangent)
    return np.asarray(line + size * side)


def copy_arteries(airways: Sprouts, outer_radius_mm: Float, radius_mm: Float, scale: float) -> Sprouts:
    """Lay an artery of `radius_mm` `(B,)` beside every airway of `outer_radius_mm` `(B,)`.

    Branch b runs beside airway b, except that 0, 1, 2 are the pulmonary trunk, the right and the left
    pulmonary artery.  A named artery changes to the other side of its airway where it would run into
    another airway.
    """
    clearance = Obstacles(
        centres=np.vstack(airways.points), radii=np.repeat(outer_radius_mm, airways.counts)
    ).clearance()
    # Arteries and airways share a sheath: about this much tissue lies between them.
    distance = outer_radius_mm + radius_mm + 0.5
    children = children_of(airways.parent)
    side = np.tile(np.array((0.0, -1.0, 0.0)), (len(children), 1))
    # The left artery runs above and behind its bronchus, the right one in front.
    side[LEFT_MAIN] = (0.3, 0.7, 0.65)
    arteries = Sprouts()
    for branch, line in enumerate(airways.points):
        parent = airways.parent[branch]
        reference = side[branch] if branch in CENTRAL_KNOTS else side[parent]
        # From the airway to the artery at its end, nearest the reference, across the children's plane.
        below = children[branch]
        if len(below) >= 2:
            normal = np.cross(airways.direction(below[0]), airways.direction(below[1]))
        else:
            tangent = unit(line[-1] - line[-2])
            normal = reference - (reference @ tangent) * tangent
        normal = normal if np.linalg.norm(normal) > 1e-6 else reference
        side[branch] = unit(normal) * (-1 if normal @ reference < 0 else 1)
        if branch in CENTRAL_KNOTS:
            knots = scale * np.array(CENTRAL_KNOTS[branch])
            goal = line[-1] + side[branch] * distance[branch]
            line = smooth_line(knots if branch == 0 else np.vstack([knots, goal]), STEP_MM)
        else:
            start = side[parent] * distance[parent]
            signs = (1, -1) if airways.name[branch] else (1,)
            lines = [_beside(line, start, sign * side[branch] * distance[branch]) for sign in signs]
            lacks = [overlap_mm(line_beside[1:], radius_mm[branch], clearance) for line_beside in lines]
            # An artery changes sides only where this share of its radius is gained: they rarely do.
            other = lacks[0] > lacks[-1] + 0.3 * radius_mm[branch]
            side[branch] *= signs[-1] if other else 1
            line = lines[-1] if other else lines[0]
            line[0] = arteries.points[parent][-1]
        # The artery beside RB6 is RA6, and that beside a lobar bronchus is called an artery.
        beside = re.sub(r"^(.)B(?=\d)", r"\1A", airways.name[branch])
        beside = beside.replace("bronchus", "artery").replace("bronchial", "arterial")
        name = CENTRAL_ARTERIES[branch] if branch in CENTRAL_KNOTS else beside
        arteries.add(parent, line, 2 * radius_mm[branch], airways.lobe[branch], name)
    return arteries


def grow_veins(
    territory: Territory, obstacles: Obstacles, rule: GrowthRule, scale: float, rng: np.random.Generator
) -> Sprouts:
    """Grow five lobar veins, from a stub in the left atrium, into the points farthest from `obstacles`."""
    from scipy.spatial import cKDTree

    veins = Sprouts()
    atrium = scale * np.array([ATRIUM_LPS, np.array(ATRIUM_LPS) + (0.0, 2.0, 0.0)])
    veins.add(-1, atrium, 1.6 * rule.root_diameter_mm, 0, "left atrium")
    away, _ = cKDTree(obstacles.centres).query(territory.points_lps)
    clearance = obstacles.clearance()
    for lobe, knots in LOBAR_VEINS.items():
        inside = territory.lobe_of_point == lobe
        if not inside.any():
            continue
        cloud = territory.points_lps[inside & (away > np.quantile(away[inside], 1 - FAR_SHARE))]
        line = smooth_line(np.vstack([atrium[-1], scale * np.array(knots)]), STEP_MM)
        local = replace(rule, total_points=max(1, round(FAR_SHARE * rule.total_points)))
        root = veins.add(0, line, local.diameter_mm(len(cloud)), lobe, "")
        grow(veins, root, cloud, local, territory, rng, clearance)
    return veins


def make_way(tree: Sprouts, radius_mm: Float, obstacles: Obstacles, gap_mm: float, fixed: int) -> Float:
    """Bend the branches of `tree` (radii `(B,)`) until they pass `obstacles`; the first `fixed` points stay.

    Positions move in place, branchings included.  Returned is the radius at every point `(N,)`: that of the
    branch, or less where it must squeeze through.
    """
    from scipy.spatial import cKDTree

    counts = tree.counts
    start = np.concatenate([[0], np.cumsum(counts)])
    position = np.vstack(tree.points)
    radius = np.repeat(radius_mm, counts)
    parents = np.array(tree.parent)
    owners = np.where(parents >= 0, start[parents + 1] - 1, 0)
    finder = cKDTree(obstacles.centres)
    watched = np.arange(fixed, len(position))
    # Where vessels still touch after so many rounds, they become thinner instead.
    for _ in range(60):
        distance, nearest = finder.query(position[watched], k=NEIGHBOURS)
        free = distance - obstacles.radii[nearest] - gap_mm
        worst = free.argmin(axis=1)
        rows = np.arange(len(watched))
        lack = np.maximum(radius[watched] - free[rows, worst], 0)
        if not lack.any():
            break
        away = unit(position[watched] - obstacles.centres[nearest[rows, worst]])
        shift = np.zeros_like(position)
        shift[watched] = lack[:, None] * away
        trouble = np.asarray(np.abs(shift).sum(axis=1) > 0)
        _settle(position, shift, start, owners, fixed)
        # Points that may be pushed by their neighbours in the next round.
        for _ in range(6):
            trouble = trouble | np.roll(trouble, 1) | np.roll(trouble, -1)
        watched = np.flatnonzero(trouble)
        watched = watched[watched >= fixed]
    distance, nearest = finder.query(position, k=NEIGHBOURS)
    clearance = (distance - obstacles.radii[nearest]).min(axis=1) - 0.5 * gap_mm
    for branch in range(len(counts)):
        tree.points[branch] = position[start[branch] : start[branch + 1]].copy()
    # A vessel keeps at least half of its radius where it must pass between others.
    return np.asarray(np.clip(clearance, 0.5 * radius, radius))


def _settle(position: Float, shift: Float, start: Int, owners: Int, fixed: int) -> None:
    """Apply shifts, smoothed along each branch, and join the branches again."""
    first, last = start[:-1], start[1:] - 1
    inner = np.ones(len(position), dtype=bool)
    inner[first] = inner[last] = False
    inner[:fixed] = False
    np.add.at(shift, owners[1:], 0.5 * shift[first[1:]])
    shift[:fixed] = 0
    position += 0.8 * shift
    middle = np.flatnonzero(inner)
    moved = np.abs(shift).sum(axis=1) > 0
    middle = middle[moved[middle] | moved[middle - 1] | moved[middle + 1]]
    position[middle] += 0.25 * (0.5 * (position[middle - 1] + position[middle + 1]) - position[middle])
    position[first[1:]] = position[owners[1:]]

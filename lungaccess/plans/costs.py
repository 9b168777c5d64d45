"""What devices in tissue cost in a lung: the path of the needle, or without one of the tubes, and both."""

from collections.abc import Mapping, Sequence

from anatomy.base.typed import Float
from anatomy.lung import Lung
from anatomy.structures import obstacle_bits
from lungaccess.plans.curves import pieces_beyond
from stages import needle
from stages.needle import TERMS, ArcPath, InTissue, Objective, Obstacles, Term


def path_cost(
    lung: Lung,
    path: ArcPath,
    objective: str | Objective,
    *,
    with_fissures: bool,
    wall_mm: float = 0.0,
    parts: Sequence[InTissue] | None = None,
) -> float:
    """Return the cost of a path under an objective.

    Args:
        lung: Without a cost map, the costs of the map are 0.
        objective: See `stages.needle.objective.Objective.of`.
        wall_mm: Length at the beginning of the path that lies in the wall which the tubes pierce.  The costs
            of the map, which forbids walls, count beyond it.
        parts: All that lies in tissue, the path too; see `lungaccess.plans.candidate.parts_in_tissue`.  None
            where that is not known, and the objective does not weigh it.
    """
    weighed = Objective.of(objective)
    terms = [term for term, _weight in weighed.weighed]
    return weighed.total(_costs(lung, path, terms, with_fissures, wall_mm, parts))


def path_costs(
    lung: Lung,
    path: ArcPath,
    *,
    with_fissures: bool,
    wall_mm: float = 0.0,
    parts: Sequence[InTissue] | None = None,
) -> dict[str, float]:
    """Return every cost of a path by its key; see `path_cost`.

    A cost of all in tissue is left out where nothing is said of that.
    """
    terms = [term for term in TERMS if parts is not None or not term.of_all]
    return _costs(lung, path, terms, with_fissures, wall_mm, parts)


def _costs(
    lung: Lung,
    path: ArcPath,
    terms: Sequence[Term],
    with_fissures: bool,
    wall_mm: float,
    parts: Sequence[InTissue] | None,
) -> dict[str, float]:
    obstacles, beyond = _obstacles(lung, with_fissures), path_beyond(path, wall_mm)
    found: dict[str, float] = {}
    for term in terms:
        found |= needle.path_costs(obstacles, lung.cost, beyond if term.of_map else path, parts or [], [term])
    return found


def path_beyond(path: ArcPath, begin_mm: float) -> ArcPath:
    """Return what lies beyond a length of a path: nearly nothing of it where that is its end or farther."""
    if begin_mm <= 0.0:
        return path
    # So much of a path is left where all of it lies in the wall: the voxel of its end still counts.
    start, arcs = pieces_beyond(path.lps_from_start, path.arcs, min(begin_mm, path.length_mm - 1e-6))
    return ArcPath(lps_from_start=start, arcs=arcs)


def known_costs(stated: Mapping[str, float], *, has_map: bool) -> dict[str, float | None]:
    """Return stated costs, None for those of the cost map where there is no map: plans state them as 0."""
    unknown = {term.key for term in TERMS if term.of_map and not has_map}
    return {name: None if name in unknown else float(cost) for name, cost in stated.items()}


def costs_in_words(known: Mapping[str, float | None]) -> list[tuple[str, str]]:
    """Return what people call each cost, with its unit, and its value; costs that are None are left out."""
    words = {term.key: term.words_with_unit for term in TERMS}
    return [
        (words.get(name) or Objective.of(name).words, f"{cost:.4g}")
        for name, cost in known.items()
        if cost is not None
    ]


def obstacle_clearance_mm(lung: Lung, points: Float, *, with_fissures: bool) -> Float:
    """Return the distance `(N,)` in mm from points to the nearest obstacle, voxels as solid boxes."""
    return needle.obstacle_clearance_mm(_obstacles(lung, with_fissures), points)


def _obstacles(lung: Lung, with_fissures: bool) -> Obstacles:
    """Return the arrays of a lung as a `NeedleEnvironment` holds them."""
    bits = obstacle_bits(with_fissures)
    field = lung.obstacle_field(with_fissures=with_fissures)
    return Obstacles(field.corners, lung.labels, lung.geometry, bits)

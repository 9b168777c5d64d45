"""What a needle path costs in a lung."""

from __future__ import annotations

from collections.abc import Mapping

from anatomy.lung import Lung
from anatomy.structures import obstacle_bits
from anatomy.typed import Float
from stages import needle
from stages.needle import TERMS, ArcPath, Objective, Obstacles


def path_cost(lung: Lung, path: ArcPath, objective: str | Objective, *, with_fissures: bool) -> float:
    """Return the cost of a needle path under an objective.

    Parameters
    ----------
    lung : Lung
        Without a cost map, the costs of the map are 0.
    objective : str or Objective
        See `stages.needle.objective.Objective.of`.
    with_fissures : bool
        Whether fissures are obstacles.
    """
    weighed = Objective.of(objective)
    terms = [term for term, _weight in weighed.weighed]
    return weighed.total(needle.path_costs(_obstacles(lung, with_fissures), lung.cost, path, terms))


def path_costs(lung: Lung, path: ArcPath, *, with_fissures: bool) -> dict[str, float]:
    """Return every cost of a needle path by its key; see `path_cost`."""
    return needle.path_costs(_obstacles(lung, with_fissures), lung.cost, path)


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

"""What a plan is to keep small: the costs that there are, and their weighted sum."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.records import frozen_value
from anatomy.base.typed import Float32
from anatomy.base.words import did_you_mean
from anatomy.grid import read_only

if TYPE_CHECKING:
    from stages.needle.kernels.cost import ObjectiveArrays

MAX_CLEARANCE_MM = 256.0
"""No clearance field holds more, so that 1 / clearance has a least value."""

DEFAULT = "default"
"""The objective of whoever states none: far from obstacles, and from thin vessels where there is a map."""

NO_MAP = read_only(np.zeros((2, 2, 2), dtype=np.float32, order="F"))
"""Stands for a map that is not looked at, of the type of all maps: the kernels are compiled once."""


@frozen_value
class Term:
    """One cost of a plan, which an objective can weigh.

    Args:
        key: What plans, results and files call it.
        weight: The field of `Objective` that weighs it.
        words: What people call it.
        unit: "" for a pure number, or the unit of the cost map.
        of_map: Whether it is a cost of the map, so that there is none without a map.
        of_all: Whether it is of all that lies in tissue, the tubes too, and not of the needle's path alone.
    """

    key: str
    weight: str
    words: str
    unit: str = ""
    of_map: bool = False
    of_all: bool = False

    @property
    def option(self) -> str:
        """What the command line calls it."""
        return self.weight.replace("_", "-")

    @property
    def words_with_unit(self) -> str:
        """The words for figures and tables."""
        return f"{self.words} ({self.unit})" if self.unit else self.words


TERMS = (
    Term(key="inverse_clearance", weight="inverse_clearance", words="nearness to obstacles along the path"),
    Term(key="cost_map", weight="cost_map", words="cost map along the path", unit="mm", of_map=True),
    Term(key="voxel_sum", weight="voxel_sum", words="cost map of the voxels passed", of_map=True),
    Term(key="length_mm", weight="length", words="length of the path", unit="mm"),
    Term(
        key="tissue", weight="tissue", words="nearness to obstacles of all in tissue", unit="mm", of_all=True
    ),
)
"""Every cost of a plan."""

_BY_NAME = {name: term for term in TERMS for name in (term.key, term.option, term.weight)}


@frozen_value
class Objective:
    """A weighted sum of costs of a plan.

    The text of an objective is the key of a cost, or a sum such as ``cost_map=0.5,length_mm=1``; `of` reads
    it and `str` writes it.  Raises SettingsError if a weight is negative or not finite, or all are 0.

    Args:
        inverse_clearance: Weight of the integral of 1 / clearance over arc length [Kuntz2015, eq. 1].
        cost_map: Weight of the line integral of the cost map, 1/mm.
        length: Weight of the length, 1/mm.
        voxel_sum: Weight of the sum of the cost map over the set of voxels that the path crosses, each
            counted once [Fu2018, eq. 1].  The searches add it up arc by arc: a voxel that the path leaves and
            meets again on another arc counts again, which `stages.needle.costs.voxel_sum` does not.
        tissue: Weight of the integral, over tubes and needle in tissue, of their width times the sum of 1 /
            clearance and the cost map, 1/mm; see `stages.needle.costs.tissue`.

    Examples:
        >>> str(Objective(length=1.0))
        'length_mm'
        >>> str(Objective.of("length=1, cost-map=0.5"))
        'cost_map=0.5,length_mm=1'
    """

    inverse_clearance: float = 0.0
    cost_map: float = 0.0
    length: float = 0.0
    voxel_sum: float = 0.0
    tissue: float = 0.0

    def __post_init__(self) -> None:
        weights = np.array([getattr(self, term.weight) for term in TERMS])
        if not (np.isfinite(weights).all() and (weights >= 0.0).all() and weights.any()):
            raise SettingsError(
                f"The weights of an objective are {weights.tolist()}",
                expected="weights of 0 or more, one of them more than 0",
                remedy="State weights such as length=1,cost-map=0.5",
            )

    @classmethod
    def of(cls, stated: str | Objective) -> Objective:
        """Return the objective that a text states, or the objective itself.

        The text names costs, each with its weight after "=", separated by commas.  A cost is named by its key
        (``length_mm``) or as on the command line (``length``); a name alone has the weight 1.  "default" is
        ``inverse_clearance=1,cost_map=1``.

        Raises:
            SettingsError: If there is no such cost, one is named twice, or a weight is no number >= 0.
        """
        if isinstance(stated, Objective):
            return stated
        if stated == DEFAULT:
            # A mm in a thin vessel costs as much as one at 1 mm from an obstacle: hardly any axis is nearer.
            return cls(inverse_clearance=1.0, cost_map=1.0)
        weights: dict[str, float] = {}
        for part in stated.split(","):
            name, equals, weight = (word.strip() for word in part.partition("="))
            term = _term(name)
            if term.weight in weights:
                raise SettingsError(
                    f"The objective {stated!r} names {name} twice",
                    expected="each cost once",
                    remedy="Leave one of them out",
                )
            weights[term.weight] = _number(weight, stated) if equals else 1.0
        return cls(**weights)

    def __str__(self) -> str:
        """Return the text from which `of` restores the objective without loss."""
        weighed = self.weighed
        if len(weighed) == 1 and weighed[0][1] == 1.0:
            return weighed[0][0].key
        return ",".join(f"{term.key}={weight!r}".removesuffix(".0") for term, weight in weighed)

    @property
    def weighed(self) -> tuple[tuple[Term, float], ...]:
        """The costs that it weighs, with their weights."""
        pairs = ((term, float(getattr(self, term.weight))) for term in TERMS)
        return tuple((term, weight) for term, weight in pairs if weight > 0.0)

    @property
    def words(self) -> str:
        """What figures and tables call its cost, with the unit of a single one."""
        weighed = self.weighed
        if len(weighed) == 1 and weighed[0][1] == 1.0:
            return weighed[0][0].words_with_unit
        return " + ".join(f"{weight:g} x {term.words}".removeprefix("1 x ") for term, weight in weighed)

    @property
    def weighs_map(self) -> bool:
        """Whether it needs a cost map."""
        return any(term.of_map for term, _weight in self.weighed)

    @property
    def looks_at_map(self) -> bool:
        """Whether a cost map, where there is one, counts for it."""
        return self.weighs_map or self.tissue > 0.0

    @property
    def is_length(self) -> bool:
        """Whether it weighs nothing but length."""
        return self.weighed == ((_BY_NAME["length"], self.length),)

    @property
    def without_map(self) -> Objective:
        """The objective where there is no cost map: every cost of a map is 0, so that none is weighed.

        One that weighs nothing else becomes the length.
        """
        if all(term.of_map for term, _weight in self.weighed):
            return SHORTEST
        return replace(self, **{term.weight: 0.0 for term in TERMS if term.of_map})

    def total(self, costs: Mapping[str, float]) -> float:
        """Return the weighted sum of the costs of a plan, given by their keys."""
        return sum(weight * costs[term.key] for term, weight in self.weighed)

    def stated(self, costs: Mapping[str, float]) -> dict[str, float]:
        """Return the costs of a plan by their keys, and their weighted sum by the text of the objective."""
        return {**costs, str(self): self.total(costs)}

    def arrays(self, cost_map: Float32 | None, width_mm: float) -> ObjectiveArrays:
        """Return the weights and the map for the kernels, see `stages.needle.kernels.cost`.

        They are those of a needle, which is `width_mm` wide everywhere; an infinite cost is an obstacle.  The
        least cost of a mm is a proved lower bound.  The voxel sum adds nothing to it: however small the cost,
        an arc can be so short that it enters no other voxel.  Raises SettingsError if the objective weighs a
        map, and there is none, or one with negative costs, NaN, or no finite cost.
        """
        if self.weighs_map and cost_map is None:
            raise SettingsError(
                "The objective weighs a cost map, but the patient has none",
                expected="a patient with a cost map, or another objective",
                remedy="Choose inverse-clearance or length",
            )
        return _arrays(
            cost_map if self.looks_at_map else None,
            inverse_clearance=float(self.inverse_clearance + self.tissue * width_mm),
            map_integral=float(self.cost_map + self.tissue * width_mm),
            length=float(self.length),
            voxel_sum=float(self.voxel_sum),
        )

    def arrays_of_tubes(self, cost_map: Float32 | None) -> ObjectiveArrays:
        """Return what tubes in tissue cost for each mm of their width, for the kernels as `arrays` does."""
        weight = float(self.tissue)
        return _arrays(cost_map if weight > 0.0 else None, inverse_clearance=weight, map_integral=weight)


def _arrays(
    cost_map: Float32 | None,
    *,
    inverse_clearance: float,
    map_integral: float,
    length: float = 0.0,
    voxel_sum: float = 0.0,
) -> ObjectiveArrays:
    """Return weights for the kernels; those of the map are 0 where none is looked at."""
    from stages.needle.kernels.cost import ObjectiveArrays

    least_of_map = 0.0
    if cost_map is None:
        cost_map, map_integral = NO_MAP, 0.0
    else:
        cost_map = read_only(np.asfortranarray(cost_map, dtype=np.float32))
        least_of_map = float(cost_map.min())
        if not 0.0 <= least_of_map < np.inf:
            raise SettingsError(
                f"The least cost of the cost map is {least_of_map:g}",
                expected="costs of 0 or more, some of them finite, and no NaN",
                remedy="Correct the cost map of the patient",
            )
    return ObjectiveArrays(
        inverse_clearance=inverse_clearance,
        map_integral=map_integral,
        length=length,
        voxel_sum=voxel_sum,
        least_rate=inverse_clearance / MAX_CLEARANCE_MM + map_integral * least_of_map + length,
        cost_map=cost_map,
    )


def _term(name: str) -> Term:
    if name in _BY_NAME:
        return _BY_NAME[name]
    options = [term.option for term in TERMS]
    raise SettingsError(
        f"There is no objective {name!r}",
        expected=f"one of {DEFAULT}, {', '.join(options)}, or a weighted sum such as length=1,cost-map=0.5",
        remedy=did_you_mean(name, [DEFAULT, *options]) or "Choose one of them",
    )


def _number(weight: str, stated: str) -> float:
    try:
        return float(weight)
    except ValueError:
        raise SettingsError(
            f"{weight!r} in the objective {stated!r} is not a number",
            expected="a weight of 0 or more",
            remedy="State weights such as length=1,cost-map=0.5",
        ) from None


SHORTEST = Objective(length=1.0)
"""The length of the path alone."""

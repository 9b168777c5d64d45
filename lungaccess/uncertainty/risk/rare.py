"""Probabilities too small to be counted, by importance sampling.

All errors of a draw are functions of independent standard normal numbers z, one row a draw.  What seldom
happens is looked for among numbers of twice the spread.  Of what is found, the rows nearest to the origin are
moved towards it as far as it still happens: there it is most probable.  The numbers are then drawn from a
mixture of normal distributions about these centres and, with the share DEFENSIVE, about the origin, so that
no draw weighs more than 1 / DEFENSIVE [Hesterberg1995].  Each draw has the weight of its density over that of
the mixture, so that the estimate has no bias wherever the centres are; they only decide how exact it is.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Bool, Float
from lungaccess.problem.errors import ErrorModel
from lungaccess.uncertainty.risk.draws import Draws
from lungaccess.uncertainty.risk.statistics import Z_95

RARE = 1e-3
"""Below it ten thousand draws count fewer than ten events: their number is then known to a third at best."""
DEFENSIVE = 0.2
"""Share of the draws that are plain ones."""
SPREADS = (2.0, 3.0, 4.0)
"""Spreads of the numbers in which events are looked for, the next one if there were fewer than ENOUGH."""
ENOUGH = 20
"""Events that show where it happens."""
EXACT = 30
"""Effective events from which the normal approximation is usually taken to hold."""
HALVINGS = 12
"""Of the way to the origin; the rest is a thousandth of it."""


@frozen_value
class RareShare:
    """A probability estimated with weights.

    Args:
        interval ((float, float)): 95 % by the normal approximation of the mean of the weights.
        effective_samples: So many equal weights are as exact: the squared sum of the weights of the events
            over the sum of their squares [Kong1992].
        samples: Draws, those in which the centres were looked for not counted.
        centres: Of the mixture; with 0 nothing was found, and all draws are plain.
    """

    value: float
    interval: tuple[float, float]
    effective_samples: float
    samples: int
    centres: int

    @property
    def is_exact(self) -> bool:
        """Whether enough was found to believe the interval: else it may happen where nobody looked."""
        return self.centres > 0 and self.effective_samples >= EXACT


def rare_share(happens: Callable[[Float], Bool], dimensions: int, samples: int, seed: int) -> RareShare:
    """Return the probability of an event of standard normal numbers.

    Args:
        happens: Takes `(N, dimensions)` float64 and tells in which rows it happens, `(N,)`.
        samples: Draws from the mixture, and as many to look for centres with each of `SPREADS`.
    """
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 2])))
    centres = _centres(happens, dimensions, samples, rng)
    shares = np.array([DEFENSIVE, *([(1.0 - DEFENSIVE) / max(len(centres), 1)] * len(centres))])
    shares /= shares.sum()
    means = np.vstack([np.zeros(dimensions), *centres])
    # So many draws of each part, not a random number of them.
    parts = np.repeat(
        np.arange(len(means)), np.diff(np.round(np.cumsum([0.0, *shares]) * samples).astype(int))
    )
    drawn = rng.standard_normal((len(parts), dimensions)) + means[parts]
    # Densities over that of the standard normal distribution.
    over = np.exp(drawn @ means.T - 0.5 * (means**2).sum(axis=1)) @ shares
    weights = np.where(happens(drawn), 1.0 / over, 0.0)
    value = float(weights.mean())
    spread = Z_95 * float(weights.std()) / math.sqrt(len(weights))
    squares = float((weights**2).sum())
    return RareShare(
        value=value,
        interval=(max(value - spread, 0.0), value + spread),
        effective_samples=float(weights.sum()) ** 2 / squares if squares else 0.0,
        samples=len(weights),
        centres=len(centres),
    )


def _centres(
    happens: Callable[[Float], Bool], dimensions: int, samples: int, rng: np.random.Generator
) -> list[Float]:
    """Return where it happens nearest to the origin, in several directions."""
    found = np.zeros((0, dimensions))
    for spread in SPREADS:
        tried = spread * rng.standard_normal((samples, dimensions))
        found = np.concatenate([found, tried[happens(tried)]])
        if len(found) >= ENOUGH:
            break
    # Events, the nearest ones, that are moved towards the origin.
    nearest = found[np.argsort(np.linalg.norm(found, axis=1), kind="stable")[:256]]
    if not len(nearest):
        return []
    for column in range(dimensions):
        # What does not matter is left out.
        without = nearest.copy()
        without[:, column] = 0.0
        nearest = np.where(happens(without)[:, None], without, nearest)
    low, high = np.zeros(len(nearest)), np.ones(len(nearest))
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        inside = happens(middle[:, None] * nearest)
        low, high = np.where(inside, low, middle), np.where(inside, middle, high)
    nearest = high[:, None] * nearest
    chosen: list[Float] = []
    for row in nearest[np.argsort(np.linalg.norm(nearest, axis=1), kind="stable")]:
        length = float(np.linalg.norm(row))
        # Cosine of the least angle between centres: nearer ones describe one way to fail.
        alike = any(row @ other > 0.8 * length * np.linalg.norm(other) for other in chosen)
        # Most centres of the mixture: one for each side from which a structure can be met.
        if length > 0.0 and not alike and len(chosen) < 32:
            chosen.append(row)
    return chosen


@dataclass(frozen=True)
class Luck:
    """The standard normal numbers that make the deviations of a plan, one row a draw."""

    draws: Callable[[int], Draws]
    model: ErrorModel

    @property
    def dimensions(self) -> int:
        """Numbers in a row."""
        return sum(math.prod(shape) for shape in self._shapes.values())

    @property
    def _shapes(self) -> dict[tuple[str, int], tuple[int, ...]]:
        return {key: values.shape[1:] for key, values in self.draws(1).numbers(self.model).items()}

    def event(self, happens: Callable[[Draws], Bool]) -> Callable[[Float], Bool]:
        """Return an event of draws as one of their numbers."""
        shapes = self._shapes

        def among(rows: Float) -> Bool:
            made, column = {}, 0
            for key, shape in shapes.items():
                width = math.prod(shape)
                made[key] = rows[:, column : column + width].reshape(len(rows), *shape)
                column += width
            return happens(self.draws(len(rows)).with_numbers(made)) if len(rows) else np.zeros(0, dtype=bool)

        return among

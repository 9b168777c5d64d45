"""The risk of a plan: how likely it succeeds, and what it may touch, when the devices deviate from it.

Probabilities too small to be counted are estimated by importance sampling.  All errors of a draw are
functions of independent standard normal numbers z, one row a draw.  What seldom happens is looked for among
numbers of twice the spread.  Of what is found, the rows nearest to the origin are moved towards it as far as
it still happens: there it is most probable.  The numbers are then drawn from a mixture of normal
distributions about these centres and, with the share DEFENSIVE, about the origin, so that no draw weighs more
than 1 / DEFENSIVE [Hesterberg1995].  Each draw has the weight of its density over that of the mixture, so
that the estimate has no bias wherever the centres are; they only decide how exact it is.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Bool, Float
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import BREATHING, CURVATURE, ErrorModel
from lungaccess.uncertainty.risk.assessor import RiskAssessor
from lungaccess.uncertainty.risk.deviations import FIELD_OF, Deviations, Draws
from lungaccess.uncertainty.risk.patient_errors import model_for
from lungaccess.uncertainty.risk.statistics import Z_95, Share, share_of

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


@frozen_value
class Sensitivity:
    """What one kind of error does to the success of a plan.

    Args:
        kind: See `lungaccess.problem.errors.UNITS`.
        alone: Successes with errors of this kind only.
        first_order: Share of the variance of success that this kind explains by itself [Saltelli2010]; near 0
            it may come out below 0.
        total: Share of the variance that goes with this kind, together with all others [Jansen1999].
        changes: Draws whose outcome changes if this kind alone is drawn again: `total` is this share over
            twice the variance.
    """

    kind: str
    alone: Share
    first_order: float
    total: float
    changes: Share


def sensitivities(
    assessor: RiskAssessor, model: ErrorModel, samples: int, seed: int, alone: Mapping[str, Share]
) -> tuple[Sensitivity, ...]:
    """Return the sensitivity of success to each kind of error that the model has, the greatest first.

    Success counts as 1 and failure as 0.  Where all draws succeed, or none, the indices are 0.

    Args:
        alone: Successes of the same draws with errors of one kind only, by kind.
    """
    kinds = [kind for kind in alone if model.term(kind).size]
    # The second set of numbers of [Saltelli2010], independent of the first, comes from the seed and this.
    second = int(np.random.SeedSequence([seed, 1]).generate_state(1)[0])
    first_draws, second_draws = assessor.draws(samples, seed), assessor.draws(samples, second)
    base, other = first_draws.deviations(model), second_draws.deviations(model)
    from_base, from_other = assessor.successes(base), assessor.successes(other)
    variance = float(np.concatenate([from_base, from_other]).astype(float).var())
    found = []
    for kind in kinds:
        own = first_draws.deviations(model.only(kind))
        outcome = assessor.successes(_with(base, kind, own, second_draws.deviations(model.only(kind))))
        changes = share_of(outcome != from_base)
        explained = float(np.mean(from_other * (outcome.astype(float) - from_base)))
        found.append(
            Sensitivity(
                kind=kind,
                alone=alone[kind],
                first_order=explained / variance if variance else 0.0,
                total=0.5 * changes.value / variance if variance else 0.0,
                changes=changes,
            )
        )
    return tuple(sorted(found, key=lambda each: -each.total))


def _with(base: Deviations, kind: str, own: Deviations, other: Deviations) -> Deviations:
    """Return deviations in which the part of one kind is that of others."""
    passes = zip(base.further, own.further, other.further, strict=True)
    base = replace(base, further=tuple(_with(one, kind, *two) for one, *two in passes))
    if kind == CURVATURE:
        return replace(base, factor=other.factor)
    fields = ["target_mm" if kind == BREATHING else FIELD_OF[kind]]
    if kind == "tube_rotation":
        fields.append("relative_rad")
    changed: dict[str, Float] = {}
    for name in fields:
        # Errors of several kinds add up in one field.
        changed[name] = getattr(base, name) - getattr(own, name) + getattr(other, name)
    return replace(base, **changed)


DEFAULT_SAMPLES = 10_000
"""A share of one half is then known to 1 % with 95 % confidence, and a report takes some seconds."""
MISS_QUANTILES = (0.5, 0.9, 0.95)
"""The median, and the two quantiles by which accuracy is usually stated."""


MISSES = "misses the goal"
"""A draw whose needle, or without one whose tubes, end farther than the radius of the goal from the target,
or with too little of the nodule in the tool."""


@frozen_value
class DrawnReport:
    """What came of a plan in many draws of an error model.

    Args:
        radius_mm, radius_origin: Radius of the goal about the target, and where the radius came from; of a
            tool, which nodule counts.
        succeeds: Ends within the radius, or with enough of the nodule in the tool, leaves the airway, and
            touches nothing that is forbidden.
        touches: By the names of `STRUCTURES`; a fissure only where there is a mask of them.
        miss_mm: Distance of the tip, or of the middle of its tool, from the target that a share of the
            needles does not exceed, by the share.
        tissue: What has to be in the tool in words; empty without a tool: then the tip ends within the
            radius.
    """

    model: ErrorModel
    samples: int
    seed: int
    radius_mm: float
    radius_origin: str
    succeeds: Share
    touches: Mapping[str, Share]
    miss_mm: Mapping[float, float]
    tissue: str = ""
    with_needle: bool = True


@frozen_value
class RiskReport(DrawnReport):
    """The risk of one plan that is carried out as it stands.

    Args:
        reaches: Ends within the radius, or with enough of the nodule in the tool, whatever it touches.
        forbidden: The names of `touches` that a success must not have.
        alone: Successes if there were errors of one kind only, by kind; empty if that was not asked for.
        sensitivity: What each kind of error does to success, the greatest first; empty if that was not asked
            for.
        rare: Touches that happened in less than `RARE` of the draws, estimated with weights, where that is
            exact enough; empty if that was not asked for.
    """

    reaches: Share
    forbidden: tuple[str, ...]
    alone: Mapping[str, Share]
    sensitivity: tuple[Sensitivity, ...] = ()
    rare: Mapping[str, RareShare] = field(default_factory=lambda: MappingProxyType({}))

    @property
    def failures(self) -> tuple[tuple[str, Share], ...]:
        """What makes a draw fail, the most frequent first: `MISSES`, and the names of `forbidden`."""
        misses = Share(count=self.samples - self.reaches.count, samples=self.samples)
        shares = {MISSES: misses, **{name: self.touches[name] for name in self.forbidden}}
        return tuple(sorted(shares.items(), key=lambda item: -item[1].count))


def assess(
    plan: Plan,
    lung: Lung,
    *,
    model: ErrorModel | None = None,
    samples: int = DEFAULT_SAMPLES,
    seed: int = 0,
    radius_mm: float | None = None,
    each_kind: bool = True,
) -> RiskReport:
    """Return how likely a plan succeeds, and what it may touch, if the devices deviate from it.

    The plan's own system is deployed, in the lung that the plan was made for.  PlanFileError and
    SettingsError are raised as by `RiskAssessor`, also if there are no samples.

    Args:
        model: The preset `breath-hold` if None.  Where the patient's own breathing is known, it is that which
            is drawn: `lungaccess.uncertainty.risk.patient_errors.model_for` says how.
        seed: The same seed gives the same report.
        radius_mm: Radius of the goal; see `RiskAssessor`.
        each_kind: Whether success under errors of one kind only, sensitivities and rare touches are
            estimated, too: some thirty times the work.
    """
    stated = model_for(model or load_errors(), plan, lung)
    assessor = RiskAssessor(plan, lung, radius_mm=radius_mm)
    draws = assessor.draws(samples, seed)
    outcomes = assessor.outcomes(draws.deviations(stated))
    touched = {name: share_of((outcomes.touched & flag) != 0) for name, flag in assessor.structures.items()}
    kinds = assessor.kinds if each_kind else ()
    alone = {name: assessor.success(draws, stated.only(name)) for name in kinds}
    seldom = [name for name, share in touched.items() if each_kind and share.value < RARE]
    weighted = {name: rare_touch(assessor, stated, name, samples, seed) for name in seldom}
    return RiskReport(
        model=stated,
        samples=samples,
        seed=seed,
        radius_mm=assessor.radius_mm,
        radius_origin=assessor.radius_origin,
        succeeds=share_of(assessor.succeeded(outcomes)),
        reaches=share_of(outcomes.taken >= assessor.wanted.least),
        touches=MappingProxyType(touched),
        forbidden=assessor.forbidden,
        miss_mm=MappingProxyType({q: float(np.quantile(outcomes.miss_mm, q)) for q in MISS_QUANTILES}),
        alone=MappingProxyType(alone),
        tissue=assessor.tissue,
        with_needle=plan.needle is not None,
        sensitivity=sensitivities(assessor, stated, samples, seed, alone) if each_kind else (),
        rare=MappingProxyType({name: each for name, each in weighted.items() if each.is_exact}),
    )


def rare_touch(
    assessor: RiskAssessor, model: ErrorModel, structure: str, samples: int = DEFAULT_SAMPLES, seed: int = 0
) -> RareShare:
    """Return how likely one of `STRUCTURES` is touched, by importance sampling; errors of `assess`."""
    flag = assessor.structures[structure]
    luck = Luck(lambda count: assessor.draws(count, seed), model)
    happens = luck.event(lambda draws: (assessor.outcomes(draws.deviations(model)).touched & flag) != 0)
    return rare_share(happens, luck.dimensions, samples, seed)

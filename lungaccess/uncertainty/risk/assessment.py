"""The risk of a plan: how likely it succeeds, and what it may touch, when the devices deviate from it."""

from collections.abc import Mapping
from dataclasses import field, replace
from types import MappingProxyType

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import BREATHING, CURVATURE, ErrorModel
from lungaccess.uncertainty.risk.assessor import RiskAssessor
from lungaccess.uncertainty.risk.breathing import model_for
from lungaccess.uncertainty.risk.deviations import FIELD_OF, Deviations
from lungaccess.uncertainty.risk.rare import RARE, Luck, RareShare, rare_share
from lungaccess.uncertainty.risk.statistics import Share, share_of


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
    both = np.concatenate([from_base, from_other]).astype(float)
    variance = float(both.var())
    found = []
    for kind in kinds:
        own = first_draws.deviations(model.only(kind))
        mixed = _with(base, kind, own, second_draws.deviations(model.only(kind)))
        outcome = assessor.successes(mixed)
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

    The plan's own system is deployed, in the lung that the plan was made for.

    Args:
        model: The preset `breath-hold` if None.  Where the patient's own breathing is known, it is that which
            is drawn: `lungaccess.uncertainty.risk.breathing.model_for` says how.
        seed: The same seed gives the same report.
        radius_mm: Radius of the goal; see `RiskAssessor`.
        each_kind: Whether success under errors of one kind only, sensitivities and rare touches are
            estimated, too: some thirty times the work.

    Raises:
        PlanFileError, SettingsError: See `RiskAssessor`; also if there are no samples.
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

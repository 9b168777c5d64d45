"""Which errors decide about a plan: the effect of each kind alone, and together with the others."""

from dataclasses import replace

import numpy as np

from anatomy.base.records import frozen_value
from anatomy.base.typed import Float
from lungaccess.problem.errors import BREATHING, CURVATURE, ErrorModel
from lungaccess.uncertainty.risk.assessor import RiskAssessor
from lungaccess.uncertainty.risk.deviations import FIELD_OF, Deviations
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
    assessor: RiskAssessor, model: ErrorModel, samples: int, seed: int
) -> tuple[Sensitivity, ...]:
    """Return the sensitivity of success to each kind of error that the model has, the greatest first.

    Success counts as 1 and failure as 0.  Where all draws succeed, or none, the indices are 0.
    """
    kinds = [kind for kind in assessor.kinds if model.term(kind).size]
    # The second set of numbers of [Saltelli2010], independent of the first, comes from the seed and this.
    second = int(np.random.SeedSequence([seed, 1]).generate_state(1)[0])
    first_draws, second_draws = assessor.draws(samples, seed), assessor.draws(samples, second)
    base, other = first_draws.deviations(model), second_draws.deviations(model)
    from_base, from_other = assessor.successes(base), assessor.successes(other)
    both = np.concatenate([from_base, from_other]).astype(float)
    variance = float(both.var())
    found = []
    for kind in kinds:
        alone = first_draws.deviations(model.only(kind))
        mixed = _with(base, kind, alone, second_draws.deviations(model.only(kind)))
        outcome = assessor.successes(mixed)
        changes = share_of(outcome != from_base)
        explained = float(np.mean(from_other * (outcome.astype(float) - from_base)))
        found.append(
            Sensitivity(
                kind=kind,
                alone=share_of(assessor.successes(alone)),
                first_order=explained / variance if variance else 0.0,
                total=0.5 * changes.value / variance if variance else 0.0,
                changes=changes,
            )
        )
    return tuple(sorted(found, key=lambda each: -each.total))


def _with(base: Deviations, kind: str, own: Deviations, other: Deviations) -> Deviations:
    """Return deviations in which the part of one kind is that of others."""
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

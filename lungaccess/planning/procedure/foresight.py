"""What may become of deployments from a scope's tip as measured: the policy chooses by it."""

from __future__ import annotations

import numpy as np

from anatomy import poses
from anatomy.base.typed import Float, Int
from anatomy.lung import Lung
from lungaccess.planning.procedure.residuals import Residuals
from lungaccess.planning.procedure.settings import Procedure
from lungaccess.planning.procedure.spread import Spread
from lungaccess.uncertainty.risk import Deviations, ErrorModel, RiskAssessor
from lungaccess.uncertainty.risk.deviations import ROUNDING_MM, in_rows, no_deviations, tubes_alone
from stages.tube import Deployments

KEPT, DRAWS = 3, (8, 32)
"""All deployments are tried with the first few draws and the best of them with all: what is likely to fail
shows soon, and the chances of two tips are compared to some percent."""
_SEED = 1
"""Of the draws, which have nothing to do with those of a simulated procedure."""


class Foresight:
    """Estimates how likely deployments from a scope's tip succeed, from what errors are left after measuring.

    To first order, and for planar tubes, which go out blindly, by deviating them: the share of draws in which
    they touch nothing takes the place of its estimate.

    Attributes
    ----------
    best : float
        The chance of the best deployment that was foreseen last; 0 if there was none.

    Parameters
    ----------
    assessor : RiskAssessor
        Of the plan that is carried out.
    lung, errors, procedure
    """

    def __init__(self, assessor: RiskAssessor, lung: Lung, errors: ErrorModel, procedure: Procedure) -> None:
        self._assessor, self._lung, self._errors, self._procedure = assessor, lung, errors, procedure
        self.best = 0.0
        self._target = np.asarray(assessor.plan.target_lps)
        left, rng, count = Residuals.of(errors, procedure, 0.0), np.random.default_rng(_SEED), DRAWS[-1]
        drawn = {
            "scope_mm": left.scope_mm * rng.standard_normal((count, 3)),
            "tilt_rad": left.scope_rad * rng.standard_normal((count, 2)),
            "rotation_rad": left.rotation_rad * rng.standard_normal(count),
            "insertion_mm": left.insertion_mm * rng.standard_normal((count, 2)),
        }
        self._drawn = in_rows(Deviations(**(no_deviations(count, 0) | drawn)))

    def likely(self, tip: Float, deployments: Deployments) -> Float:
        """Return the chance of each of N deployments from a scope tip `(1, 9)` to first order, `(N,)`."""
        return self._spread(tip, deployments).chances

    def foreseen(self, tip: Float, deployments: Deployments) -> Float:
        """Return the same from draws; what is not among the best of few draws comes after all others."""
        spread, system = self._spread(tip, deployments), self._assessor.plan.system
        chances = spread.chances
        if system.tubes.planar and deployments.count:
            best, foreseen = self._tried(tip, deployments, spread.needle_chances)
            chances = chances - 1.0
            chances[best] = foreseen
        self.best = max(float(chances.max(initial=0.0)), 0.0)
        return chances

    def _spread(self, tip: Float, deployments: Deployments) -> Spread:
        return Spread(
            self._lung, self._assessor.plan.system, np.repeat(tip, deployments.count, axis=0), deployments,
            self._target, self._errors, self._procedure, self._assessor.radius_mm,
        )  # fmt: skip

    def _tried(self, tip: Float, deployments: Deployments, of_needle: Float) -> tuple[Int, Float]:
        """Return the best deployments by deviating their tubes, and their chances."""
        system, frame = self._assessor.plan.system, poses.pose(tip[0, :3], tip[0, 3:6], tip[0, 6:])
        depth = float(self._lung.lumen_depth.lower_bound_mm(tip[:, :3])[0])
        least_mm = min(system.scope.radius_mm, depth) - ROUNDING_MM
        best = np.arange(deployments.count)
        for count in DRAWS:
            tubes = [tubes_alone(system.tubes, frame, deployments.choice(n)[:3]) for n in best.tolist()]
            clear = [self._assessor.clear(each, self._drawn[:count], least_mm).mean() for each in tubes]
            foreseen = of_needle[best] * clear
            order = np.argsort(-foreseen, kind="stable")[:KEPT]
            best, foreseen = best[order], foreseen[order]
        return best, foreseen

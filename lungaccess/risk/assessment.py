"""Tolerance and risk of a plan: what happens when the devices deviate from it, by compiled Monte Carlo."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from anatomy.errors import PlanFileError, SettingsError
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL, obstacle_bits
from anatomy.typed import Bool, Float, Int
from lungaccess.plans.plan import Plan
from lungaccess.risk.errors import (
    CURVATURE,
    TUBE_PIECES,
    UNITS,
    Deviations,
    Draws,
    ErrorModel,
    deviated_pieces,
    deviated_starts,
)
from lungaccess.risk.kernels import deviation as kernel

STRUCTURES: dict[str, int] = {
    "vessel": VESSEL,
    "pleura": OUTSIDE,
    "fissure": FISSURE,
    "airway": AIRWAY,
    "stays in the airway": kernel.STAYS_INSIDE,
}
"""What can go wrong before the end, and the flag that the kernel sets for it."""

DEFAULT_RADIUS_MM = 5.0
"""Radius of the goal where the target is no nodule of the nodule mask: one of 10 mm."""
DEFAULT_SAMPLES = 10_000
THREADS = 2
MISS_QUANTILES = (0.5, 0.9, 0.95)
Z_95 = 1.959963984540054
"""Two-sided 95 % quantile of the normal distribution."""


@dataclass(frozen=True, kw_only=True)
class Share:
    """How many of a number of samples, and what that says of the probability.

    Parameters
    ----------
    count, samples : int
    """

    count: int
    samples: int

    @property
    def value(self) -> float:
        """The share."""
        return self.count / self.samples

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % confidence interval of [Wilson1927]."""
        share, z2 = self.count / self.samples, Z_95 * Z_95
        middle = (share + 0.5 * z2 / self.samples) / (1.0 + z2 / self.samples)
        half = Z_95 * math.sqrt(share * (1.0 - share) / self.samples + 0.25 * z2 / self.samples**2)
        half /= 1.0 + z2 / self.samples
        return max(middle - half, 0.0), min(middle + half, 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcomes:
    """What became of N deviated plans.

    Parameters
    ----------
    touched : (N,) int64
        Flags of `STRUCTURES`.
    miss_mm : (N,) float64
        Distance of the needle's tip from the deviated target.
    """

    touched: Int
    miss_mm: Float


@dataclass(frozen=True, kw_only=True)
class RiskReport:
    """The risk of one plan under an error model.

    Parameters
    ----------
    model : ErrorModel
    samples, seed : int
    radius_mm : float
        Radius of the goal about the target.
    radius_origin : str
        Where the radius came from.
    succeeds : Share
        Ends within the radius, leaves the airway, and touches nothing that is forbidden.
    reaches : Share
        Ends within the radius, whatever it touches.
    touches : mapping of str to Share
        By the names of `STRUCTURES`; a fissure only where there is a mask of them.
    forbidden : tuple of str
        The names of `touches` that a success must not have.
    miss_mm : mapping of float to float
        Distance of the tip from the target that a share of the samples does not exceed, by the share.
    alone : mapping of str to Share
        Successes if there were errors of one kind only, by kind.
    """

    model: ErrorModel
    samples: int
    seed: int
    radius_mm: float
    radius_origin: str
    succeeds: Share
    reaches: Share
    touches: Mapping[str, Share]
    forbidden: tuple[str, ...]
    miss_mm: Mapping[float, float]
    alone: Mapping[str, Share]


class RiskAssessor:
    """A plan in its lung, ready to be deviated from.

    Parameters
    ----------
    plan : Plan
    lung : Lung
    radius_mm : float, optional
        Radius of the goal; by default that of a ball of the volume of the target's nodule, or 5 mm if the
        target lies in no nodule of the mask.

    Raises
    ------
    PlanFileError
        If the plan was made for another lung.
    SettingsError
        If the radius is not above 0 and finite, or the plan has no needle.
    """

    def __init__(self, plan: Plan, lung: Lung, *, radius_mm: float | None = None) -> None:
        if plan.lung_key != lung.key:
            raise PlanFileError(
                f"The plan was made for {plan.patient_name}, not for {lung.name}",
                expected=f"a plan for the lung {lung.key}, this one is for {plan.lung_key}",
                remedy="Give the folder of the patient, with the masks that the plan was made for",
            )
        if radius_mm is not None and not 0.0 < radius_mm < math.inf:
            raise SettingsError(
                f"The radius of the goal is {radius_mm} mm", expected="a finite length above 0"
            )
        if not plan.needle.arcs:
            raise SettingsError("The needle of the plan has no arc", expected="at least one arc")
        self.plan = plan
        self.n_arcs = len(plan.needle.arcs)
        self.radius_mm, self.radius_origin = (
            goal_radius(lung, plan) if radius_mm is None else (float(radius_mm), "given")
        )
        bits = obstacle_bits(lung.has_fissures)
        field = lung.obstacle_field(with_fissures=True)
        self._scene = (field.corners, lung.labels, field.geometry, bits)
        self._depth = (lung.lumen_depth.corners, lung.lumen_depth.geometry)
        self._mediastinal = lung.tree.mediastinal
        self.structures = {
            name: flag for name, flag in STRUCTURES.items() if flag != FISSURE or lung.has_fissures
        }
        self.forbidden = tuple(
            name for name in self.structures if name != "fissure" or plan.fissures_are_obstacles
        )
        self._forbidden_flags = sum(self.structures[name] for name in self.forbidden)

    def outcomes(self, deviations: Deviations) -> Outcomes:
        """Follow deviated plans through all three stages."""
        starts, pieces = deviated_starts(self.plan, deviations), deviated_pieces(self.plan, deviations)
        touched, ends = np.zeros(deviations.count, dtype=np.int64), np.zeros((deviations.count, 3))
        exempt_mm = float(self.plan.exemption.needle_length_mm)

        def follow(part: slice) -> None:
            kernel.follow(
                self._scene, self._depth, self._mediastinal, starts[part], pieces[part], TUBE_PIECES,
                exempt_mm, touched[part], ends[part],
            )  # fmt: skip

        bounds = np.linspace(0, deviations.count, THREADS + 1).astype(int)
        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(follow, (slice(a, b) for a, b in zip(bounds, bounds[1:], strict=False))))
        targets = self.plan.target_lps + deviations.target_mm
        return Outcomes(touched=touched, miss_mm=np.linalg.norm(ends - targets, axis=1))

    def succeeded(self, outcomes: Outcomes) -> Bool:
        """Tell which `(N,)` end within the radius, leave the airway and touch nothing forbidden."""
        return np.asarray(
            (outcomes.miss_mm <= self.radius_mm) & ((outcomes.touched & self._forbidden_flags) == 0)
        )

    def success(
        self, draws: Draws, sizes: Mapping[str, float], factors: tuple[float, float] = (1.0, 1.0)
    ) -> Share:
        """Return the share of successes under errors of given sizes, see `Draws.scaled`."""
        done = self.succeeded(self.outcomes(draws.scaled(sizes, factors)))
        return _share(done)

    def report(self, model: ErrorModel, *, samples: int, seed: int) -> RiskReport:
        """Return the risk; see `assess`."""
        if samples < 1:
            raise SettingsError(f"The number of samples is {samples}", expected="at least 1")
        draws = Draws(samples, self.n_arcs, seed)
        outcomes = self.outcomes(draws.scaled(model.sizes, model.curvature_factors))
        alone = {name: self.success(draws, *one_kind(model, name)) for name in UNITS}
        return RiskReport(
            model=model,
            samples=samples,
            seed=seed,
            radius_mm=self.radius_mm,
            radius_origin=self.radius_origin,
            succeeds=_share(self.succeeded(outcomes)),
            reaches=_share(outcomes.miss_mm <= self.radius_mm),
            touches=MappingProxyType(
                {name: _share((outcomes.touched & flag) != 0) for name, flag in self.structures.items()}
            ),
            forbidden=self.forbidden,
            miss_mm=MappingProxyType({q: float(np.quantile(outcomes.miss_mm, q)) for q in MISS_QUANTILES}),
            alone=MappingProxyType(alone),
        )


def _share(hits: Bool) -> Share:
    return Share(count=int(np.count_nonzero(hits)), samples=len(hits))


def one_kind(model: ErrorModel, name: str) -> tuple[dict[str, float], tuple[float, float]]:
    """Return sizes and factors of a model in which all errors but one kind are 0."""
    if name == CURVATURE:
        return {}, model.curvature_factors
    return {name: model.sizes[name]}, (1.0, 1.0)


def assess(
    plan: Plan,
    lung: Lung,
    *,
    model: ErrorModel | None = None,
    samples: int = DEFAULT_SAMPLES,
    seed: int = 0,
    radius_mm: float | None = None,
) -> RiskReport:
    """Return how likely a plan succeeds, and what it may touch, if the devices deviate from it.

    Parameters
    ----------
    plan : Plan
        Its own system is deployed.
    lung : Lung
        The one that the plan was made for.
    model : ErrorModel, optional
        The default one if None.
    samples : int
        Number of deviated plans.
    seed : int
        The same seed gives the same report.
    radius_mm : float, optional
        Radius of the goal; see `RiskAssessor`.

    Raises
    ------
    PlanFileError, SettingsError
        See `RiskAssessor`; also if there are no samples.
    """
    assessor = RiskAssessor(plan, lung, radius_mm=radius_mm)
    return assessor.report(model or ErrorModel(), samples=samples, seed=seed)


def safest(
    plans: Iterable[Plan],
    lung: Lung,
    *,
    model: ErrorModel | None = None,
    samples: int = DEFAULT_SAMPLES,
    seed: int = 0,
    radius_mm: float | None = None,
) -> tuple[tuple[Plan, Share], ...]:
    """Return plans with their shares of successes, the safest first; equal ones keep their order.

    Parameters
    ----------
    plans : iterable of Plan
        All for one lung, such as those that `plan` yields.
    lung, model, samples, seed, radius_mm
        See `assess`.
    """
    stated = model or ErrorModel()
    judged = []
    for each in plans:
        assessor = RiskAssessor(each, lung, radius_mm=radius_mm)
        draws = Draws(samples, assessor.n_arcs, seed)
        judged.append((each, assessor.success(draws, stated.sizes, stated.curvature_factors)))
    return tuple(sorted(judged, key=lambda pair: -pair[1].value))


def goal_radius(lung: Lung, plan: Plan) -> tuple[float, str]:
    """Return the radius in mm of the ball as large as the target's nodule, and its origin in words."""
    nodules = lung.nodules
    inside = nodules is not None and bool(nodules.grid.contains(plan.target_lps))
    if nodules is not None and inside:
        i, j, k = np.floor(nodules.grid.ijk(plan.target_lps) + 0.5).astype(int)
        if nodules.array[i, j, k]:
            from scipy import ndimage

            parts, _count = ndimage.label(nodules.array, np.ones((3, 3, 3)))
            volume = float(np.count_nonzero(parts == parts[i, j, k])) * nodules.grid.voxel_volume_mm3
            return (0.75 * volume / math.pi) ** (1.0 / 3.0), "ball of the nodule's volume"
    return DEFAULT_RADIUS_MM, "assumed: the target lies in no nodule of a mask"

"""A plan in its lung, ready to be deviated from: what becomes of many deviated plans, compiled."""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple, Self

import numpy as np

from anatomy.base.errors import SettingsError
from anatomy.base.typed import Bool, Float, Int
from anatomy.lung import Lung
from anatomy.motion.source import share_of_motion
from anatomy.structures import AIRWAY, FISSURE, OUTSIDE, VESSEL, obstacle_bits
from lungaccess.plans.kernels.tissue import Wanted
from lungaccess.plans.plan import Plan
from lungaccess.plans.tissue import goal_radius, wanted_of
from lungaccess.problem.errors import OF_NEEDLE, UNITS, ErrorModel
from lungaccess.uncertainty.risk.deviations import DeviatedPlan, Deviations, Draws, judging, no_deviations
from lungaccess.uncertainty.risk.kernels import deviation as kernel
from lungaccess.uncertainty.risk.kernels.outcomes import find_outcomes, find_taken, follow_chains, keep_clear
from lungaccess.uncertainty.risk.patient_errors import PatientMotion
from lungaccess.uncertainty.risk.statistics import Share, share_of
from stages.needle import Obstacles

STRUCTURES: dict[str, int] = {
    "vessel": VESSEL,
    "pleura": OUTSIDE,
    "fissure": FISSURE,
    "airway": AIRWAY,
    "stays in the airway": kernel.STAYS_INSIDE,
}
"""What can go wrong before the end, and the flag that the kernel sets for it."""

THREADS = 2
"""The kernel holds no lock, and two cores are the least that a machine of today has."""


class Outcomes(NamedTuple):
    """What became of N deviated plans, `(N,)` each.

    Args:
        touched: Flags of `STRUCTURES`.
        miss_mm: How far the middle of the tool, or the last tip without one, is from the deviated target.
        taken: How much of the nodule is in the tool, see `wanted_of`.
        ends: (N, 9) float64; point, direction and normal of the last tip, LPS mm.
    """

    touched: Int
    miss_mm: Float
    taken: Float
    ends: Float

    @classmethod
    def unknown(cls, count: int) -> Self:
        """Return arrays for the outcomes of so many plans, which a kernel fills."""
        return cls(np.zeros(count, dtype=np.int64), np.zeros(count), np.zeros(count), np.zeros((count, 9)))


def taken_together(taken: Sequence[Float] | Float, wanted: Wanted) -> Float:
    """Return how much several passes take together, `(N,)`: of a share of the nodule, what the best takes.

    What two zones cover together is not known from their shares: the best of them is the least it can be.
    """
    return np.asarray(np.max(taken, axis=0) if len(wanted.covered) else np.sum(taken, axis=0))


def drawn_anew(plan: Plan) -> tuple[Mapping[str, int], ...]:
    """Return for each pass of a plan by kinds of error the pass whose numbers it has, 0 for the first.

    The scope stands, registration stays wrong and the breath goes on as it does: only errors of the needle
    are drawn in every pass, and those of the tubes where they have been moved.
    """
    return tuple(numbers_of_pass(number, tubes) for number, tubes in enumerate(plan.same_tubes))


def numbers_of_pass(number: int, tubes: int) -> dict[str, int]:
    """Return by kinds of error the pass whose numbers a pass has whose tubes were moved for another."""
    return dict.fromkeys(OF_NEEDLE, number) | dict.fromkeys(("tube_rotation", "tube_insertion"), tubes)


class RiskAssessor:
    """A plan in its lung, ready to be deviated from; of several passes all are.

    Attributes:
        kinds: The kinds of error that the devices of the plan can have, and that of the target.
        stretch: See `Draws`.
        radius_mm, radius_origin, tissue: See `DrawnReport`.

    Args:
        radius_mm: Radius of the goal; by default that of a ball of the volume of the target's nodule, or 5 mm
            if the target lies in no nodule of the mask.  A tool of the system takes tissue of that ball if a
            radius is given or there is no mask, else of the nodule.

    Raises:
        PlanFileError: If the plan was made for another lung.
        SettingsError: If the radius is not above 0 and finite, or the needle of the plan has no arc.
    """

    def __init__(self, plan: Plan, lung: Lung, *, radius_mm: float | None = None) -> None:
        plan.require_lung(lung)
        if plan.needle is not None and not plan.needle.arcs:
            raise SettingsError("The needle of the plan has no arc", expected="at least one arc")
        self.plan = plan
        self.n_arcs = 0 if plan.needle is None else len(plan.needle.arcs)
        self._n_twisted = 0 if plan.system.tubes.planar else len(plan.system.tubes.nested)
        self.kinds = tuple(name for name in UNITS if plan.needle is not None or name not in OF_NEEDLE)
        tip = np.asarray(plan.scope.lps_from_scope_tip)[:3, 3]
        heights = (lung.height_share(np.asarray(plan.target_lps)), lung.height_share(tip))
        self.stretch = share_of_motion(heights[0]) - share_of_motion(heights[1])
        known = lung.motion if lung.motion is not None and not lung.motion.warning_only else None
        self._motion = None if known is None else PatientMotion(plan, known)
        self._others = tuple(RiskAssessor(each, lung, radius_mm=radius_mm) for each in plan.passes[1:])
        self._anew = drawn_anew(plan)
        self.radius_mm, self.radius_origin = goal_radius(lung, plan.target_lps, radius_mm)
        tool = plan.system.tool
        self.wanted = wanted_of(lung, plan.target_lps, tool, radius_mm)
        self.tissue = "" if tool is None else tool.words
        if tool is not None:
            own = self.wanted.tissue.size > 0
            ball = f"a ball of {self.radius_mm:.1f} mm: {self.radius_origin}"
            self.radius_origin = "the nodule as it is in the mask" if own else ball
        self._deviated, self._judging = DeviatedPlan(plan), judging(plan, lung)
        self.structures = {
            name: flag for name, flag in STRUCTURES.items() if flag != FISSURE or lung.has_fissures
        }
        self.forbidden = tuple(
            name for name in self.structures if name != "fissure" or plan.fissures_are_obstacles
        )
        self._forbidden_flags = sum(self.structures[name] for name in self.forbidden)
        bits = obstacle_bits(lung.has_fissures)
        field = lung.obstacle_field(with_fissures=True)
        self._obstacles = Obstacles(field.corners, lung.labels, field.geometry, bits)

    def draws(self, count: int, seed: int, *, attempt: int = 0, n_arcs: int | None = None) -> Draws:
        """Return random numbers for `count` sets of errors, see `Draws`; the same seed gives the same.

        They are for the arcs and all passes of the plan if `n_arcs` is None.
        """
        others = () if n_arcs is not None else self._others
        arcs = self.n_arcs if n_arcs is None else n_arcs
        return Draws(
            count, arcs, seed, self._n_twisted, stretch=self.stretch, motion=self._motion, attempt=attempt,
            further=[(each.n_arcs, anew) for each, anew in zip(others, self._anew[1:], strict=False)],
            lps_from_scope_tip=self.plan.scope.lps_from_scope_tip,
        )  # fmt: skip

    def no_deviations(self, count: int) -> dict[str, Float]:
        """Return the fields of `Deviations` for `count` sets without any error."""
        return no_deviations(count, self.n_arcs, self._n_twisted)

    def outcomes(self, deviations: Deviations) -> Outcomes:
        """Follow deviated plans through all three stages, and all passes."""
        passes = zip(self._others, self._further(deviations), strict=True)
        every = [self._of_first(deviations), *(each.outcomes(own) for each, own in passes)]
        return Outcomes(
            touched=np.bitwise_or.reduce([each.touched for each in every]),
            miss_mm=np.min([each.miss_mm for each in every], axis=0),
            taken=taken_together([each.taken for each in every], self.wanted),
            ends=every[0].ends,
        )

    def _of_first(self, deviations: Deviations) -> Outcomes:
        """Follow the first pass of deviated plans."""
        inputs, found = self._inputs(deviations), Outcomes.unknown(deviations.count)

        def find(part: slice) -> None:
            find_outcomes(*inputs, self._obstacles, self.wanted, part.start, *(each[part] for each in found))

        in_threads(find, deviations.count)
        return found

    def follow(
        self, starts: Float, pieces: Float, n_tube: int, target_mm: Float, border_mm: Float
    ) -> Outcomes:
        """Return what becomes of chains whose target has moved, `(N, 3)`; see `Outcomes` and `Deviations`."""
        found, moved = Outcomes.unknown(len(starts)), np.column_stack([target_mm, border_mm])
        about = self._obstacles, self._judging, self.wanted
        follow_chains(starts, pieces, n_tube, *about, moved, *found)
        return found

    def _inputs(self, deviations: Deviations) -> tuple[Any, ...]:
        """Return what all kernels take first; see `find_taken`."""
        return (*self._deviated.kernel_inputs(deviations), self._judging)

    def succeeded(self, outcomes: Outcomes) -> Bool:
        """Tell which `(N,)` take enough, leave the airway and touch nothing forbidden."""
        return np.asarray((outcomes.taken >= self.wanted.least) & self.touches_nothing(outcomes.touched))

    def touches_nothing(self, touched: Int) -> Bool:
        """Tell which flags `(N,)` are of nothing forbidden."""
        return np.asarray((touched & self._forbidden_flags) == 0)

    def successes(self, deviations: Deviations) -> Bool:
        """Tell which `(N,)` of deviated plans succeed, as `succeeded` does of their outcomes.

        Those that miss the goal are not followed, and the others only up to the first forbidden touch.
        """
        inputs = [self._inputs(deviations)]
        inputs += [one._inputs(own) for one, own in zip(self._others, self._further(deviations), strict=True)]
        taken, done = np.zeros((len(inputs), deviations.count)), np.zeros(deviations.count, dtype=bool)

        def find(part: slice) -> None:
            for own, found in zip(inputs, taken, strict=True):
                find_taken(*own, self.wanted, part.start, found[part])
            done[part] = taken_together(taken[:, part], self.wanted) >= self.wanted.least
            for own in inputs:
                keep_clear(*own, self._obstacles, self._forbidden_flags, part.start, done[part])

        in_threads(find, deviations.count)
        return done

    def taken_and_clear(self, deviations: Deviations) -> tuple[Float, Bool]:
        """Return how much the first pass takes `(N,)`, and where it touches nothing forbidden `(N,)`."""
        inputs, count = self._inputs(deviations), deviations.count
        taken, clear = np.zeros(count), np.ones(count, dtype=bool)

        def find(part: slice) -> None:
            find_taken(*inputs, self.wanted, part.start, taken[part])
            keep_clear(*inputs, self._obstacles, self._forbidden_flags, part.start, clear[part])

        in_threads(find, count)
        return taken, clear

    def _further(self, deviations: Deviations) -> Sequence[Deviations]:
        """Return the deviations of the passes after the first."""
        return deviations.further or [_fitted(each.n_arcs, deviations) for each in self._others]

    def success(self, draws: Draws, model: ErrorModel) -> Share:
        """Return the share of successes under a model."""
        return share_of(self.successes(draws.deviations(model)))


def _fitted(n_arcs: int, errors: Deviations) -> Deviations:
    """Return errors of a pass that are those of the first; of further arcs they are those of the last."""
    columns = np.minimum(np.arange(n_arcs), errors.roll_rad.shape[1] - 1)
    return replace(errors, roll_rad=errors.roll_rad[:, columns], stop_mm=errors.stop_mm[:, columns])


def in_threads(find: Callable[[slice], None], count: int) -> None:
    """Have parts of `count` numbers found at the same time: what is found does not depend on the parts."""
    bounds = np.linspace(0, count, THREADS + 1).astype(int).tolist()
    with ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(find, map(slice, bounds[:-1], bounds[1:])))

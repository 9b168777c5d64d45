"""The policy of a procedure: what was measured goes in, what to do next comes out, with its chance.

Going on with the plan as it is, from where things were measured to be, is always one of the choices, and all
have their chance from the same kernels.  The simulator of procedures decides by the same functions.
"""

import math
from dataclasses import fields, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from anatomy.base.errors import SettingsError, TargetError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Bool, Float, Int
from anatomy.lung import Lung
from anatomy.structures import AIRWAY, OUTSIDE, VESSEL, obstacle_bits
from lungaccess.planning.coupled.search.aimed_tubes import AimedFromPose
from lungaccess.planning.one_stage import replan_from_tube
from lungaccess.planning.procedure import choices, spread
from lungaccess.planning.procedure.kernels import decisions as kernel
from lungaccess.plans.assemble import needle_part, tube_part
from lungaccess.plans.evaluator import CandidateEvaluator
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.parts import TubeDeployment
from lungaccess.plans.plan import Plan
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import BREATHING, ErrorModel
from lungaccess.problem.procedures import Procedure, load_procedure
from lungaccess.problem.target import Target
from lungaccess.problem.task import Task
from lungaccess.uncertainty.risk import RiskAssessor
from lungaccess.uncertainty.risk.assessor import in_threads
from lungaccess.uncertainty.risk.deviations import deviated_starts, judging
from lungaccess.uncertainty.risk.patient_errors import model_for
from stages.needle import ArcPath, Limits, NeedleEnvironment, Objective, Obstacles, needle_environment
from stages.tube import tube_constants, tube_environment

ASIDES = 2
"""Points beside the target that are tried, the two that the needle has to bend least for."""
SHARES = 9
"""Shares of an error of measuring that are tried until a scope's tip lies in the lumen."""
LEAST_CHANCE = 0.01
"""Below it nothing is left to do: chances are known to some percent."""
IMAGINED = 24
"""Placements of the scope that are imagined beforehand: their mean chance is then known to some percent."""
PLACES = 1024
"""Places of the scope's tip that are imagined before it is measured: dozens are near any that is."""
LONGEST = 12
"""Arcs of a path of the needle for which there is room; more where the plan has more."""
_SEED = 2
"""Seed of imagined placements, which have nothing to do with the draws of a simulated procedure."""


class Placed(NamedTuple):
    """Most likely poses `(N, 4, 4)` of tips of the scope that were measured.

    `drawn` `(N, DRAWS, 3)` are places where each may be.
    """

    frames: Float
    drawn: Float


@frozen_record
class Chosen:
    """What was chosen in N procedures.

    Args:
        frames, tips ((N, 4, 4) float64): Most likely poses of the scope's tip, and where the needle starts.
        found ((N, 3) int64): Number of the deployment, arcs of the needle's path, and pierced branch.
        arcs, changed ((N, A, 3), (N,)): Paths of the needle, and whether they are others than planned before.
        tubes ((N, 11) float64): Planar tubes as kernels take them; none of others.
        deployed: Of each procedure, where the system has no needle or its tubes are not planar; else empty.
    """

    frames: Float
    tips: Float
    found: Int
    chances: Float
    arcs: Float
    changed: Bool
    tubes: Float
    deployed: tuple[TubeDeployment, ...] = ()

    def only(self, chosen: Int) -> "Chosen":
        """Return some of the procedures, by their numbers."""
        arrays = {each.name: getattr(self, each.name) for each in fields(self) if each.name != "deployed"}
        arrays = {name: each[chosen] if len(each) else each for name, each in arrays.items()}
        kept = tuple(self.deployed[n] for n in chosen.tolist()) if self.deployed else ()
        return Chosen(**arrays, deployed=kept)


class OnTheWay(NamedTuple):
    """A needle on its way: arcs `(A, 3)` that were to follow, and what lies behind from the tip of the tubes.

    `reference` `(3,)` is the direction of the needle at that tip.
    """

    rest: Float
    inserted_mm: float
    turned_rad: float
    reference: Float
    branch: int


class Policy:
    """Tells what to do next in a procedure that carries out a plan; what it prepares serves all answers.

    Measurements are weighed by the errors against what was expected.  PlanFileError and SettingsError are
    raised as by `RiskAssessor`.

    Args:
        errors: The preset `breath-hold` if None.
        procedure: The preset `open-loop` if None: then nothing is measured, and nothing to decide.
        radius_mm: Radius of the goal; see `RiskAssessor`.
    """

    def __init__(
        self,
        plan: Plan,
        lung: Lung,
        errors: ErrorModel | None = None,
        procedure: Procedure | None = None,
        *,
        radius_mm: float | None = None,
    ) -> None:
        self.whole, (plan, *others) = plan, plan.passes
        self.passes = (self, *(Policy(one, lung, errors, procedure, radius_mm=radius_mm) for one in others))
        self.plan, self.lung = plan, lung
        self.assessor = RiskAssessor(plan, lung, radius_mm=radius_mm)
        self.errors = model_for(errors or load_errors(), plan, lung)
        self.procedure = procedure or load_procedure()
        self._target = np.asarray(plan.goal_lps)
        # Fissures are obstacles of what follows exactly where they are of the plan.
        # The way is planned again to where the tip has to end, so that nothing has to go on from there.
        whole = replace(plan.system, fissures_allowed=not plan.fissures_are_obstacles, tool=None)
        # A system with a share of its margins.
        share = self.procedure.least_margin_share
        margins = {each.name: share * getattr(whole.margins, each.name) for each in fields(whole.margins)}
        self.system = replace(whole, margins=replace(whole.margins, **margins))
        aside_mm = self.aside_mm if self.procedure.tubes.measured else 0.0
        about = self.errors, self.procedure, self.assessor.stretch
        self._left = spread.sizes_of(self.system, *about, aside_mm)
        arcs = [] if plan.needle is None else plan.needle.arcs
        self._planned = np.array([(a.length_mm, a.roll_rad, a.curvature_per_mm) for a in arcs]).reshape(-1, 3)
        path = ArcPath(lps_from_start=np.eye(4), arcs=self._planned)
        self._vias = np.array([frame[:3, 3] for frame in path.frames()[1:-1]]).reshape(-1, 3)

    @property
    def aside_mm(self) -> float:
        """How far from the centre of the goal the needle may be aimed at where it cannot be reached."""
        return spread.ASIDE * self.assessor.radius_mm

    # Scope ----------------------------------------------------------------------------------------

    def scopes_measured(self, measured: Float, count: int = 1) -> Placed:
        """Return where tips of the scope most likely are, `(N, 4, 4)`, each measured `count` times.

        It is in the lumen, as the planned tip is, as deep as the scope is thick or as the planned tip is.
        """
        placing, expected = self.procedure.scope, np.asarray(self.plan.scope.lps_from_scope_tip)
        term = self.errors.term
        known = term("scope_position").rms, math.radians(term("scope_direction").rms)
        noise = placing.position_mm / math.sqrt(count), math.radians(placing.direction_deg) / math.sqrt(count)
        every = np.broadcast_to(expected, measured.shape)
        likely = np.array(spread.fused(every, spread.scope_moves(every, *known), measured, *noise))
        likely[:, :3, 3] = self._in_lumen(likely[:, :3, 3])
        drawn = np.zeros((len(likely), choices.DRAWS, 3))
        shifts = self._planned_choice.errors[:, :3]
        fallback = self._in_lumen((likely[:, None, :3, 3] + shifts).reshape(-1, 3)).reshape(drawn.shape)
        mean = np.ascontiguousarray(likely[:, :3, 3])
        kernel.find_places(
            self._places, np.ascontiguousarray(measured[:, :3, 3]), noise[0], fallback,
            (np.arange(choices.DRAWS) + 0.5) / choices.DRAWS, mean, drawn,
        )  # fmt: skip
        likely[:, :3, 3] = self._in_lumen(mean)
        return Placed(likely, drawn)

    def _in_lumen(self, points: Float) -> Float:
        """Return the first point `(N, 3)` on the way to the planned tip where the lumen is deep enough."""
        inside = np.asarray(self.plan.scope.lps_from_scope_tip)[:3, 3]
        shares = np.linspace(1.0, 0.0, SHARES)[:, None]
        way = inside + shares * (points[:, None] - inside)
        depths = self.lung.lumen_depth.lower_bound_mm(way.reshape(-1, 3)).reshape(-1, SHARES)
        enough = np.minimum(self.plan.system.scope.radius_mm, depths[:, -1:])
        return np.asarray(way[np.arange(len(way)), np.argmax(depths >= enough, axis=1)])

    @cached_property
    def _places(self) -> Float:
        """Where the scope's tip may stand before it is measured, `(PLACES, 3)`."""
        drawn = self.assessor.draws(PLACES, _SEED + 1).deviations(self.errors)
        return np.ascontiguousarray(deviated_starts(self.plan, self.lung, drawn)[:, :3])

    def from_scopes(self, placed: Placed) -> Chosen:
        """Return what is chosen where N tips of the scope were measured."""
        if self.plan.needle is None:
            return self._aimed(placed)
        return self._chosen(placed, self._offer.choices)

    def as_planned(self, count: int) -> Chosen:
        """Return that the plan is carried out as it is where the scope is not measured, N times."""
        frame = np.asarray(self.plan.scope.lps_from_scope_tip)[None]
        every = np.ascontiguousarray(self._places[: choices.DRAWS])[None]
        alone = self._chosen(Placed(frame, every), self._planned_choice)
        arcs = np.zeros_like(alone.arcs)
        arcs[0, : len(self._planned)] = self._planned
        found = np.array([[0, len(self._planned), self.plan.exemption.branch]])
        return replace(alone, arcs=arcs, found=found, changed=np.zeros(1, dtype=bool)).only(
            np.zeros(count, int)
        )

    def _chosen(self, placed: Placed, among: kernel.Choices) -> Chosen:
        frames, count = placed.frames, len(placed.frames)
        found, chances = np.zeros((count, 3), dtype=np.int64), np.zeros(count)
        arcs = np.zeros((count, max(LONGEST, len(self._planned)), 3))
        x, y, z = self._target.tolist()
        # Another needle than one that is planned again behind the tubes starts blindly.
        known = self._left, self._left._replace(tip_known=False, tip=0.0)
        prepared = self._scene, known, *self._tube_arrays, among, self._planned, self._vias
        frames = np.ascontiguousarray(frames)

        def choose(part: slice) -> None:
            kernel.choose_tubes(
                *prepared, self.plan.exemption.branch, (x, y, z), (frames[part], placed.drawn[part]),
                found[part], chances[part], arcs[part],
            )  # fmt: skip

        in_threads(choose, count)
        chosen = found[:, 0]
        same = _same(arcs[:, : len(self._planned)], self._planned)
        deployed: tuple[TubeDeployment, ...] = ()
        if not self.plan.system.tubes.planar:
            deployed = tuple(
                self._deployed(frame, n) for frame, n in zip(frames, chosen.tolist(), strict=True)
            )
        return Chosen(
            frames=frames, tips=frames @ among.scope_from_tip[chosen], found=found, chances=chances,
            arcs=arcs, changed=(chosen > 0) | ~same,
            tubes=among.tubes[chosen] if len(among.tubes) else among.tubes, deployed=deployed,
        )  # fmt: skip

    def _aimed(self, placed: Placed) -> Chosen:
        """Return the same without a needle: the tubes are aimed at the target again, or go as planned."""
        each = []
        for n, frame in enumerate(placed.frames):
            found = AimedFromPose(self._evaluator, frame).best()
            made = [] if found is None else [found[0]]
            chosen = self._chosen(
                Placed(frame[None], placed.drawn[n : n + 1]),
                choices.with_choices(self._planned_choice, self.system, made, [frame] * len(made)),
            )
            tube = self.plan.tube
            if found is not None and chosen.found[0, 0] > 0:
                tube = tube_part(self._task, frame, found[0])
            each.append(replace(chosen, deployed=(tube,)))
        names = [field.name for field in fields(Chosen) if field.name != "deployed"]
        arrays = {name: np.concatenate([getattr(one, name) for one in each]) for name in names}
        return Chosen(**arrays, deployed=tuple(tube for one in each for tube in one.deployed))

    def _deployed(self, frame: Float, number: int) -> TubeDeployment:
        """Return a deployment of the offer from a scope's tip as a plan states it."""
        if number == 0 or self.plan.needle is None:
            return self.plan.tube
        made = self._evaluator.tubes.choose(frame, *self._offer.deployed[number - 1])
        if isinstance(made, str):
            raise NoPlan(f"The tubes are refused on a second look: {made}", reasons={f"tube: {made}": 1})
        return tube_part(self._task, frame, made)

    @cached_property
    def worth(self) -> tuple[float, ...]:
        """The chance of success that so many more placements of the scope promise, from 0 on.

        A placement is worth going on from if its own chance is not less: then stopping is optimal, as far as
        placements are alike and chances are those foreseen.
        """
        worth, scope = [0.0], self.procedure.scope
        if scope.measured and scope.placements > 1:
            chances = self.from_scopes(self._imagined).chances
            for _ in range(scope.placements - 1):
                worth.append(float(np.maximum(chances, worth[-1]).mean()))
        return (*worth, *[0.0] * (scope.placements - len(worth)))

    def goes_on(self, chances: Float, left: int, *, tubes_out: bool = False) -> Bool:
        """Tell which procedures go on with what was chosen (N,): the others place the scope again, or stop.

        The scope may be placed again `left` times.
        """
        # Tubes that are out are drawn back only where another placement promises so many times as much, since
        # each leaves a channel in tissue.
        return np.asarray(chances >= max(self.worth[left] / (2.0 if tubes_out else 1.0), LEAST_CHANCE))

    # Tubes ----------------------------------------------------------------------------------------

    def tips_measured(self, chosen: Chosen, measured: Float, count: int = 1) -> Float:
        """Return where tips of the tubes most likely are, `(N, 4, 4)`, see `scopes_measured`."""
        stage, root = self.procedure.tubes, math.sqrt(count)
        moves = spread.tip_moves(chosen.frames, chosen.tips, self._left)
        noise = stage.position_mm / root, math.radians(stage.direction_deg) / root
        return spread.fused(chosen.tips, moves, measured, *noise)

    def doubt_of(self, lps_from_scope_tip: Float, lps_from_tip: Float) -> Float:
        """Return the covariance `(6, 6)` of the pose in which a needle begins, mm and rotation vector."""
        stage = self.procedure.tubes
        if stage.measured:
            return np.diag(np.repeat((stage.position_mm, math.radians(stage.direction_deg)), 3) ** 2)
        moves = spread.tip_moves(lps_from_scope_tip, lps_from_tip, self._left)
        return np.asarray(moves @ moves.T)

    def targets_measured(self, measured: Float) -> Float:
        """Return where targets most likely are, `(N, 3)`, that an image before the needle shows."""
        errors, breath = self.errors.term("target_position").rms, self.errors.term(BREATHING).size
        expected = np.array([errors, errors, math.hypot(errors, self.assessor.stretch * breath)])
        found = self._target + spread.fused_share(expected, self.procedure.imaging.position_mm) * (
            measured - self._target
        )
        # Where the masks say that a nodule cannot be, the measurement is not believed.
        free = (self.lung.labels_at(found) & (OUTSIDE | VESSEL | AIRWAY)) == 0
        return np.where(free[:, None], found, self._target)

    def from_tubes(self, chosen: Chosen, tips: Float, targets: Float) -> Chosen:
        """Return what is chosen from the most likely poses of the tubes' tip to targets, `(N, 3)`."""
        if self.plan.needle is None:
            return replace(chosen, tips=tips)
        branches = np.ascontiguousarray(chosen.found[:, 2])
        found, chances, arcs = self._paths(chosen.arcs, chosen.found[:, 1], tips, branches, targets)
        # A search may find more where no path is proved and going on as planned succeeds less often than
        # this.
        for n in np.flatnonzero((found[:, 2] == 0) & (chances < 0.2)).tolist():
            path = self._searched(tips[n], targets[n])
            if path is None or len(path) > arcs.shape[1]:
                continue
            row = np.zeros((1, *arcs.shape[1:]))
            row[0, : len(path)] = path
            one = slice(n, n + 1)
            other = self._paths(row, np.array([len(path)]), tips[one], branches[one], targets[one])
            if other[1][0] > chances[n]:
                found[n], chances[n], arcs[n] = (each[0] for each in other)
        found[:, 0], found[:, 2] = chosen.found[:, 0], branches
        changed = ~_same(arcs, chosen.arcs)
        return replace(chosen, tips=tips, found=found, chances=chances, arcs=arcs, changed=changed)

    def _paths(
        self, arcs: Float, counts: Int, *where: ArrayLike, about: tuple[kernel.Scene, object] | None = None
    ) -> tuple[Int, Float, Float]:
        """Return what `choose_needles` finds from tips, branches and targets: numbers, chances, and arcs.

        `about` are scene and sizes, by default those of a needle that is still in the tubes.
        """
        found, chances = np.zeros((len(counts), 3), dtype=np.int64), np.zeros(len(counts))
        found[:, 1], arcs = counts, np.array(arcs)
        places = (np.array(each, order="C") for each in where)
        kernel.choose_needles(*(about or (self._scene, self._left)), *places, ASIDES, found, chances, arcs)
        return found, chances, arcs

    def _searched(self, tip: Float, target: Float) -> Float | None:
        """Return the arcs that the needle's own search finds, None without."""
        try:
            # Iterations of the needle's search where neither a single arc nor the planned turns are clear.
            rest = replan_from_tube(
                self.lung, self.system, tip, Target(lps_mm=target, origin=self.plan.target_origin),
                objective=self.plan.objective, seed=self.plan.seed, iterations=300,
            )  # fmt: skip
        except (NoPlan, TargetError):
            return None
        return np.asarray(rest.path.arcs)

    # Needle ---------------------------------------------------------------------------------------

    def from_needle(
        self, way: OnTheWay, lps_from_tip: Float, target: Float, curvature_share: float = 1.0
    ) -> tuple[Float, float, bool]:
        """Return the arcs `(A, 3)` left for a needle on its way, their chance, and if any path is proved.

        The needle's tip is taken to be at `lps_from_tip`; `curvature_share` is the share of its largest
        curvature that the needle reaches in this tissue.
        """
        limits, count, steering = self._scene.limits, len(way.rest), self.procedure.needle
        turned = math.acos(min(max(float(way.reference @ lps_from_tip[:3, 2]), -1.0), 1.0))
        left = limits._replace(
            kappa=curvature_share * limits.kappa,
            max_length_mm=limits.max_length_mm - way.inserted_mm,
            max_angle_rad=max(limits.max_angle_rad - turned, 0.0),
            max_turn_rad=max(limits.max_turn_rad - way.turned_rad, 0.0),
            exempt_mm=max(limits.exempt_mm - way.inserted_mm, 0.0),
        )
        known = self._left._replace(
            tip_known=True, tip=steering.position_mm, tip_turn=math.radians(steering.direction_deg),
            exempt=left.exempt_mm,
        )  # fmt: skip
        arcs = np.zeros((1, max(LONGEST, count), 3))
        arcs[0, :count] = way.rest
        where, about = (lps_from_tip[None], [way.branch], target[None]), self._scene._replace(limits=left)
        found, chances, arcs = self._paths(arcs, np.array([count]), *where, about=(about, known))
        return arcs[0, : found[0, 1]], float(chances[0]), bool(found[0, 2])

    # One answer -----------------------------------------------------------------------------------

    def decide(self, measured: choices.Measurements) -> choices.Decision:
        """Return what to do next after what was measured since the scope was placed last.

        The same measurements give the same decision.  A stage that the procedure does not measure may be left
        out; one that it measures may not.

        Raises:
            SettingsError: If nothing was measured that the procedure decides by.
            FrameError, TargetError: If a pose is not rigid, or a point lies outside the images.
        """
        procedure, (scope, tubes, needle) = self.procedure, measured.poses(self.lung)
        if procedure.scope.measured and not len(scope):
            raise SettingsError(
                f"The scope is not measured, which the procedure {procedure.name!r} does",
                expected="where its tip is",
                remedy="Measure the scope, or choose a procedure that does not",
            )
        left = max(procedure.scope.placements - measured.placements, 0)
        chosen = self.as_planned(1)
        if procedure.scope.measured:
            placed = self.scopes_measured(spread.mean_pose(scope)[None], len(scope))
            chosen = self.from_scopes(placed)
        if not len(tubes) and not len(needle):
            return self._decision(chosen, left, tubes_out=False)
        target = self._target[None]
        if measured.target_lps is not None and procedure.imaging.measured:
            target = self.targets_measured((measured.target_lps + self._target - self.plan.target_lps)[None])
        if len(tubes) and self.plan.needle is not None:
            tips = self.tips_measured(chosen, spread.mean_pose(tubes)[None], len(tubes))
            chosen = self.from_tubes(chosen, tips, target)
        if not len(needle) or self.plan.needle is None:
            return self._decision(chosen, left, tubes_out=True)
        return self._on_the_way(chosen, spread.mean_pose(needle), target[0])

    def _decision(self, chosen: Chosen, left: int, *, tubes_out: bool) -> choices.Decision:
        chance, changed = float(chosen.chances[0]), bool(chosen.changed[0])
        others = bool(chosen.found[0, 0]) or (changed and self.plan.needle is None)
        action = choices.Action.DEPLOY if others and not tubes_out else choices.Action.NEEDLE
        if not changed:
            action = choices.Action.GO_ON
        if not self.goes_on(chosen.chances, left, tubes_out=tubes_out)[0]:
            action = choices.Action.PLACE_AGAIN if left else choices.Action.STOP
        needle = None
        if self.plan.needle is not None:
            path = ArcPath(lps_from_start=chosen.tips[0], arcs=chosen.arcs[0, : chosen.found[0, 1]])
            needle = needle_part(path)
        tube = None
        if not tubes_out:
            tube = next(iter(chosen.deployed), None) or self._deployed(chosen.frames[0], chosen.found[0, 0])
            tube = replace(tube, lps_from_tip=chosen.tips[0])
        return choices.Decision(
            action=action, chance=chance, again=self.worth[left],
            lps_from_device=chosen.tips[0] if tubes_out else chosen.frames[0], tube=tube, needle=needle,
            branch=int(chosen.found[0, 2]),
        )  # fmt: skip

    def _on_the_way(self, chosen: Chosen, pose: Float, target: Float) -> choices.Decision:
        """Return the decision about a needle on its way: what lies behind the nearest point is inserted."""
        path = ArcPath(lps_from_start=chosen.tips[0], arcs=chosen.arcs[0, : chosen.found[0, 1]])
        # Spacing of the points of a path of which the one nearest to a needle's tip tells how much is
        # inserted.
        points, lengths = path.sample(0.25)
        inserted = float(lengths[np.linalg.norm(points - pose[:3, 3], axis=1).argmin()])
        rest, turned = rest_of(path.arcs, inserted)
        branch = int(chosen.found[0, 2])
        way = OnTheWay(rest, inserted, turned, path.lps_from_start[:3, 2], branch)
        arcs, chance, _proved = self.from_needle(way, pose, target)
        same = arcs.shape == rest.shape and bool(_same(arcs[None], rest[None])[0])
        action = choices.Action.GO_ON if same else choices.Action.NEEDLE
        return choices.Decision(
            action=action if chance >= LEAST_CHANCE else choices.Action.STOP, chance=chance, again=0.0,
            lps_from_device=pose, tube=None, branch=branch,
            needle=needle_part(ArcPath(lps_from_start=pose, arcs=arcs)),
        )  # fmt: skip

    # What is prepared -----------------------------------------------------------------------------

    @cached_property
    def _imagined(self) -> Placed:
        """Tips of the scope as they may be measured, IMAGINED of them."""
        drawn = self.assessor.draws(IMAGINED, _SEED).deviations(self.errors)
        true = choices.scope_frames(deviated_starts(self.plan, self.lung, drawn))
        noise = np.random.default_rng(_SEED).standard_normal((IMAGINED, 5))
        size = self.procedure.scope.position_mm, self.procedure.scope.direction_deg
        return self.scopes_measured(spread.as_measured(true, *size, noise))

    @cached_property
    def _offer(self) -> choices.Offer:
        planned = np.asarray(self.plan.scope.lps_from_scope_tip)[None]
        # Deployments to choose from are looked for from the planned tip, and from five imagined ones.
        frames = np.concatenate([planned, self._imagined.frames[:5]])
        return choices.offered(
            self.plan, self.lung, self.system, self.errors, self.procedure, self.assessor.radius_mm,
            self._left, frames,
        )  # fmt: skip

    @cached_property
    def _planned_choice(self) -> kernel.Choices:
        return choices.planned_choice(self.plan, self._left)

    @cached_property
    def environment(self) -> NeedleEnvironment:
        """What the needle collides with, and its limits, with the margins that are kept by then."""
        needle = self.system.require_needle("A path of the needle")
        return needle_environment(
            self.lung, needle, self.system.margins, with_fissures=self.plan.fissures_are_obstacles
        )

    @cached_property
    def _scene(self) -> kernel.Scene:
        plan, lung, fissures = self.plan, self.lung, self.plan.fissures_are_obstacles
        field, every = lung.obstacle_field(with_fissures=fissures), lung.obstacle_field(with_fissures=True)
        obstacles = Obstacles(field.corners, lung.labels, field.geometry, obstacle_bits(fissures))
        limits = Limits(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0)
        if plan.needle is not None:
            obstacles, limits = self.environment.obstacles, self.environment.limits
        judged = judging(plan, lung)
        forbidden = sum(self.assessor.structures[name] for name in self.assessor.forbidden)
        return kernel.Scene(
            around=spread.around(lung, with_fissures=fissures), obstacles=obstacles, limits=limits,
            judged=Obstacles(every.corners, lung.labels, every.geometry, obstacle_bits(lung.has_fissures)),
            forbidden=forbidden, depth=judged.depth, depth_geometry=judged.geometry,
            mediastinal=judged.mediastinal, radius=self.assessor.radius_mm,
            aside=self.aside_mm, with_needle=plan.needle is not None,
            replanned=self.procedure.tubes.measured or self.procedure.needle.closed_loop,
        )  # fmt: skip

    @cached_property
    def _tube_arrays(self) -> tuple[object, Float]:
        environment = tube_environment(self.lung, with_fissures=self.plan.fissures_are_obstacles)
        return environment, tube_constants(self.system.tubes, self.system.margins)

    @cached_property
    def _task(self) -> Task:
        return Task(
            lung=self.lung, system=self.system, method="replan", seed=self.plan.seed,
            target=Target(lps_mm=self._target, origin=self.plan.target_origin),
            objective=Objective.of(self.plan.objective),
        )  # fmt: skip

    @cached_property
    def _evaluator(self) -> CandidateEvaluator:
        return CandidateEvaluator(self._task)


def rest_of(arcs: Float, behind_mm: float) -> tuple[Float, float]:
    """Return the arcs that are left of a path `(A, 3)`, and the turn of those that lie behind."""
    rest, turned = [], 0.0
    for length, roll, curvature in arcs.tolist():
        done = min(max(behind_mm, 0.0), length)
        turned += curvature * done
        if length > done:
            rest.append((length - done, roll if done == 0.0 else 0.0, curvature))
        behind_mm -= length
    return np.array(rest).reshape(-1, 3), turned


def _same(arcs: Float, others: Float) -> Bool:
    """Tell which paths `(N, A, 3)` are the same but for rounding."""
    # Arcs that differ by less, in mm, rad and 1/mm, are the same: no hand or drive tells them apart.
    return np.asarray((np.abs(arcs - others) <= 1e-4).all(axis=(1, 2)))

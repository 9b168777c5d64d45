"""What was measured in a procedure, what is decided, and the deployments that a policy may choose from.

What tubes do does not depend on where the scope's tip stands, so that a deployment is a pose of their tip in
the scope's frame; whether it is clear is looked at where the scope is.
"""

from collections.abc import Iterable
from dataclasses import asdict
from enum import StrEnum
from typing import Any

import numpy as np

from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Bool, Float
from anatomy.lung import Lung
from lungaccess.planning.one_stage import measured_pose
from lungaccess.planning.procedure.kernels.decisions import Choices
from lungaccess.planning.procedure.kernels.spread import Sizes
from lungaccess.planning.procedure.spread import Spread
from lungaccess.plans.file import plain
from lungaccess.plans.parts import NeedlePath, TubeDeployment
from lungaccess.plans.plan import Plan
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.procedures import Procedure
from lungaccess.problem.system import System
from lungaccess.uncertainty.risk import Deviations
from lungaccess.uncertainty.risk.deviations import DeviatedPlan, in_rows, no_deviations, tube_values
from stages.needle import needle_environment, workspace_lengths
from stages.tube import Deployment, DeploymentValidator, SiteEnumerator

Pose = tuple[tuple[float, ...], ...]


class Action(StrEnum):
    """What to do next."""

    GO_ON = "go on as planned"
    DEPLOY = "deploy the tubes anew"
    NEEDLE = "take another needle path"
    PLACE_AGAIN = "place the scope again"
    STOP = "stop"


@frozen_value
class Measurements:
    """What was measured since the scope was placed last; poses are 4x4, LPS mm, +z forward.

    Args:
        scope, tubes, needle (tuple of poses): Of the tips, each as often as it was measured where it stood;
            the mean of several is taken.  A new deployment or another place of the needle begins a new
            record.
        target_lps (tuple of 3 floats or None): The target as an image shows it before the needle starts.
        placements: How often the scope has been placed, this time included.
    """

    scope: tuple[Pose, ...] = ()
    tubes: tuple[Pose, ...] = ()
    needle: tuple[Pose, ...] = ()
    target_lps: tuple[float, float, float] | None = None
    placements: int = 1

    @classmethod
    def of(
        cls,
        *,
        scope: Iterable[Float] = (),
        tubes: Iterable[Float] = (),
        needle: Iterable[Float] = (),
        target_lps: Float | None = None,
        placements: int = 1,
    ) -> "Measurements":
        """Return what was measured from arrays of poses `(4, 4)` and a point `(3,)`."""
        point = None if target_lps is None else tuple(np.asarray(target_lps, dtype=np.float64).tolist())
        stages = {"scope": scope, "tubes": tubes, "needle": needle}
        poses: dict[str, Any] = {
            name: tuple(tuple(map(tuple, np.asarray(pose, dtype=np.float64).tolist())) for pose in each)
            for name, each in stages.items()
        }
        return cls(**poses, target_lps=point, placements=placements)

    def poses(self, lung: Lung) -> tuple[Float, ...]:
        """Return the poses `(K, 4, 4)` of each stage, as the nearest rigid ones; errors: `measured_pose`."""
        of = {"scope": self.scope, "tube": self.tubes, "needle": self.needle}
        return tuple(
            np.array([measured_pose(lung, pose, name) for pose in each]).reshape(-1, 4, 4)
            for name, each in of.items()
        )

    def record(self) -> dict[str, Any]:
        """Return plain JSON values."""
        return asdict(self)


@frozen_record
class Decision:
    """What to do next, with the chance of success of the best way to go on, which is `tube` and `needle`.

    Args:
        again: Chance that placing the scope again promises; 0 where it may not be.
        lps_from_device ((4, 4) float64): Where the tip that was measured last most likely is, LPS mm.
        tube: How the tubes are to be deployed; None where they are out.
        branch: The branch that is pierced.
    """

    action: Action
    chance: float
    again: float
    lps_from_device: Float
    tube: TubeDeployment | None
    needle: NeedlePath | None
    branch: int

    @property
    def goes_on(self) -> bool:
        """Whether devices go on from where they are."""
        return self.action not in (Action.PLACE_AGAIN, Action.STOP)

    def record(self) -> dict[str, Any]:
        """Return plain JSON values; poses in LPS mm, angles in rad."""
        return {
            "action": str(self.action), "chance": self.chance, "chance_of_another_placement": self.again,
            "lps_from_device": self.lps_from_device.tolist(),
            "tube": None if self.tube is None else plain(self.tube),
            "needle": None if self.needle is None else plain(self.needle), "pierced_branch": self.branch,
        }  # fmt: skip


DRAWS = 16
"""Draws in which the tubes of a choice are followed: they compare choices, which have the same luck."""


@frozen_record
class Offer:
    """Deployments to choose from as the kernels take them, the planned one first.

    `deployed` has rotation and shape of each but that one, see `DeploymentValidator.choose`.
    """

    choices: Choices
    deployed: tuple[tuple[float, int], ...]


def scope_frames(starts: Float) -> Float:
    """Return the poses `(N, 4, 4)` of scope tips given as point, direction and +x axis, `(N, 9)`."""
    frames = np.zeros((len(starts), 4, 4))
    frames[:, :3, 3], frames[:, :3, 2], frames[:, :3, 0] = np.split(starts, 3, axis=1)
    frames[:, :3, 1] = np.cross(frames[:, :3, 2], frames[:, :3, 0])
    frames[:, 3, 3] = 1.0
    return frames


def _residual_rows(left: Sizes) -> Float:
    """Return what is left of the errors of scope and tubes in some draws, as kernels take it."""
    # Seed of these draws, which have nothing to do with those of a simulated procedure.
    rng = np.random.default_rng(1)
    drawn = {
        "scope_mm": left.scope * rng.standard_normal((DRAWS, 3)),
        "tilt_rad": left.scope_turn * rng.standard_normal((DRAWS, 2)),
        "rotation_rad": left.rotation * rng.standard_normal(DRAWS),
        "insertion_mm": left.insertion * rng.standard_normal((DRAWS, 2)),
        "target_mm": left.target * rng.standard_normal((DRAWS, 3)),
    }
    return in_rows(Deviations(**(no_deviations(DRAWS, 0) | drawn)))


def planned_choice(plan: Plan, left: Sizes) -> Choices:
    """Return the planned deployment alone."""
    tube, frame = plan.tube, np.array(plan.scope.lps_from_scope_tip)
    tubes = np.zeros((0, 11))
    if plan.system.tubes.planar:
        none = Deviations(**no_deviations(1, 0 if plan.needle is None else len(plan.needle.arcs), 0))
        tubes = DeviatedPlan(plan).kernel_inputs(none)[0].tubes[None]
    shapes, counts = np.array(tube.shape.arcs)[None], np.array([len(tube.shape.arcs)])
    return Choices(
        scope_from_tip=np.asarray(np.linalg.inv(frame) @ np.asarray(tube.lps_from_tip))[None],
        rotations=np.array([tube.rotation_rad]), exits=np.array([tube.exit.arc_length_mm]),
        lengths=np.array([tube.inner_insertion_mm]), tubes=tubes, shapes=shapes, n_arcs=counts,
        beside=np.array([tube.clearance_loss_mm]), errors=_residual_rows(left),
    )  # fmt: skip


def with_choices(planned: Choices, system: System, made: list[Deployment], frames: list[Float]) -> Choices:
    """Return choices with further deployments `made` from scope tips."""
    if not made:
        return planned
    tips = [np.linalg.inv(frame) @ each.lps_from_tip for frame, each in zip(frames, made, strict=True)]
    tubes = planned.tubes
    if system.tubes.planar:
        outer_mm = [0.0 if system.tubes.outer is None else each.outer_mm for each in made]
        own = [
            tube_values(system.tubes, e.rotation_rad, o, e.inner_mm)
            for o, e in zip(outer_mm, made, strict=True)
        ]
        tubes = np.concatenate([planned.tubes, own])
    arcs = [planned.shapes[0], *(np.asarray(each.shape.arcs) for each in made)]
    counts = np.array([len(each) for each in arcs])
    shapes = np.zeros((len(arcs), counts.max(), arcs[0].shape[1]))
    for number, each in enumerate(arcs):
        shapes[number, : len(each)] = each
    return planned._replace(
        scope_from_tip=np.concatenate([planned.scope_from_tip, tips]),
        rotations=np.append(planned.rotations, [each.rotation_rad for each in made]),
        exits=np.append(planned.exits, [each.exit_mm for each in made]),
        lengths=np.append(planned.lengths, [each.inner_mm for each in made]), tubes=tubes, shapes=shapes,
        n_arcs=counts,
        beside=np.append(planned.beside, [each.shape.required_beside_mm for each in made]),
    )  # fmt: skip


def offered(
    plan: Plan, lung: Lung, system: System, errors: ErrorModel, procedure: Procedure, radius_mm: float,
    left: Sizes, frames: Float,
) -> Offer:  # fmt: skip
    """Return the planned deployment, and the likeliest from some scope tips `(K, 4, 4)` that may be measured.

    `system` is that of the plan with the margins that are kept after a measurement.
    """
    fissures, target = plan.fissures_are_obstacles, np.asarray(plan.goal_lps)
    planned = planned_choice(plan, left)
    needle = system.require_needle("A choice of deployments")
    environment = needle_environment(lung, needle, system.margins, with_fissures=fissures)
    validator = DeploymentValidator(lung, system.tubes, system.margins, with_fissures=fissures)
    # Deployments towards the target that are looked at from a scope's tip: several times what is ranked,
    # since most are refused.
    enumerate_from = SiteEnumerator(
        lung, system.tubes, system.margins, with_fissures=fissures, enough=512
    ).deployments

    def worthwhile(positions: Float, tangents: Float) -> Bool:
        return np.isfinite(workspace_lengths(environment, positions, tangents, target))

    found: dict[tuple[float, int], tuple[Deployment, Float]] = {}
    for frame in frames:
        row = np.concatenate([frame[:3, 3], frame[:3, 2], frame[:3, 0]])
        entries = enumerate_from(row, worthwhile)
        near = np.flatnonzero(worthwhile(entries.positions, entries.tangents))
        # Deployments that are ranked from one tip, spread over all of them: those between are much like them.
        entries = entries.only(near[:: -(-len(near) // 96) or 1])
        tips = np.repeat(row[None], entries.count, axis=0)
        spread = Spread(lung, system, tips, entries, target, errors, procedure, radius_mm)
        # Deployments that are kept from one tip, the likeliest: further ones are alike or worse.
        for number in np.argsort(-spread.chances, kind="stable")[:12].tolist():
            deployed = entries.choice(number)
            if deployed not in found:
                made = validator.choose(frame, *deployed)
                if not isinstance(made, str):
                    found[deployed] = made, frame
    every = [each for each, _frame in found.values()], [frame for _each, frame in found.values()]
    return Offer(choices=with_choices(planned, system, *every), deployed=tuple(found))

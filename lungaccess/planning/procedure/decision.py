"""What was measured in a procedure, and what a policy then says is to be done next."""

from collections.abc import Iterable
from dataclasses import asdict
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np

from anatomy.base.records import frozen_record, frozen_value
from anatomy.base.typed import Float
from anatomy.lung import Lung
from lungaccess.planning.one_stage import measured_pose
from lungaccess.plans.file import plain
from lungaccess.plans.parts import NeedlePath, TubeDeployment

Pose = tuple[tuple[float, ...], ...]


class Action(StrEnum):
    """What to do next."""

    GO_ON = "go on as planned"
    DEPLOY = "deploy the tubes anew"
    NEEDLE = "take another needle path"
    PLACE_AGAIN = "place the scope again"
    STOP = "stop"


class Poses(NamedTuple):
    """Measurements poses `(K, 4, 4)` of each stage, rigid and inside the images."""

    scope: Float
    tubes: Float
    needle: Float


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

    def poses(self, lung: Lung) -> Poses:
        """Return the poses as the nearest rigid ones; FrameError or TargetError as `measured_pose`."""
        of = {"scope": self.scope, "tube": self.tubes, "needle": self.needle}
        return Poses(
            *(
                np.array([measured_pose(lung, pose, name) for pose in each]).reshape(-1, 4, 4)
                for name, each in of.items()
            )
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

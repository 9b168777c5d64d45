"""What a needle planner is asked: from which pose to which target."""

import math

import numpy as np

from anatomy.base.errors import FrameError, SettingsError
from anatomy.base.records import frozen_record
from anatomy.base.typed import Float


@frozen_record
class Query:
    """A start pose and a target.

    Parameters
    ----------
    lps_from_start : (4, 4) float64
        +z is the direction of insertion.
    target : (3,) float64, LPS mm
    branch : int
        Pierced branch, whose wall is exempt at the exit; -1 for none.
    inserted_mm, turned_rad : float
        Length of the needle behind the start and its accumulated turn: the limits count both, and so does
        the exemption at the exit.
    reference : (3,) float64, optional
        Direction from which the limit of the angle counts; by default that of the start.

    Raises
    ------
    FrameError
        If there are not so many finite numbers, the pose is not rigid, or the reference has no length.
    SettingsError
        If the length or the turn behind the start is negative or not finite.
    """

    lps_from_start: Float
    target: Float
    branch: int = -1
    inserted_mm: float = 0.0
    turned_rad: float = 0.0
    reference: Float | None = None

    @property
    def goal(self) -> tuple[float, float, float]:
        """The target as the kernels take it."""
        x, y, z = self.target.tolist()
        return x, y, z

    def __post_init__(self) -> None:
        frame = np.array(self.lps_from_start, dtype=np.float64)
        target = np.array(self.target, dtype=np.float64)
        if frame.shape != (4, 4) or target.shape != (3,) or not np.isfinite([*frame.flat, *target]).all():
            raise FrameError(
                f"A needle query has a start of shape {frame.shape} and a target of shape {target.shape}",
                expected="a 4x4 pose and three coordinates, all finite, LPS mm",
            )
        rotation = frame[:3, :3]
        if np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
            raise FrameError(
                "The start of a needle query is not a right-handed rigid pose", expected="a rotation"
            )
        for name, value in (("inserted length", self.inserted_mm), ("accumulated turn", self.turned_rad)):
            if not 0.0 <= value < math.inf:
                raise SettingsError(f"The {name} is {value}", expected="a finite number of 0 or more")
        object.__setattr__(self, "lps_from_start", frame)
        object.__setattr__(self, "target", target)
        if self.reference is not None:
            object.__setattr__(self, "reference", _unit(np.array(self.reference, dtype=np.float64)))


def _unit(direction: Float) -> Float:
    length = float(np.linalg.norm(direction)) if direction.shape == (3,) else math.nan
    if not 0.0 < length < math.inf:
        raise FrameError(
            f"The reference direction of a needle query is {direction.tolist()}",
            expected="three finite numbers, not all 0",
        )
    return direction / length

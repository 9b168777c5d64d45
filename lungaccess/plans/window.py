"""The window of a plan in the breath: the phases in which it is proved clear and on target."""

import math
from collections.abc import Callable
from dataclasses import field

import numpy as np

from anatomy.base.errors import PlanFileError
from anatomy.base.records import LEFT_OUT_IF_EMPTY, frozen_record
from anatomy.base.typed import Float
from lungaccess.plans.record import Record, shaped


@frozen_record
class WindowLimit(Record):
    """What ends a window, or leaves none.

    Args:
        phase: The end of the window; without a window a phase near that of the masks.
        reason: "target" if the end of the devices is too far from it, "lumen" if the tubes leave the airway
            before their exit, "hole" if they shift in the hole in its wall by more than their radius, else
            the structure that is too near: "airway", "vessel", "outside" or "fissure".
        device: "tube" or "needle".
        arc_length_mm: Where on the device, from the tip of the scope or of the tubes.
        place_lps ((3,) float64, LPS mm): The same in the frame of the plan.
    """

    phase: float
    reason: str
    device: str
    arc_length_mm: float
    place_lps: Float = field(metadata=shaped(3))

    @property
    def what(self) -> str:
        """What ends the window, in words, without the place."""
        return {
            "target": "the devices end too far from the target",
            "hole": "the tubes shift by more than their radius in the hole in the airway wall",
            "lumen": "the tubes leave the lumen before their exit",
            "airway": f"the {self.device} comes too near to an airway",
            "outside": f"the {self.device} comes too near to the pleura",
        }.get(self.reason, f"the {self.device} comes too near to a {self.reason}")

    @property
    def words(self) -> str:
        """What ends the window, in words."""
        return f"{self.what}, {self.arc_length_mm:.1f} mm along the {self.device}"


@frozen_record
class BreathingAim(Record):
    """Where devices end beside the target of the masks' phase: planned for a window, or with a tool.

    Args:
        point_lps ((3,) float64, LPS mm): Where tubes and needle end in the masks' phase.
        phases ((N, 2) float64): First and last of the phases that were asked for, all of which the window
            holds; N is 0 or 1, and 0 with a tool.

    Raises:
        PlanFileError: If the phases are not one stretch within 0 to 1.
    """

    point_lps: Float = field(metadata=shaped(3))
    phases: Float = field(metadata=shaped(None, 2))

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.phases) > 1 or not all(0.0 <= a < b <= 1.0 for a, b in self.phases):
            raise PlanFileError(
                f"The aim of a plan is made for the phases {self.phases.tolist()}",
                expected="one stretch within 0 to 1, or none",
            )


@frozen_record
class BreathingWindow(Record):
    """Phases from 0 (end-exhale) to 1 (end-inhale) in which tubes and needle, held still, may be in the lung.

    Args:
        motion_key: SHA-256 of the motion that it was made with.
        motion_source: Where that came from, in words.
        warning_only: Whether it is a model of other people's lungs.
        masks_phase, amplitude: The phase that the masks show, and the motion as a share of the source's.
        tolerance_mm: Largest distance between the end of the devices and the moving target.
        phases ((N, 2) float64): First and last phase of each stretch that is proved.
        undecided_share: Share of the breath of which neither could be proved; it is not in the window.
        limits: What ends the stretches within the breath, in their order; without any, what forbids a phase
            near that of the masks.
        hysteresis: How far tissue may stray from where the motion puts it, as a share of its distance from
            the scope's tip; all of the above holds for any such way.
        beside_target_mm: How far beside the target devices with an aim end in the masks' phase; 0 for others,
            which end there.

    Raises:
        PlanFileError: If the phases are not stretches in order within 0 to 1.
    """

    motion_key: str
    motion_source: str
    warning_only: bool
    masks_phase: float
    amplitude: float
    tolerance_mm: float
    phases: Float = field(metadata=shaped(None, 2))
    undecided_share: float
    limits: tuple[WindowLimit, ...]
    hysteresis: float = field(default=0.0, metadata={LEFT_OUT_IF_EMPTY: True})
    beside_target_mm: float = field(default=0.0, metadata={LEFT_OUT_IF_EMPTY: True})

    def __post_init__(self) -> None:
        super().__post_init__()
        ends = np.asarray(self.phases).ravel()
        if len(ends) and not (ends[0] >= 0.0 and ends[-1] <= 1.0 and (np.diff(ends) >= 0.0).all()):
            raise PlanFileError(
                f"The window of a plan has the phases {self.phases.tolist()}",
                expected="stretches within 0 to 1, in order, that do not overlap",
            )

    def holds_all(self, phases: tuple[float, float]) -> bool:
        """Tell whether one stretch of the window holds all phases from the first to the last."""
        first, last = phases
        return bool(((self.phases[:, 0] <= first) & (self.phases[:, 1] >= last)).any())

    @property
    def share(self) -> float:
        """The share of the phases that the window holds."""
        return float(np.diff(self.phases, axis=1).sum())

    def holds(self, phase: float) -> bool:
        """Tell whether a phase is in the window."""
        return bool(((self.phases[:, 0] <= phase) & (phase <= self.phases[:, 1])).any())

    @property
    def words(self) -> str:
        """The window in sentences, where an aim is, and whether it is a warning only."""
        said, beside = self._stretches, self.beside_target_mm
        if beside:
            said += f" In the phase of the masks the devices end {beside:.1f} mm beside the target."
        return f"{said} {WARNING}" if self.warning_only else said

    @property
    def _stretches(self) -> str:
        if not len(self.phases):
            return f"No phase of the breath is proved: {self.limits[0].words if self.limits else 'unknown'}."
        parts = [f"{_percent(a, math.ceil)} and {_percent(b, math.floor)}" for a, b in self.phases]
        ends = "; ".join(f"at {100.0 * each.phase:.1f} % {each.words}" for each in self.limits)
        said = f"Insert between {', or '.join(parts)} of the breath (0 % is end-exhale, 100 % end-inhale)."
        if self.hysteresis:
            percent = f"{100.0 * self.hysteresis:g} %"
            said += f" It holds for tissue that strays by {percent} of its distance from the tip."
        return f"{said} {ends[:1].upper()}{ends[1:]}." if ends else said


WARNING = "The motion is that of other people's lungs: this is a warning, not a promise."


def _percent(phase: float, inwards: Callable[[float], int]) -> str:
    """Return a phase in percent, rounded into the window."""
    return f"{inwards(1000.0 * phase) / 10.0:g} %"

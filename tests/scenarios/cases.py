"""What the scenarios are: anatomies, devices, planners, and how far each search goes.

A case is an anatomy, a device and a planner; its targets, and the needle queries of an anatomy, are stored
in expected.json, so that they stay the same when the code that drew them changes.
"""

from __future__ import annotations

from anatomy.base.records import frozen_value

COST_TOLERANCE = 0.02
"""Share by which a cost may exceed the stored one: rounding that differs between processors, no more."""


@frozen_value
class Anatomy:
    """A synthetic patient by seed, or a real one by name.

    Args:
        name: For a real patient the name of its folder below med-rad.
        seed: Of the synthetic patient; None for a real one.
        spacing_mm: Voxel size of a synthetic patient, None for the default.
        fissures_allowed: Whether needles may cross fissures.
        devices: Presets that plans are made for.
    """

    name: str
    seed: int | None = None
    spacing_mm: float | None = None
    fissures_allowed: bool = False
    devices: tuple[str, ...] = ("flexure-needle", "lung-default", "therapeutic-scope", "ultrathin")

    @property
    def is_real(self) -> bool:
        """Whether it needs the data."""
        return self.seed is None


@frozen_value
class Planner:
    """A method of `lungaccess.plan` with its objective, and how long it searches."""

    method: str
    objective: str
    iterations: int


@frozen_value
class Case:
    """One planner for one device in one anatomy, to all targets of the anatomy."""

    anatomy: Anatomy
    device: str
    planner: str

    @property
    def name(self) -> str:
        """The key of its expectations."""
        return f"{self.anatomy.name}/{self.device}/{self.planner}"


ANATOMIES = (
    Anatomy(name="phantom-1", seed=1),
    Anatomy(name="phantom-3", seed=3),
    Anatomy(
        name="phantom-2-coarse-open", seed=2, spacing_mm=1.5, fissures_allowed=True,
        devices=("flexure-needle", "lung-default"),
    ),
    Anatomy(name="Patient1"),
    Anatomy(name="Patient2", devices=("flexure-needle", "lung-default")),
)  # fmt: skip
PLANNERS = {
    "atlas": Planner(method="atlas", objective="inverse_clearance", iterations=100),
    # The shortest paths pass as near to obstacles as they may: here a clearance that is not kept shows.
    "atlas-shortest": Planner(method="atlas", objective="length_mm", iterations=100),
    "kuntz2015": Planner(method="kuntz2015", objective="inverse_clearance", iterations=3000),
}
ALL_PLANNERS_DEVICE = "flexure-needle"
"""The device for which all planners are run; for others, only the first."""
DEFAULT_DEVICE = "lung-default"
"""That of the default tests."""
LONG_PLANNERS = ("kuntz2015",)
"""Those that the default tests leave out."""
CASES = tuple(
    Case(anatomy=anatomy, device=device, planner=planner)
    for anatomy in ANATOMIES
    for device in anatomy.devices
    for planner in PLANNERS
    if planner == "atlas" or device == ALL_PLANNERS_DEVICE
)

NEEDLE_DEVICE = "flexure-needle"
NEEDLE_OBJECTIVE = "inverse-clearance"
NEEDLE_PLANNERS = ("rrt", "optimal", "resolution", "decide")
NEEDLE_ITERATIONS = 5000
SHARED_QUERIES = (
    "P1_R121_00", "P1_R121_14", "P1_R50_07", "P1_R50_12", "P1_R50_14",
    "P2_R121_09", "P2_R121_16", "P2_R50_04", "P2_R50_19", "P2_R50_23",
)  # fmt: skip
"""Recorded hard queries of real patients, planned for by length; another planner solves four of five."""

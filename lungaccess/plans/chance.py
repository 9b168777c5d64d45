"""The chance of success of a plan as it is stated: counts of simulated procedures, and what they rest on."""

from collections.abc import Mapping
from dataclasses import field

from anatomy.base.errors import PlanFileError
from anatomy.base.records import LEFT_OUT_IF_EMPTY, frozen_record
from lungaccess.plans.record import Record


@frozen_record
class Chance(Record):
    """How many simulated procedures of a plan succeed.

    Args:
        errors, procedure: What the error model and the procedure are called.
        corrections: What is measured and corrected on the way, in a sentence.
        assumed: Kinds of error whose size nobody has published.
        radius_mm, radius_origin: Radius of the goal about the target, and where it came from; of a tool,
            which nodule counts.
        tissue: What has to be in the tool in words, such as "at least 5 mm of the nodule in the core needle";
            empty without a tool.
        with_needle: Whether it is the needle that ends at the target; the tubes do so without one.
        samples, seed: Simulated procedures, and the seed of their random numbers.
        failures: What made procedures fail, and how many; in open loop one procedure may fail for several
            reasons.

    Raises:
        PlanFileError: If a count is negative or exceeds the samples.
    """

    errors: str
    procedure: str
    corrections: str
    sizes: str
    assumed: tuple[str, ...]
    radius_mm: float
    radius_origin: str
    with_needle: bool
    samples: int
    seed: int
    successes: int
    failures: Mapping[str, int]
    tissue: str = field(default="", metadata={LEFT_OUT_IF_EMPTY: True})

    @property
    def success_words(self) -> str:
        """What counts as success beside touching nothing forbidden, in words."""
        last = "needle ends" if self.with_needle else "tubes end"
        aim = self.tissue or f"the {last} within {self.radius_mm:.1f} mm of the target"
        return f"{aim} ({self.radius_origin})"

    @property
    def share(self) -> float:
        """The share of successes."""
        return self.successes / self.samples

    def __post_init__(self) -> None:
        super().__post_init__()
        counts = (self.successes, *self.failures.values())
        if self.samples < 1 or not all(0 <= count <= self.samples for count in counts):
            raise PlanFileError(
                f"The chance of a plan counts {self.successes} successes of {self.samples} procedures",
                expected="counts from 0 to the number of procedures",
            )

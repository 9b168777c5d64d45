"""What a run ended with, as plain values that go from workers to the results file."""

from collections.abc import Mapping
from dataclasses import field
from typing import Any

from anatomy.base.records import frozen_value
from lungaccess.plans.version import software_kernels

PLAN, PATH, NO_PLAN = "plan", "path", "no plan"
"""Outcomes of runs; another one is the class of the error that ended the run."""

STATUS = (
    "Unknown status", "Invalid start", "Invalid goal", "Unrecognized goal type", "Timeout",
    "Approximate solution", "Exact solution", "Crash",
)  # fmt: skip
"""OMPL's words for the end of a run, by number."""
UNKNOWN, INVALID_GOAL, TIMEOUT, EXACT, CRASH = 0, 2, 4, 6, 7
"""The numbers of those that runs end with."""


@frozen_value
class Improvement:
    """A plan that is better than those before."""

    time_s: float
    iteration: int
    cost: float


@frozen_value
class Answer:
    """What a run ended with.

    Args:
        outcome: `PLAN`, `PATH`, `NO_PLAN`, or the class of the error that ended the run.
        status: Number of OMPL's word for it in `STATUS`.
        kernels: Digest of the kernels of the process that made the run.
        failed: Whether the run could not be made: a file was missing, the machine had no memory, a worker was
            lost.  Such a run is made again when the study is started the next time.
        message, advice: Why there is no plan, and what would help.
        time_s, cpu_s: Of the whole run, without opening the patient.
        memory_mb: Resident memory of the process after the run, MiB.
        accepted: Whether the independent check accepts the plan; for a needle path, whether nothing objects
            to it.
        costs: By the keys of `stages.needle.TERMS`.
        findings: What the check looked at; see `lungaccess.judging.checking.findings.Finding.to_mapping`.
        rejections: The reasons of `NoPlan`, counted.
        plan: JSON of the plan or of the needle's path; "" if there is none.
        digest: Hash of the plan without its times.
    """

    key: str
    outcome: str
    status: int
    kernels: str = field(default_factory=software_kernels)
    failed: bool = False
    message: str = ""
    advice: str = ""
    time_s: float = 0.0
    cpu_s: float = 0.0
    memory_mb: float = 0.0
    iterations: int = 0
    accepted: bool = False
    costs: Mapping[str, float] = field(default_factory=dict)
    improvements: tuple[Improvement, ...] = ()
    findings: tuple[Mapping[str, Any], ...] = ()
    rejections: Mapping[str, int] = field(default_factory=dict)
    plan: str = ""
    digest: str = ""

    @property
    def solved(self) -> bool:
        """Whether there is a plan or path."""
        return self.outcome in (PLAN, PATH)

    @staticmethod
    def from_mapping(values: Mapping[str, Any]) -> "Answer":
        """Return the answer that `dataclasses.asdict` made plain."""
        made = tuple(Improvement(**each) for each in values["improvements"])
        return Answer(**{**values, "improvements": made, "findings": tuple(values["findings"])})

"""What a study is: cases, planners, seeds and a budget, read from a TOML file."""

import os
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Field

from anatomy.base.errors import LungaccessError, SettingsError
from anatomy.base.files import read_toml
from anatomy.base.records import LEFT_OUT_IF_EMPTY
from anatomy.base.settings import impossible, parse, quantity, settings, switch, text
from lungaccess.problem.goals import SUCCESS
from lungaccess.problem.request import goal_of
from stages.needle import DEFAULT, NEEDLE_PLANNERS, OMPL_PLANNERS, require_planner
from stages.tube import DEFAULT_ROTATIONS, DEFAULT_STOP_MM

T = TypeVar("T")
PHANTOM = "phantom"
_REMEDY = "`lungaccess template study` prints a complete file to start from"
Seed = Annotated[int, Field(strict=True, ge=0)]
Iterations = Annotated[int, Field(strict=True, ge=0, description="iterations beyond the direct arcs")]


class StudyError(LungaccessError):
    """A study cannot go on: its library, its scheduler or its workers are not there."""


@settings
class PhantomPatient:
    """Which synthetic patient a case is about; see `anatomy.phantom.phantom`."""

    seed: Annotated[int, Field(strict=True, ge=0, description="seed of the synthetic patient")] = 0
    size: Annotated[Literal["adult", "small"], Field(description="adult or small")] = "adult"
    spacing_mm: Annotated[float | None, Field(strict=True, gt=0, description="edge of the voxels")] = None


@settings
class Peripheral:
    """Random targets of a case; see `lungaccess.problem.peripheral.peripheral_targets`."""

    per_lung: Annotated[int, Field(strict=True, ge=0, description="targets on each side")] = 0
    seed: Annotated[int, Field(strict=True, ge=0, description="seed of the points")] = 0


@settings
class Case:
    """A patient, a system and targets.

    Args:
        anatomy: "phantom", or a patient's folder; a relative one is relative to the study's file.
        system: Preset, or TOML file relative to the study's file.
        fissures_allowed: Whether fissures may be crossed; None for what the system says.
        objective: What plans are made good at, unless a planner states a goal; see `goal_of`.
        errors, procedure: Error model and procedure under which the chance of success of each plan is
            counted: presets, or TOML files relative to the study's file.  Without errors none is counted.
        targets: "ras:x,y,z", "lps:x,y,z", "nodule" or "nodule N"; `peripheral` adds random ones.
        starts: For needle planners: numbers of the start poses that came with the patient.
    """

    name: Annotated[str, text("name of the case")]
    anatomy: Annotated[str, text("phantom, or a patient's folder")]
    phantom: PhantomPatient = PhantomPatient()
    system: Annotated[str, text("preset or TOML file")] = "lung-default"
    fissures_allowed: Annotated[bool | None, switch("whether a fissure may be crossed")] = None
    objective: Annotated[str, text("what is minimised")] = DEFAULT
    errors: Annotated[str, text("error model: preset or TOML file", may_be_empty=True)] = ""
    procedure: Annotated[str, text("procedure: preset or TOML file")] = "open-loop"
    targets: Annotated[tuple[str, ...], Field(description="points with their frame, or nodules")] = ()
    peripheral: Peripheral = Peripheral()
    starts: Annotated[tuple[Seed, ...], Field(description="start poses of the needle, from 1")] = ()

    def __post_init__(self) -> None:
        if not self.targets and not self.peripheral.per_lung:
            raise impossible("targets", self.targets, "at least one target, or [case.peripheral]")
        try:
            goal_of(self.objective)
        except SettingsError as error:
            raise impossible("objective", self.objective, error.expected) from None


@settings
class PlannerChoice:
    """A planner of the study, and how tables call it.

    Args:
        kind: "plan" for all three stages, "needle" for the needle alone from the case's start poses.
        method: One of `lungaccess.planning.searches.planners`, or for the needle of `NEEDLE_PLANNERS`.
        goal: For "plan", what plans are made good at instead of the case's objective, such as "success".
        own_process: Whether each run has a fresh process; OMPL's planners have one in any case.
        without_counterfactuals: Whether a run that finds nothing goes without the search for a device that
            would.
    """

    name: Annotated[str, text("name of the planner in tables")]
    kind: Annotated[Literal["plan", "needle"], Field(description="plan or needle")] = "plan"
    method: Annotated[str, text("a method of plan, or a planner of the needle")] = "atlas"
    goal: Annotated[str, text("what plans are made good at", may_be_empty=True)] = field(
        default="", metadata={LEFT_OUT_IF_EMPTY: True}
    )
    needle_planner: Annotated[str, text("a planner of the needle", may_be_empty=True)] = ""
    iterations: Iterations | None = None
    own_process: Annotated[bool, switch("whether each run has a fresh process")] = False
    without_counterfactuals: Annotated[bool, switch("whether a failure is left without advice")] = field(
        default=False, metadata={LEFT_OUT_IF_EMPTY: True}
    )

    def __post_init__(self) -> None:
        known = methods(self.kind)
        if self.method not in known:
            raise impossible("method", self.method, f"one of {', '.join(known)}")
        if self.goal and self.kind == "needle":
            raise impossible("goal", self.goal, "none, for a planner of the needle alone")
        if self.goal:
            goal_of(self.goal)
        if self.needle_planner and self.kind == "needle":
            raise impossible("needle_planner", self.needle_planner, "none, for a planner of the needle")
        if self.needle_planner:
            require_planner(self.needle_planner)

    @property
    def of_the_needle(self) -> str:
        """The planner of the needle that it names; empty for the method's own."""
        return self.method if self.kind == "needle" else self.needle_planner

    @property
    def is_of_ompl(self) -> bool:
        """Whether it is a planner of OMPL, whose random numbers can be seeded once in a process."""
        return self.of_the_needle in OMPL_PLANNERS

    @property
    def needs_a_needle(self) -> bool:
        """Whether it plans for no system that has none."""
        from lungaccess.planning import NEED_A_NEEDLE

        return self.kind == "needle" or bool(self.needle_planner) or self.method in NEED_A_NEEDLE


@settings
class Budget:
    """How long a run may search: by iterations, which can be repeated exactly, or by time, or both.

    With `first_plan` it ends with its first plan, if that comes earlier.
    """

    iterations: Iterations | None = None
    time_s: Annotated[float | None, Field(strict=True, gt=0, description="planning time of a run")] = None
    first_plan: Annotated[bool, switch("whether a run ends with its first plan")] = False

    def __post_init__(self) -> None:
        if self.iterations is None and self.time_s is None:
            raise impossible("iterations", None, "iterations, time_s or both")


@settings
class AtlasGrid:
    """How densely deployments are enumerated; see `lungaccess.planning.coupled.atlas.build_atlas`."""

    rotations: Annotated[int, Field(strict=True, ge=1, description="rotations of the tubes")] = (
        DEFAULT_ROTATIONS
    )
    stop_spacing_mm: Annotated[float, quantity("spacing of insertions", above=0)] = DEFAULT_STOP_MM
    site_spacing_mm: Annotated[float, quantity("spacing of sites", above=0)] = 1.0


@settings
class Study:
    """Every case with every planner and every seed.

    Args:
        folder: What relative paths are relative to; that of the file if it was read from one.
    """

    name: Annotated[str, text("name of the study")]
    case: Annotated[tuple[Case, ...], Field(min_length=1, description="at least one [[case]]")]
    planner: Annotated[tuple[PlannerChoice, ...], Field(min_length=1, description="at least one [[planner]]")]
    seeds: Annotated[tuple[Seed, ...], Field(min_length=1, description="at least one seed")] = (0,)
    budget: Budget
    atlas: AtlasGrid = AtlasGrid()
    folder: Annotated[str, text("what relative paths are relative to")] = "."

    def __post_init__(self) -> None:
        for key, names in (
            ("case", [each.name for each in self.case]),
            ("planner", [each.name for each in self.planner]),
            ("seeds", list(self.seeds)),
        ):
            if len(set(names)) < len(names):
                raise impossible(key, names, "each only once")
        of_ompl = [each for each in self.planner if each.kind == "needle" and each.is_of_ompl]
        if self.budget.time_s is None and of_ompl:
            raise impossible("budget", "no time_s", "time_s, which planners of OMPL end by")
        by_success = {each.goal for each in self.planner} | {each.objective for each in self.case}
        if SUCCESS.name in by_success and not all(case.errors for case in self.case):
            raise impossible("case", 'errors = ""', "errors in every case, for the goal success")
        if any(each.kind == "needle" for each in self.planner) and not all(c.starts for c in self.case):
            raise impossible("case", "starts = []", "start poses in every case, for planners of the needle")


def methods(kind: str) -> tuple[str, ...]:
    """Return the names of the planners of a kind, "plan" or "needle"."""
    if kind == "needle":
        return NEEDLE_PLANNERS
    from lungaccess.planning import planners

    return tuple(planners())


def read_study(path: str | os.PathLike[str]) -> Study:
    """Read a study from a TOML file.

    Raises:
        SettingsError: If the file is not TOML, or a key is unknown, missing or wrong.
        FileError: If the file cannot be read.
    """
    path = Path(path)
    return study_of(read_toml(path, remedy=_REMEDY), path.name, str(path.parent))


def study_of(content: Mapping[str, Any], where: str = "study", folder: str = ".") -> Study:
    """Return the study that plain values describe, as of a TOML file; SettingsError if a key is wrong."""
    values = dict(content)
    if "folder" in values:
        raise SettingsError(
            f"{where}: folder is not a setting", remedy=_REMEDY, expected="the keys of a study"
        )
    try:
        for key, cls in (("case", Case), ("planner", PlannerChoice)):
            if key in values:
                values[key] = _listed(cls, values[key], f"{where}, {key}")
        return parse(Study, {**values, "folder": folder}, where)
    except SettingsError as error:
        raise SettingsError(error.found, expected=error.expected, remedy=_REMEDY) from None


def _listed(cls: type[T], tables: object, where: str) -> tuple[T, ...]:
    """Read each table of an array of tables by itself, so that an error names the number of the table."""
    if not isinstance(tables, list) or not all(isinstance(each, Mapping) for each in tables):
        raise SettingsError(f"{where} is not an array of tables", expected="[[...]]", remedy=_REMEDY)
    return tuple(parse(cls, each, f"{where} {number}") for number, each in enumerate(tables, start=1))

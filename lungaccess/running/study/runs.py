"""The runs of a study: every case, target and start with every planner and seed, each with its key."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import field, fields, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

from anatomy.base.checksums import canonical_sha256
from anatomy.base.errors import FileError, LungaccessError
from anatomy.base.records import frozen_value
from anatomy.base.settings import to_mapping
from anatomy.build import lung_key
from anatomy.io.frames import parse_point
from anatomy.lung import Lung
from anatomy.patient import PatientImages
from lungaccess.plans.version import software_kernels, software_version
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.errors import ErrorModel
from lungaccess.problem.peripheral import peripheral_targets
from lungaccess.problem.procedures import Procedure, load_procedure
from lungaccess.problem.request import goal_of
from lungaccess.problem.system import System, load_system, system_fingerprint
from lungaccess.problem.target import nodule_target
from lungaccess.running.study.settings import PHANTOM, Case, PhantomPatient, PlannerChoice, Study


@frozen_value
class Patient:
    """A patient by content, and where to read it where no cache holds it.

    Args:
        anatomy: "phantom", or an absolute folder.
        spacing_mm: Of the synthetic patient.
        sources (tuple of (str, str)): Name and SHA-256 of every input.
    """

    anatomy: str
    seed: int
    size: str
    spacing_mm: float | None
    sources: tuple[tuple[str, str], ...]

    @property
    def key(self) -> str:
        """Key of the lung made from these inputs."""
        return lung_key(dict(self.sources))


def _patient_of(case: Case, folder: Path) -> Patient:
    """Return the patient of a case, whose folder may lie in `folder`; LungaccessError if it is unreadable."""
    from anatomy.io.inputs import input_hashes

    made = case.phantom
    if case.anatomy == PHANTOM:
        place, sources = PHANTOM, _phantom_sources(made)
    else:
        place = str((folder / case.anatomy).resolve())
        sources = input_hashes(Path(place))
    return Patient(anatomy=place, **vars(made), sources=tuple(sorted(sources.items())))


def open_patient(patient: Patient, cache: Path | None = None) -> Lung:
    """Return the lung of a patient, from the cache or newly built.

    Raises:
        FileError: If what is read is not what the study was set up with.
        LungaccessError: If the patient cannot be read.
    """
    from anatomy.store import open_lung

    return open_lung(dict(patient.sources), lambda: _read(patient), cache=cache, accept=())


def _read(patient: Patient) -> PatientImages:
    from anatomy.io.inputs import input_hashes
    from anatomy.io.patients import load_patient

    if patient.anatomy == PHANTOM:
        images = _phantom_images(
            PhantomPatient(seed=patient.seed, size=patient.size, spacing_mm=patient.spacing_mm)  # type: ignore[arg-type]
        )
        found = dict(images.sources)
    else:
        images, found = load_patient(Path(patient.anatomy)), input_hashes(Path(patient.anatomy))
    if found != dict(patient.sources):
        raise FileError(
            f"The files of {patient.anatomy} differ from those the study began with",
            expected="the same files on every machine",
            remedy="Copy the patient's folder again, and start the study once more",
        )
    return images


@lru_cache(maxsize=16)
def _phantom_sources(made: PhantomPatient) -> dict[str, str]:
    return dict(_phantom_images(made).sources)


def _phantom_images(made: PhantomPatient) -> PatientImages:
    from anatomy.phantom import make_phantom

    return make_phantom(seed=made.seed, spacing_mm=made.spacing_mm, size=made.size).images


OF_THEIR_OWN_CLASS = ("patient", "system", "errors", "procedure")
"""The fields of a problem that are not plain values."""
RUN_FORMAT = 1
"""Raise it when what a run does changes: stored runs of another format are run anew."""


@frozen_value
class Problem:
    """What is asked of the planners: everything but planner and seed.

    Args:
        target_lps (tuple of 3 float): LPS mm.
        start: Number of the needle's start pose, 0 for none.
        stop_spacing_mm, site_spacing_mm: Of the deployment atlas.
        first_plan: Whether a run ends with its first plan.
        errors: Under which the chance of success of a plan is counted; None for not at all.
        procedure: By which it is counted.
    """

    case: str
    patient: Patient
    system: System
    objective: str
    target: int
    target_lps: tuple[float, float, float]
    origin: str
    start: int
    rotations: int
    stop_spacing_mm: float
    site_spacing_mm: float
    iterations: int | None
    time_s: float | None
    first_plan: bool = False
    errors: ErrorModel | None = None
    procedure: Procedure = Procedure()

    @property
    def patient_name(self) -> str:
        """What tables call the patient."""
        return Path(self.patient.anatomy).name

    def to_mapping(self) -> dict[str, Any]:
        """Return what the answers depend on, as plain JSON types; where the patient lies does not."""
        plain = {
            item.name: getattr(self, item.name)
            for item in fields(self)
            if item.name not in OF_THEIR_OWN_CLASS
        }
        counted = {"errors": self.errors, "procedure": self.procedure} if self.errors is not None else {}
        return {
            **plain,
            "target_lps": list(self.target_lps),
            "lung": self.patient.key,
            "system": system_fingerprint(self.system),
            "version": software_version(),
            "format": RUN_FORMAT,
            **{name: to_mapping(each) for name, each in counted.items()},
        }

    @cached_property
    def key(self) -> str:
        """Hash (hex) of all that the answers depend on besides planner and seed."""
        return canonical_sha256(self.to_mapping())


@frozen_value
class Run:
    """One run: a problem, a planner and a seed."""

    problem: Problem
    planner: PlannerChoice
    seed: int

    @property
    def iterations(self) -> int | None:
        """Iterations of the run: the planner's own, or those of the budget."""
        own = self.planner.iterations
        return self.problem.iterations if own is None else own

    @cached_property
    def key(self) -> str:
        """Hash (hex) of all that the answer depends on."""
        planner = to_mapping(self.planner)
        return canonical_sha256({"problem": self.problem.key, "planner": planner, "seed": self.seed})


def runs_of(
    study: Study, *, cache: Path | None = None, progress: Callable[[str], None] | None = None
) -> Iterator[Run]:
    """Yield the runs of a study, case by case; each patient is opened once to find the targets.

    LungaccessError is raised if a patient or a system cannot be read, a target cannot be understood, there is
    no such nodule, or a planner needs a needle that a system does not have.
    """
    for case in study.case:
        (progress or (lambda _words: None))(f"targets of {case.name}")
        folder = Path(study.folder)
        patient = _patient_of(case, folder)
        system = load_system(beside(case.system, folder), fissures_allowed=case.fissures_allowed)
        counted: dict[str, Any] = {}
        if case.errors:
            counted = {
                "errors": load_errors(beside(case.errors, folder)),
                "procedure": load_procedure(beside(case.procedure, folder)),
            }
        for planner in study.planner:
            if planner.needs_a_needle:
                system.require_needle(f"The planner {planner.name!r} of the study")
        lung = open_patient(patient, cache)
        objective, targets = goal_of(case.objective, lung).name, _targets(case, lung)
        for number, (point, origin) in enumerate(targets, start=1):
            problem = Problem(
                case=case.name,
                patient=patient,
                system=system,
                objective=objective,
                target=number,
                target_lps=point,
                origin=origin,
                start=0,
                **vars(study.atlas),
                **vars(study.budget),
                **counted,
            )
            for planner in study.planner:
                for start in case.starts if planner.kind == "needle" else (0,):
                    of_start = replace(problem, start=start)
                    yield from (Run(problem=of_start, planner=planner, seed=seed) for seed in study.seeds)


Point = tuple[float, float, float]


def beside(name: str, folder: Path) -> str:
    """Return the name of a preset as it is, and that of a file as it lies in the study's folder."""
    return str(folder / name) if name.endswith(".toml") else name


def _targets(case: Case, lung: Lung) -> list[tuple[Point, str]]:
    """Return points and where they came from; whether a needle may end there is part of the run."""
    found = [_stated(lung, words) for words in case.targets]
    drawn = peripheral_targets(lung, case.peripheral.per_lung, case.peripheral.seed)
    return found + [(_point(each), f"peripheral {n}") for n, each in enumerate(drawn, start=1)]


def _stated(lung: Lung, words: str) -> tuple[Point, str]:
    first, *rest = words.split()
    if first != "nodule":
        return _point(parse_point(words)), f"point {words}"
    if len(rest) > 1 or not all(each.isdigit() for each in rest):
        raise LungaccessError(
            f"{words!r} is not a target",
            expected="nodule, or nodule N with a whole number",
            remedy="Correct `targets` in the study's file",
        )
    target = nodule_target(lung, int(rest[0]) if rest else 1)
    return _point(target.lps_mm), target.origin


def _point(values: Any) -> Point:
    x, y, z = (float(value) for value in values)
    return x, y, z


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
        accepted: Whether the independent check accepts the plan; nothing objects to the path of a needle.
        costs: By the keys of `stages.needle.TERMS`.
        findings: What the check looked at, see `Finding.to_mapping`.
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

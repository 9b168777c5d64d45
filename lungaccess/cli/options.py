"""Options that several commands take: each is defined, explained and read once.

Every class is a group of options that cyclopts flattens into those of a command.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from anatomy.base.errors import SettingsError
from anatomy.base.files import require_writable_folder
from anatomy.base.records import frozen_value
from anatomy.plausibility import require_known_checks
from lungaccess.cli import lazy
from lungaccess.cli.numbers import Count, NotNegative, Probability, Processes, Seconds, Seed, Whole
from lungaccess.cli.progress import progress
from lungaccess.problem.goals import SUCCESS, WINDOW
from lungaccess.problem.request import ATLAS, AUTO, Request, StatedPlace, goal_of, require_phases
from stages.needle import DEFAULT, NEEDLE_PLANNERS, OUR_PLANNERS, TERMS

if TYPE_CHECKING:
    GoalText = str
    ObjectiveText = str
    OurPlannerName = str
    PlannerName = str
else:
    ObjectiveText = Literal[DEFAULT, *(term.option for term in TERMS)] | str
    GoalText = Literal[SUCCESS.name, WINDOW.name, DEFAULT, *(term.option for term in TERMS)] | str
    OurPlannerName, PlannerName = Literal[OUR_PLANNERS], Literal[NEEDLE_PLANNERS]
"""The costs by name, for help and completion, or a weighted sum, which `Objective.of` reads; the planners."""

PatientFolder = Annotated[
    Path, Parameter(help="Folder of masks: Med-RAD, TotalSegmentator, or own masks with a patient.toml.")
]
PlanFile = Annotated[Path, Parameter(help="The plan.json.")]
PatientOfPlan = Annotated[Path, Parameter(help="Folder of the patient it was made for.")]
DEFAULT_SYSTEM = "lung-default"
DEFAULT_BUDGET_S = 10.0
"""Long enough that the best cost of most targets has settled, short enough to wait for."""

FrameOfPose = Annotated[
    Literal["ras", "lps"] | None,
    Parameter(
        help="Frame of the numbers in a text file with a pose, which cannot state it: needed with one."
    ),
]
PhasesText = Annotated[
    str | None,
    Parameter(
        help="Phases of the breath, 0 end-exhale to 1 end-inhale, in all of which the devices have to be "
        "clear and on target, such as 0.0:0.3; the patient needs a [motion] in its patient.toml."
    ),
]
STEP_SHARES = {
    "reading images": 0.02, "airway tree": 0.12, "labels": 0.24, "plausibility of the masks": 0.35,
    "clearance to airway": 0.45, "clearance to vessel": 0.57, "clearance to pleura": 0.69,
    "clearance to fissure": 0.80,
}  # fmt: skip
"""Share of the preparation that is done when a step begins, as measured on CT of 512 x 512 x 500 voxels."""


@Parameter(name="*")
@frozen_value
class PatientOptions:
    """How a patient is read.

    Args:
        accept: Checks of the masks that fail and are overruled, by the names in the message that refuses
            them, such as gap or vessels.
    """

    accept: Annotated[tuple[str, ...], Parameter(consume_multiple=1)] = ()

    def __post_init__(self) -> None:
        require_known_checks(self.accept)

    def load(self, patient: Path, *, thick_slices: bool = False) -> lazy.Lung:
        """Return a patient's lung; see `load_lung`."""
        return load_lung(patient, thick_slices, self.accept)

    def load_plan(self, plan: Path, patient: Path) -> tuple[lazy.Plan, lazy.Lung]:
        """Return a plan and the lung that it was made for; PlanFileError if it was made for another."""
        stored, lung = lazy.Plan.load(plan), self.load(patient)
        stored.require_lung(lung)
        return stored, lung

    def load_organ(self, patient: Path, *, thick_slices: bool = False, refuse: bool = True) -> lazy.Organ:
        """Return a patient's lung or a liver of Med-RAD, and show what is being done; see `load_lung`."""
        accept = self.accept if refuse else None
        if not lazy.is_liver(patient):
            return load_lung(patient, thick_slices, accept)
        with progress(f"reading {patient}"):
            return lazy.load_organ(patient, accept=accept)


@Parameter(name="*")
@frozen_value
class TargetOptions:
    """Where to go.

    Args:
        target: Target point in mm with its frame, ras:x,y,z or lps:x,y,z; a point saved in 3D Slicer,
            scene.mrml#name; or the name of a target that came with the patient, such as target1.
        nodule: Go to the centre of this nodule: its label in the nodule mask, else 1 for the largest and so
            on, see info; the largest if no number follows.
    """

    target: str | None = None
    nodule: Annotated[Whole | None, Parameter(metavar="[INT]")] = None

    def stated(self) -> lazy.StatedTarget:
        """Return what the user states, before any patient is read; errors as of `stated_target`."""
        return lazy.stated_target(self.target, self.nodule)


@Parameter(name="*")
@frozen_value
class PlaceOptions:
    """Where the tubes leave the airway, or where the tip of the scope stands.

    Args:
        exit: Let the tubes leave the airway near this point: ras:x,y,z or lps:x,y,z, or one moved in 3D
            Slicer, such as scene.mrml#exit through the wall.
        exit_within: How far from that point the tubes may leave the lumen, mm.
        scope_tip: Let the tip of the scope stand near this point, stated as for --exit.
        scope_tip_within: How far from that point the tip may stand, mm.
    """

    exit: str | None = None
    exit_within: NotNegative = 5.0
    scope_tip: str | None = None
    scope_tip_within: NotNegative = 1.5

    def stated(self) -> StatedPlace | None:
        """Return the place that the user states, None for none; SettingsError if both are stated."""
        if self.exit is not None and self.scope_tip is not None:
            raise SettingsError(
                "--exit and --scope-tip are both stated",
                expected="one place that the plan goes through",
                remedy="Leave one of them out",
            )
        if self.exit is not None:
            return StatedPlace(kind="exit", lps_mm=_point(self.exit), within_mm=self.exit_within)
        if self.scope_tip is None:
            return None
        return StatedPlace(kind="scope tip", lps_mm=_point(self.scope_tip), within_mm=self.scope_tip_within)


def _point(text: str) -> lazy.Float:
    """Return a point that a user states, or has saved in 3D Slicer, LPS mm."""
    saved = lazy.parse_reference(text)
    return lazy.parse_point(text) if saved is None else lazy.read_named_point(saved).lps_mm


@Parameter(name="*")
@frozen_value
class SystemOptions:
    """With which devices.

    Args:
        system: Name of a preset (see `lungaccess presets`), path of a TOML file, or auto: the least invasive
            preset that reaches the target (`plan` and `alternatives` only).
        allow_fissures: Whether fissures may be crossed; as the system says if not given.
    """

    system: str = DEFAULT_SYSTEM
    allow_fissures: bool | None = None

    def load(self) -> lazy.System:
        """Return the system, its rule about fissures replaced if stated; SettingsError if it is "auto"."""
        if self.system == AUTO:
            raise SettingsError(
                f"This command does not choose a system (--system {AUTO})",
                expected="the name of a preset or the path of a .toml file",
                remedy=f"`lungaccess plan --system {AUTO}` says which preset reaches a target",
            )
        return lazy.load_system(self.system, fissures_allowed=self.allow_fissures)

    def candidates(self) -> tuple[lazy.System, ...]:
        """Return the systems to try, the least invasive first: one, or all presets if it is to be chosen."""
        if self.system == AUTO:
            return lazy.presets_by_invasiveness(fissures_allowed=self.allow_fissures)
        return (self.load(),)


ToolText = Annotated[
    str | None,
    Parameter(
        help="What is done at the target: a preset (ablation, aspiration, brush, core, cryoprobe, forceps) "
        "or a TOML file. Success then counts the tissue of the nodule in the tool. As the system says if not "
        "given."
    ),
]
ErrorsText = Annotated[
    str | None,
    Parameter(
        help="Error model: a preset (breath-hold, expiratory-free, gated-ct, inspiratory-ct, resting, "
        "vision-only) or a TOML file; breath-hold if not given."
    ),
]


@Parameter(name="*")
@frozen_value
class ErrorOptions:
    """How large the errors of devices and target are assumed to be, and what a procedure measures of them.

    Args:
        known: Kinds of error whose size is known better, such as scope_direction=0.5: mm or degrees, of
            needle_curvature the logarithm of the factor.
        procedure: What is measured and planned again on the way: a preset (closed-loop, measured-scope,
            measured-tip, open-loop) or a TOML file; if not given, measured-tip for plans that are made for
            success, and open-loop for others.
    """

    errors: ErrorsText = None
    known: Annotated[tuple[str, ...], Parameter(consume_multiple=1)] = ()
    procedure: str | None = None

    def load(self) -> lazy.ErrorModel:
        """Return the error model, the default one if none is given."""
        model = lazy.load_errors() if self.errors is None else lazy.load_errors(self.errors)
        for stated in self.known:
            kind, _equals, size = stated.partition("=")
            try:
                known = float(size)
            except ValueError:
                raise SettingsError(
                    f"--known is {stated!r}",
                    expected="a kind of error and its size, such as scope_direction=0.5",
                ) from None
            model = lazy.with_known(model, kind.replace("-", "_"), known)
        return model

    def given(self) -> lazy.ErrorModel | None:
        """Return the error model, None if none is given: then a plan's own chance of success is shown."""
        return None if self.errors is None and not self.known else self.load()

    def given_procedure(self) -> lazy.Procedure | None:
        """Return the procedure, None if none is given."""
        return None if self.procedure is None else lazy.load_procedure(self.procedure)


@Parameter(name="*")
@frozen_value
class BudgetOptions:
    """How long to search.

    Args:
        budget: Planning time in seconds; 10 if neither this nor --iterations is given.
        iterations: Number of iterations instead of a time: the same seed then gives the same plan.
        seed: Seed of the random numbers.
    """

    budget: Seconds | None = None
    iterations: Count | None = None
    seed: Seed = 0

    @property
    def time_s(self) -> float | None:
        """Planning time; None for as long as the iterations take."""
        return DEFAULT_BUDGET_S if self.budget is None and self.iterations is None else self.budget


@Parameter(name="*")
@frozen_value
class SearchOptions(BudgetOptions):
    """What a plan is to be good at, how to search for it, and how long.

    Args:
        goal: What to make good. success: the chance that the procedure succeeds; window: the share of the
            breath in which it is proved; or a cost of the needle to make small. inverse-clearance: nearness
            to obstacles, 1/clearance along it; cost-map, voxel-sum: the patient's cost map along it; length;
            tissue: nearness of tubes and needle, times their width; a weighted sum such as
            length=1,cost-map=0.5; default is the first, and the second too where there is a map; or a goal
            that a package adds.
        passes: So many times at most the tool goes into the nodule; planned together.
        least_clearance: Every axis in tissue keeps at least so many mm from every obstacle, if not more.
        fissure_chance: The band in which a fissure may lie is no obstacle, and the chance of crossing the
            fissure is at most this, such as 0.2.
        method: Search for plans. atlas: over all that scope and tubes can do; kuntz2015: Algorithm 1 of Kuntz
            et al. 2015; reference: the same as printed, with collisions of surface meshes, slow; each of the
            two also -without-rejection; or one that a package adds.
        needle_planner: Planner of the needle's paths, instead of the method's own (atlas: ao-rrt, kuntz2015:
            rrt); those that begin with control are OMPL's.
        processes: How many processes share the work; not on Windows. For success they simulate, the plan is
            the same, and all cores are used if not given; a cost is made small in one if not given.
        cpu_budget: Stop after so many seconds of processor time.
        gap: Stop once the cost is proved to be at most this share above the least from any scope tip of the
            atlas, such as 0.05; the plan states what is proved.
    """

    goal: Annotated[GoalText, Parameter(name=("--goal", "--objective"))] = SUCCESS.name
    passes: Count = 1
    phases: PhasesText = None
    least_clearance: NotNegative = 0.0
    fissure_chance: Probability | None = None
    method: str = ATLAS
    needle_planner: PlannerName | None = None
    processes: Processes | None = None
    cpu_budget: Seconds | None = None
    gap: NotNegative | None = None

    @property
    def cost(self) -> str:
        """The cost that is meant where a goal is none: the default one."""
        return self.goal if goal_of(self.goal).objective is not None else DEFAULT

    def asked(
        self,
        systems: tuple[lazy.System, ...],
        errors: lazy.ErrorModel | None = None,
        procedure: lazy.Procedure | None = None,
        place: StatedPlace | None = None,
    ) -> Asked:
        """Return all of a request but patient and target; SettingsError if anything in it is wrong."""
        if self.method not in lazy.planners():
            raise lazy.unknown_method(self.method)
        processes = self.processes or (lazy.usable_cores() if goal_of(self.goal) is SUCCESS else 1)
        return Asked(
            systems=systems,
            fields={
                "goal": self.goal, "passes": self.passes, "phases": stated_phases(self.phases),
                "least_clearance_mm": self.least_clearance, "method": self.method,
                "max_fissure_chance": self.fissure_chance,
                "needle_planner": self.needle_planner or "", "processes": processes, "gap": self.gap,
                "seed": self.seed, "iterations": self.iterations, "time_s": self.time_s,
                "cpu_s": self.cpu_budget, "errors": errors, "procedure": procedure, "place": place,
            },
        )  # fmt: skip


@frozen_value
class Asked:
    """All of a request but patient and target, by the names of `Request.of`."""

    systems: tuple[lazy.System, ...]
    fields: dict[str, Any]

    def request(self, lung: lazy.Lung, target: lazy.Target) -> Request:
        """Return the request for a target in a lung; errors as `Request`."""
        require_map(lung, self.fields["goal"])
        return Request.of(lung, self.systems, target, **self.fields)


def stated_phases(text: str | None) -> tuple[float, float] | None:
    """Return first and last phase of a text such as 0.0:0.3; None without one; else SettingsError."""
    if text is None:
        return None
    first, _colon, last = text.partition(":")
    try:
        stated = float(first), float(last)
    except ValueError as error:
        raise SettingsError(
            f"--phases is {text!r}",
            expected="two phases from 0 (end-exhale) to 1 (end-inhale) with a colon between them",
            remedy="Write --phases 0.0:0.3 for the first 30 % of the breath",
        ) from error
    return require_phases(*stated)


def require_picture(path: Path) -> None:
    """Raise SettingsError or FileError unless a picture can be written to a path, before any work is done."""
    if path.suffix.lower() != ".png":
        raise SettingsError(
            f"--out is {path}",
            expected="a file name that ends in .png",
            remedy="Choose a name such as picture.png",
        )
    require_writable_folder(path.parent)


def require_map(lung: lazy.Lung, objective: str) -> None:
    """Raise SettingsError if a stated objective weighs a cost map that the patient does not have."""
    weighed = goal_of(objective).objective
    if objective != DEFAULT and weighed is not None and weighed.weighs_map and lung.cost is None:
        raise SettingsError(
            f"Patient {lung.name} has no cost map",
            expected=f"a cost map among the patient's files for --objective {objective}",
            remedy="Choose inverse-clearance or length",
        )


def open_atlas(lung: lazy.Lung, system: lazy.System) -> lazy.Atlas:
    """Return the deployment atlas of a system in a lung, and show what is being done meanwhile."""
    with progress("enumerating what scope and tubes can do") as shown:
        return lazy.open_atlas(lung, system, progress=shown.share)


def load_lung(patient: Path, thick_slices: bool, accept: tuple[str, ...] | None = ()) -> lazy.Lung:
    """Return a patient's lung, and show what is being done meanwhile; None as `accept` refuses no masks.

    Raises:
        AnatomyError: If the masks fail a check that `accept` does not name.
        SettingsError: If the masks were made from thick slices, unless `thick_slices` accepts them.
    """
    from lungaccess.problem.patients import load_patient

    if not thick_slices:
        lazy.require_thin_slices(patient)
    with progress(f"reading {patient}") as shown:
        return load_patient(
            patient, progress=lambda step: shown.step(step, STEP_SHARES.get(step)), accept=accept
        )

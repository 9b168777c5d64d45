"""What a planner hands in, as JSON: poses and arcs of every query that it solved; and what our methods do.

`docs/reference/submission.md` describes the file with an example; `submission_schema` is its JSON Schema.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, TypeAdapter

from anatomy.base.errors import FileError, SettingsError
from anatomy.base.files import read_json, write_text
from anatomy.base.settings import impossible, parse, quantity, settings, switch, text, to_mapping
from anatomy.base.typed import Float
from lungaccess.judging.checking.completion import Motions
from lungaccess.plans.parts import DeployedShape, NeedleArc
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import load_system
from lungaccess.running.benchmark.synthetic import cases
from lungaccess.running.study.one_run import FIRST_CPU, SEARCH_CPU
from lungaccess.running.study.results import ResultsFile
from lungaccess.running.study.settings import AtlasGrid, Budget, Case, PlannerChoice, Study
from stages.tube import ConcentricTubes, TubeShape, deployed, design_arrays, shape_of_arrays, without_limits

SCHEMA = "lungaccess-submission/1"
MOST_STATES, MOST_ARCS = 10_000, 1000
REMEDY = "docs/reference/submission.md shows a whole file; `... synthetic-v1 schema` prints its schema"

Number = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Row = tuple[Number, Number, Number, Number]
Pose = Annotated[tuple[Row, Row, Row, Row], Field(description="4x4 rigid pose, LPS mm, +z forward")]
State = tuple[Number, Number, Number]


@settings
class ScopeAnswer:
    """How the bronchoscope gets to where it stands: by a published tip, or by a motion of the planner's own.

    Args:
        query: Name of the query, "PHANTOM/DEVICE/NN".
        tip: Number of a tip in `tips-DEVICE.json` of the phantom, from 0.
        lps_from_entry (4x4 or None): Base of the bending section at the beginning, in the trachea.
        states (list of [mm, rad, rad] or None): Advance, twist and bend; the scope never draws back, and
            turns only where it does not advance.
        lps_from_tip (4x4 or None): Pose of the working channel's end; needed without `tip`, and compared if
            stated with it.
    """

    tip: Annotated[int | None, Field(strict=True, ge=0, description="published tip")] = None
    lps_from_entry: Pose | None = None
    states: Annotated[tuple[State, ...] | None, Field(min_length=1, max_length=MOST_STATES)] = None
    lps_from_tip: Pose | None = None

    def __post_init__(self) -> None:
        own = [self.lps_from_entry, self.states, self.lps_from_tip]
        if self.tip is None and any(each is None for each in own):
            raise impossible(
                "tip", self.tip, "a number, or lps_from_entry, states and lps_from_tip instead of it"
            )
        if self.tip is not None and (self.states is not None or self.lps_from_entry is not None):
            raise impossible("tip", self.tip, "left out where lps_from_entry and states are stated")


@settings
class TubesAnswer:
    """How the tubes are turned and inserted, and the pose of their tip, from which the needle starts."""

    rotation_rad: Number
    outer_insertion_mm: Annotated[float, quantity("outer tube beyond the scope tip", at_least=0.0)]
    inner_insertion_mm: Annotated[float, quantity("inner tube beyond the scope tip", at_least=0.0)]
    lps_from_tip: Pose


@settings
class ArcAnswer:
    """One arc of the needle: turn by `roll_rad` about the axis, insert `length_mm`, bending to local +x."""

    length_mm: Annotated[float, quantity("length", above=0.0)]
    roll_rad: Number
    curvature_per_mm: Annotated[float, quantity("curvature", at_least=0.0)]


@settings
class NeedleAnswer:
    """The arcs of the needle, from the tip of the tubes to the target."""

    arcs: Annotated[tuple[ArcAnswer, ...], Field(min_length=1, max_length=MOST_ARCS)]


@settings
class SubmittedAnswer:
    """The answer to one query.

    Args:
        scope, tubes, needle: All three, or none where no plan was found.
        unreachable: Whether the planner claims that there is none; only without a plan.
        first_cpu_s, cpu_s: Processor time of the first plan, and of the whole query.
    """

    query: Annotated[str, text("name of the query")]
    scope: ScopeAnswer | None = None
    tubes: TubesAnswer | None = None
    needle: NeedleAnswer | None = None
    unreachable: Annotated[bool, switch("whether there is no plan at all")] = False
    first_cpu_s: Annotated[float | None, quantity("processor time of the first plan", at_least=0.0)] = None
    cpu_s: Annotated[float | None, quantity("processor time of the query", at_least=0.0)] = None

    def __post_init__(self) -> None:
        parts = [self.scope, self.tubes, self.needle]
        if any(each is None for each in parts) and any(each is not None for each in parts):
            raise impossible("scope, tubes, needle", "some of them", "all three, or none of them")
        if self.planned and self.unreachable:
            raise impossible("unreachable", True, "false where there is a plan")

    @property
    def planned(self) -> bool:
        """Whether the answer is a plan."""
        return self.needle is not None


@settings
class Submission:
    """The answers of one planner; a query without an answer counts as not solved."""

    schema: Annotated[str, text("format of the file")] = SCHEMA
    benchmark: Annotated[str, text("name of the benchmark")] = cases.VERSION
    planner: Annotated[str, text("name of the planner in tables")]
    machine: Annotated[str, text("processor that the times are of", may_be_empty=True)] = ""
    answers: tuple[SubmittedAnswer, ...] = ()

    def __post_init__(self) -> None:
        if self.schema != SCHEMA:
            raise impossible("schema", self.schema, SCHEMA)
        if self.benchmark != cases.VERSION:
            raise impossible("benchmark", self.benchmark, cases.VERSION)


def read_submission(path: Path) -> Submission:
    """Read a submission; every answer is looked at before any is scored.

    Raises:
        FileError: If the file cannot be read or is not JSON.
        SettingsError: If something in it is missing, unknown, of the wrong type or not finite, or a query is
            unknown or answered twice; the message names the answer.
    """
    return submission_of(read_json(path, expected="a submission in JSON", remedy=REMEDY), path.name)


def submission_of(content: object, where: str = "submission") -> Submission:
    """Return the submission that plain values describe; errors as of `read_submission`."""
    if not isinstance(content, Mapping) or not isinstance(content.get("answers"), list):
        raise SettingsError(f"{where} is no submission", expected='{"answers": [...], ...}', remedy=REMEDY)
    answers = tuple(
        parse(SubmittedAnswer, _mapping(each, f"{where}, answer {n}"), f"{where}, answer {n}", REMEDY)
        for n, each in enumerate(content["answers"], start=1)
    )
    known, seen = cases.all_queries(), set[str]()
    for n, each in enumerate(answers, start=1):
        if each.query not in known:
            raise SettingsError(
                f"{where}, answer {n}: there is no query {each.query!r}",
                expected="PHANTOM/DEVICE/NN, such as adult-01/thin-scope/01",
                remedy="The names are in the files case.json",
            )
        if each.query in seen:
            raise SettingsError(
                f"{where}, answer {n}: {each.query} is answered twice", expected="one answer", remedy=REMEDY
            )
        seen.add(each.query)
    head = {key: value for key, value in content.items() if key != "answers"}
    return parse(Submission, {**head, "answers": [to_mapping(each) for each in answers]}, where, REMEDY)


def _mapping(value: object, where: str) -> Mapping[str, object]:
    if not isinstance(value, Mapping):
        raise SettingsError(f"{where} is {value!r:.60}", expected="a JSON object", remedy=REMEDY)
    return value


def submission_schema() -> dict[str, Any]:
    """Return the JSON Schema of a submission."""
    return TypeAdapter(Submission).json_schema()


def write_submission(submission: Submission, path: Path) -> None:
    """Write a submission, all or nothing; FileError if the file cannot be written."""
    write_text(path, json.dumps(to_mapping(submission), allow_nan=False) + "\n")


def require_queries(answers: Iterable[SubmittedAnswer], phantoms: Iterable[str], folder: Path) -> None:
    """Raise FileError unless a folder holds the phantoms of all answers."""
    held = set(phantoms)
    for answer in answers:
        phantom = answer.query.split("/")[0]
        if phantom not in held:
            raise FileError(
                f"{folder} does not hold {phantom}, which {answer.query} is about",
                expected="the phantoms of all answers",
                remedy=f"lungaccess benchmark {cases.VERSION} make --out {folder} --phantoms {phantom}",
            )


def answer_of_plan(
    query: cases.BenchmarkQuery, plan: Plan, *, first_cpu_s: float, cpu_s: float
) -> SubmittedAnswer:
    """Return the answer that a plan of our own makes: its motions, nothing of what it states beside them."""
    needle = plan.needle
    if needle is None:
        raise SettingsError(f"The plan for {query.name} has no needle", expected=f"a plan of {query.system}")
    return SubmittedAnswer(
        query=query.name,
        scope=ScopeAnswer(
            lps_from_entry=_pose(plan.scope.lps_from_entry),
            states=tuple((float(a), float(t), float(b)) for a, t, b in plan.scope.states),
            lps_from_tip=_pose(plan.scope.lps_from_scope_tip),
        ),
        tubes=TubesAnswer(
            rotation_rad=plan.tube.rotation_rad,
            outer_insertion_mm=plan.tube.outer_insertion_mm,
            inner_insertion_mm=plan.tube.inner_insertion_mm,
            lps_from_tip=_pose(plan.tube.lps_from_tip),
        ),
        needle=NeedleAnswer(arcs=tuple(ArcAnswer(**vars(arc)) for arc in needle.arcs)),
        first_cpu_s=first_cpu_s,
        cpu_s=cpu_s,
    )


def _pose(matrix: Float) -> Any:
    return tuple(tuple(float(x) for x in row) for row in matrix)


def motions_of_answer(
    query: cases.BenchmarkQuery, answer: SubmittedAnswer, tips: cases.PublishedTips
) -> Motions:
    """Return what the devices of an answer do.

    Raises:
        FileError: If the answer names a published tip and the file of tips cannot be read.
        SettingsError: If there is no tip of that number, or the answer is no plan.
    """
    scope, tubes, needle = answer.scope, answer.tubes, answer.needle
    if scope is None or tubes is None or needle is None:
        raise SettingsError(f"The answer to {query.name} is no plan", expected="scope, tubes, needle")
    devices = load_system(query.system).tubes
    shape = _shape(devices, tubes.outer_insertion_mm, tubes.inner_insertion_mm)
    entry, states, tip = scope.lps_from_entry, scope.states, scope.lps_from_tip
    if scope.tip is not None:
        published = tips.tip(query.phantom, query.system, scope.tip)
        entry, states = published["lps_from_entry"], published["states"]
        tip = published["lps_from_tip"] if tip is None else tip
    return Motions(
        lps_from_entry=np.array(entry, dtype=np.float64),
        states=np.array(states, dtype=np.float64).reshape(-1, 3),
        lps_from_scope_tip=np.array(tip, dtype=np.float64),
        rotation_rad=tubes.rotation_rad,
        outer_insertion_mm=tubes.outer_insertion_mm,
        inner_insertion_mm=tubes.inner_insertion_mm,
        shape=DeployedShape.of(devices, shape),
        lateral_sweep_mm=shape.lateral_sweep_mm,
        follow_the_leader_error_mm=shape.follow_the_leader_error_mm,
        lps_from_tube_tip=np.array(tubes.lps_from_tip, dtype=np.float64),
        arcs=tuple(NeedleArc(**vars(arc)) for arc in needle.arcs),
    )


def _shape(tubes: ConcentricTubes, outer_mm: float, inner_mm: float) -> TubeShape:
    """Return the shape that the mechanics give; where tubes cannot go, a straight one, which is refused."""
    n = len(tubes.nested)
    inserted, turned = np.array([inner_mm, outer_mm][:n]), np.zeros(n)
    made = deployed(without_limits(design_arrays(tubes)), inserted, turned)
    if made is not None:
        return shape_of_arrays(made)
    return TubeShape(
        insertions_mm=inserted,
        rotations_rad=turned,
        arcs=np.array([[max(inner_mm, 0.0), 0.0, 0.0, tubes.outermost.radius_mm]]),
        lateral_sweep_mm=0.0,
        follow_the_leader_error_mm=0.0,
        arc_error_mm=0.0,
        least_determinant=1.0,
    )


ITERATIONS = 100
"""Beyond the direct arcs: about a tenth of a second."""
JOINT = "+"
"""Between a method and the planner of the needle that it is to use."""
_QUERY = """
SELECT p.case_name, p.x_lps_mm, p.y_lps_mm, p.z_lps_mm, c.name, r.cpu_time, l.plan
FROM runs r JOIN outcomes o ON o.runid = r.id JOIN plannerConfigs c ON c.id = r.plannerid
     JOIN problems p ON p.experimentid = r.experimentid LEFT JOIN plans l ON l.runid = r.id
WHERE NOT o.failed ORDER BY r.id"""


def method_choice(words: str, iterations: int | None) -> PlannerChoice:
    """Return the planner that METHOD or METHOD+NEEDLE_PLANNER names; SettingsError if there is none."""
    method, _joint, needle = words.partition(JOINT)
    return PlannerChoice(
        name=words, method=method, needle_planner=needle, iterations=iterations, without_counterfactuals=True
    )


def benchmark_study(
    folder: Path,
    methods: Sequence[str] = ("atlas",),
    *,
    phantoms: Iterable[str] = (),
    systems: Sequence[str] = cases.SYSTEMS,
    targets: int | None = None,
    iterations: int | None = ITERATIONS,
    time_s: float | None = None,
) -> Study:
    """Return the study that runs methods, METHOD or METHOD+NEEDLE_PLANNER, on a folder of cases.

    Args:
        targets: The first so many of each lung of a phantom; all if None.
        iterations, time_s (optional): Budget of a query; iterations can be repeated exactly.

    Raises:
        FileError: If the folder is not one of this benchmark.
        SettingsError: If it does not hold a phantom, or there is no such device or method.
    """
    held = cases.require_cases(folder)
    chosen = tuple(cases.phantom_named(name) for name in phantoms) or held
    for case in chosen:
        if case not in held:
            raise SettingsError(
                f"{folder} does not hold {case.name}",
                expected=", ".join(each.name for each in held),
                remedy=f"lungaccess benchmark {cases.VERSION} make --out {folder} --phantoms {case.name}",
            )
    for system in systems:
        if system not in cases.SYSTEMS:
            raise SettingsError(
                f"{cases.VERSION} has no device {system!r}", expected=", ".join(cases.SYSTEMS)
            )
    return Study(
        name=cases.VERSION,
        case=tuple(_case(folder, case, system, targets) for case in chosen for system in systems),
        planner=tuple(method_choice(words, iterations) for words in methods),
        budget=Budget(iterations=iterations, time_s=time_s),
        atlas=AtlasGrid(),
        folder=str(folder.resolve()),
    )


def _case(folder: Path, case: cases.BenchmarkPhantom, system: str, targets: int | None) -> Case:
    points = cases.entries()[case.name].targets_lps
    # In turns, so that runs of the first targets remain those of a study of more.
    pairs = tuple(zip(points[: cases.TARGETS_A_LUNG], points[cases.TARGETS_A_LUNG :], strict=True))[:targets]
    chosen = [point for pair in pairs for point in pair]
    return Case(
        name=f"{case.name}/{system}",
        anatomy=case.name,
        system=system,
        objective="inverse-clearance",
        targets=tuple("lps:" + ",".join(repr(x) for x in point) for point in chosen),
    )


def submissions_of(path: Path) -> list[Submission]:
    """Return the submissions that the results of a study of the benchmark make, one of each method.

    Times are processor time of the search; where it found nothing, of the whole run.  Of several runs
    of a query, such as with more iterations, the last counts.

    Raises:
        FileError: If the results cannot be read.
        SettingsError: If they are not of this benchmark.
    """
    queries = {
        (f"{each.phantom}/{each.system}", each.target_lps): each for each in cases.all_queries().values()
    }
    answers: dict[str, dict[str, SubmittedAnswer]] = {}
    with ResultsFile(path) as results:
        for case, x, y, z, planner, cpu_s, text in results.rows(_QUERY):
            query = queries.get((case, (x, y, z)))
            if query is None:
                raise SettingsError(
                    f"{path} has a run of {case} to lps:{x},{y},{z}",
                    expected=f"runs of {cases.VERSION} alone",
                    remedy=f"Make them with: lungaccess benchmark {cases.VERSION} run",
                )
            answer = SubmittedAnswer(query=query.name, cpu_s=cpu_s)
            if text:
                plan = Plan.from_json(text)
                first_s, all_s = (float(plan.timing.get(key, 0.0)) for key in (FIRST_CPU, SEARCH_CPU))
                answer = answer_of_plan(query, plan, first_cpu_s=first_s, cpu_s=all_s)
            answers.setdefault(planner, {})[query.name] = answer
    return [
        Submission(planner=planner, answers=tuple(own[name] for name in sorted(own)))
        for planner, own in sorted(answers.items())
    ]

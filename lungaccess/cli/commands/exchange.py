"""The commands `lungaccess export`, `stream` and `template`: files and links for other programs."""

from __future__ import annotations

import contextlib
from dataclasses import asdict
from importlib import import_module, resources
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from anatomy.base.errors import SettingsError
from anatomy.base.files import write_text
from lungaccess.cli import lazy, terminal
from lungaccess.cli.commands.see import shown_ct
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.numbers import Hertz, Port, Seconds
from lungaccess.cli.options import ErrorOptions, PatientOfPlan, PatientOptions, PlanFile
from lungaccess.cli.plan_search import show_headline
from lungaccess.cli.progress import progress
from lungaccess.cli.result_folder import Force, claim_folder, require_new_file


def export(
    plan: PlanFile,
    patient: PatientOfPlan,
    *,
    slicer: Path | None = None,
    trajectory: Path | None = None,
    models: Path | None = None,
    dicom: Path | None = None,
    ct: Path | None = None,
    anonymise: bool = False,
    force: Force = False,
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Write a stored plan for other programs and systems; exit code 1 if the check refuses it.

    A refused plan is named so for 3D Slicer, and is not written otherwise.

    Args:
        slicer: Folder for the scene, curves, models and segmentation; drag its scene.mrml into 3D Slicer.
        trajectory: Folder for the motion in time: joint values as CSV, and messages of ROS 2 as YAML.
        models: Folder for surfaces of anatomy and devices, as STL and as one glTF, and for the camera of a
            film.
        dicom: Folder for segments, structured report and overview as DICOM, beside the CT's series.
        ct: Folder of the CT's DICOM series for --dicom; the one that was segmented if not given.
        anonymise: Leave name, identity, dates and physicians out of what --dicom writes.
    """
    if all(folder is None for folder in (slicer, trajectory, models, dicom)):
        raise SettingsError(
            "None of --slicer, --trajectory, --models and --dicom is given",
            expected="a folder for 3D Slicer, for the motion in time, for models, or for DICOM",
            remedy="Add --slicer DIR",
        )

    for folder in (slicer, trajectory, models, dicom):
        if folder is not None:
            claim_folder(folder, ("*",), force=force)
    stored, lung = masks.load_plan(plan, patient)
    written: dict[Path, tuple[str, ...]] = {}
    with progress("checking the plan") as shown:
        appraisal = lazy.appraise(stored, lung)
        if slicer is not None:
            written[slicer] = lazy.export_slicer(stored, lung, slicer, progress=shown.step).files
        if trajectory is not None and appraisal.accepted:
            written[trajectory] = lazy.write_trajectory(lazy.plan_trajectory(stored), trajectory)
        if models is not None and appraisal.accepted:
            shown.step("writing models")
            written[models] = lazy.export_models(stored, lung, models)
        if dicom is not None and appraisal.accepted:
            shown.step("writing DICOM")
            written[dicom] = lazy.export_dicom(
                stored, lung, dicom, shown_ct(ct, patient), appraisal, anonymise=anonymise
            )
    folders = [{"folder": str(folder), "files": list(files)} for folder, files in written.items()]
    answer = {**(folders[0] if folders else {}), "accepted": appraisal.accepted}
    terminal.tell(answer | ({"others": folders[1:]} if folders[1:] else {}))
    for folder, files in written.items():
        terminal.say(f"Written to {folder}: {', '.join(files)}")
    show_headline(appraisal.headline)
    return ExitCode.of(appraisal.accepted)


def stream(
    plan: PlanFile,
    patient: PatientOfPlan,
    *,
    host: str = "127.0.0.1",
    port: Port = 18944,
    connect: Annotated[bool, Parameter(negative="")] = False,
    rate: Hertz = 20.0,
    loop: Annotated[bool, Parameter(negative="")] = False,
    seconds: Seconds | None = None,
    errors: ErrorOptions = ErrorOptions(),
    masks: PatientOptions = PatientOptions(),
) -> ExitCode:
    """Send poses, paths and phases of a plan by OpenIGTLink, and plan again from tracked poses.

    With --procedure the policy of the procedure decides about tracked poses, else the cheapest way is taken.
    A plan that the check refuses is not sent: exit code 1.

    Args:
        host: Address to listen at, or of the server; this machine alone if not given.
        port: Its port; 0 for a free one to listen at, which is printed.
        connect: Connect to a server there, such as PLUS, and do not listen.
        rate: Rounds a second, in each of which all poses are sent, Hz.
        loop: Begin the motion again when it has ended.
        seconds: End after so long; until Ctrl-C if not given.
    """
    stored = lazy.Plan.load(plan)
    with lazy.Link(host, port, connects=connect) as link:
        lung = masks.load(patient)
        stored.require_lung(lung)
        report = lazy.check(stored, lung)
        if not report.accepted:
            terminal.tell({"accepted": False, **report.to_mapping()})
            show_headline(lazy.Headline.of(report, None))
            return ExitCode.NEGATIVE
        followed = errors.given_procedure()
        session = lazy.LiveSession(
            stored, lung, link, rate_hz=rate, loop=loop, on_answer=_say,
            policy=None if followed is None else lazy.Policy(stored, lung, errors.load(), followed),
        )  # fmt: skip
        done = "Connecting to" if connect else "Listening at"
        terminal.say(f"{done} {host}:{link.port}. Ctrl-C ends.")
        with contextlib.suppress(KeyboardInterrupt):
            session.run(seconds)
        counts = session.counts
    terminal.tell(asdict(counts))
    link_counts = counts.link
    rows = [
        ("rounds", f"{counts.ticks}, of which {counts.overrun} took too long"),
        ("planned again", f"{counts.replans} times, {counts.found} with a way"),
        (
            "processor time of one",
            f"median {counts.replan_median_ms:.1f} ms, most {counts.replan_most_ms:.1f} ms",
        ),
        ("poses passed over for newer ones", f"{counts.superseded}"),
        (
            "messages",
            f"{link_counts.sent} sent, {link_counts.received} received, {counts.unknown} of no known name",
        ),
        ("connections", f"{link_counts.joined} joined, {link_counts.left} left"),
        *((f"dropped: {reason}", f"{count}") for reason, count in link_counts.dropped.items()),
    ]
    terminal.show([terminal.table("What was streamed", ("", ""), rows)])
    return ExitCode.OK


def _say(answer: lazy.Answer) -> None:
    terminal.say(f"{answer.name}: {answer.words} ({1e3 * answer.processor_s:.1f} ms)")


Kind = Literal[
    "patient", "errors", "procedure", "study", "design", "tubes", "lesions", "pose", "contours", "device",
    "plan",
]  # fmt: skip
FILES = {
    "patient": "patient.toml", "errors": "errors.toml", "procedure": "procedure.toml", "study": "study.toml",
    "design": "design.toml", "tubes": "tubes.toml", "lesions": "lesions.txt", "pose": "pose.txt",
    "contours": "contours.json",
}  # fmt: skip
"""The file of each kind among the templates."""
SCHEMAS = {
    "patient": "anatomy.io.own_masks:PatientFile", "errors": "lungaccess.problem.errors:ErrorModel",
    "procedure": "lungaccess.problem.procedures:Procedure",
    "study": "lungaccess.running.study.settings:Study", "design": "lungaccess.running.study.settings:Study",
    "tubes": "lungaccess.planning.one_stage.tubes:BareTubes", "device": "lungaccess.problem.system:System",
    "plan": "lungaccess.plans.plan:Plan",
}  # fmt: skip
"""The class that reads the files of a kind: its fields are their keys, besides those of `FURTHER`."""
TEXT = {"type": "string"}
FURTHER: dict[str, dict[str, Any]] = {
    "errors": {"like": TEXT},
    "plan": {"digest": TEXT},
    "design": {
        "design": {"type": "object", "required": ["vary"], "properties": {"vary": {"type": "object"}}}
    },
}
"""Keys that files have besides: the preset of errors that the others change, the digest of a plan, and the
table that makes a study a search over devices."""


def template(
    kind: Annotated[
        Kind,
        Parameter(
            help="patient: a folder of own masks; errors: sizes of errors for `risk`; procedure: what is "
            "measured on the way, for `risk`; study: many plans; design: a search over devices; tubes: two "
            "tubes alone; lesions: points for `tour`; pose: a start for `needle`; contours: an outlined "
            "nodule for `segment`; device and plan: their schemas alone."
        ),
    ],
    /,
    *,
    out: Path | None = None,
    schema: bool = False,
    force: Force = False,
) -> ExitCode:
    """Print an example of a file that a command reads, every key explained; edit it and hand it over.

    Devices have templates of their own: `lungaccess presets --show NAME`.

    Args:
        out: File to write; it is printed if not given.
        schema: The JSON Schema of such files, for editors and other programs, not an example.
    """
    text = schema_text(kind) if schema else template_text(kind)
    if out is None:
        terminal.console.file.write(text)
        return ExitCode.OK
    require_new_file(out, force=force)
    write_text(out, text)
    terminal.say(f"Written to {out}")
    return ExitCode.OK


def template_text(kind: Kind) -> str:
    """Return the example of a file; SettingsError if files of the kind are not written by hand."""
    if kind not in FILES:
        raise SettingsError(
            f"There is no example of a {kind}",
            expected=f"one of {', '.join(FILES)}",
            remedy="`lungaccess presets --show NAME` prints a device, `lungaccess plan` writes a plan",
        )
    return (resources.files("lungaccess") / "cli" / "templates" / FILES[kind]).read_text(encoding="utf-8")


def schema_text(kind: Kind) -> str:
    """Return the JSON Schema of the files of a kind; SettingsError if its files have no keys."""
    if kind not in SCHEMAS:
        raise SettingsError(f"Files of the kind {kind} have no keys", expected=f"one of {', '.join(SCHEMAS)}")
    module, name = SCHEMAS[kind].split(":")
    schema = lazy.schema_of(getattr(import_module(module), name))
    schema["properties"] |= FURTHER.get(kind, {})
    schema["properties"].pop("folder", None)  # A study is told where its file lies.
    if kind == "design":
        schema["required"].remove("planner")  # The atlas plans where none is named.
    return terminal.json_text(schema)

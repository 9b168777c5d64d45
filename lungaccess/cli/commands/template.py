"""The command `lungaccess template`: an example, or the JSON Schema, of each file that a user writes."""

from importlib import import_module, resources
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from anatomy.base.errors import SettingsError
from anatomy.base.files import write_text
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.result_folder import Force, require_new_file

Kind = Literal[
    "patient", "errors", "procedure", "study", "design", "tubes", "lesions", "pose", "contours", "device",
    "plan",
]  # fmt: skip
FILES = {
    "patient": "patient.toml",
    "errors": "errors.toml",
    "procedure": "procedure.toml",
    "study": "study.toml",
    "design": "design.toml",
    "tubes": "tubes.toml",
    "lesions": "lesions.txt",
    "pose": "pose.txt",
    "contours": "contours.json",
}
"""The file of each kind among the templates."""
SCHEMAS = {
    "patient": "anatomy.io.own_masks:PatientFile",
    "errors": "lungaccess.problem.errors:ErrorModel",
    "procedure": "lungaccess.problem.procedures:Procedure",
    "study": "lungaccess.running.study.settings:Study",
    "design": "lungaccess.running.study.settings:Study",
    "tubes": "lungaccess.planning.one_stage.tubes:BareTubes",
    "device": "lungaccess.problem.system:System",
    "plan": "lungaccess.plans.plan:Plan",
}
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
    """Return the example of a file.

    Raises:
        SettingsError: If files of the kind are not written by hand.
    """
    if kind not in FILES:
        raise SettingsError(
            f"There is no example of a {kind}",
            expected=f"one of {', '.join(FILES)}",
            remedy="`lungaccess presets --show NAME` prints a device, `lungaccess plan` writes a plan",
        )
    return (resources.files("lungaccess") / "cli" / "templates" / FILES[kind]).read_text(encoding="utf-8")


def schema_text(kind: Kind) -> str:
    """Return the JSON Schema of the files of a kind.

    Raises:
        SettingsError: If its files have no keys.
    """
    from lungaccess.plans.schema import schema_of

    if kind not in SCHEMAS:
        raise SettingsError(f"Files of the kind {kind} have no keys", expected=f"one of {', '.join(SCHEMAS)}")
    module, name = SCHEMAS[kind].split(":")
    schema = schema_of(getattr(import_module(module), name))
    schema["properties"] |= FURTHER.get(kind, {})
    schema["properties"].pop("folder", None)  # A study is told where its file lies.
    if kind == "design":
        schema["required"].remove("planner")  # The atlas plans where none is named.
    return terminal.json_text(schema)

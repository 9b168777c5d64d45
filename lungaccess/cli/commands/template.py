"""The command `lungaccess template`: an example of each file that a user writes."""

from importlib import resources
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from anatomy.base.files import write_text
from lungaccess.cli import terminal
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.result_folder import Force, require_new_file

Kind = Literal["patient", "errors", "procedure", "study", "design", "tubes", "lesions", "pose", "contours"]
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


def template(
    kind: Annotated[
        Kind,
        Parameter(
            help="patient: a folder of own masks; errors: sizes of errors for `risk`; procedure: what is "
            "measured on the way, for `risk`; study: many plans; design: a search over devices; tubes: two "
            "tubes alone; lesions: points for `tour`; pose: a start for `needle`; contours: an outlined "
            "nodule for `segment`."
        ),
    ],
    /,
    *,
    out: Annotated[Path | None, Parameter(help="File to write; it is printed if not given.")] = None,
    force: Force = False,
) -> ExitCode:
    """Print an example of a file that a command reads, every key explained; edit it and hand it over.

    Devices have templates of their own: `lungaccess presets --show NAME`.
    """
    text = template_text(kind)
    if out is None:
        terminal.console.file.write(text)
        return ExitCode.OK
    require_new_file(out, force=force)
    write_text(out, text)
    terminal.say(f"Written to {out}")
    return ExitCode.OK


def template_text(kind: Kind) -> str:
    """Return the example of a file."""
    return (resources.files("lungaccess") / "cli" / "templates" / FILES[kind]).read_text(encoding="utf-8")

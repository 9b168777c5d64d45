"""The command line: plans, what is known about them, and each stage alone.

Exit codes: 0, a plan was found and the independent check accepts it; 1, there is no plan or the check
refuses it; 2, the input is bad.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Annotated, Literal

from cyclopts import App, CycloptsError, Parameter

from anatomy.errors import AnatomyError, LungaccessError
from lungaccess.cli import terminal
from lungaccess.cli.commands.advise import advise
from lungaccess.cli.commands.alternatives import alternatives
from lungaccess.cli.commands.certify import certify
from lungaccess.cli.commands.check import check
from lungaccess.cli.commands.demo import demo
from lungaccess.cli.commands.doctor import doctor
from lungaccess.cli.commands.export import export
from lungaccess.cli.commands.info import info, presets
from lungaccess.cli.commands.needle import needle
from lungaccess.cli.commands.plan import plan
from lungaccess.cli.commands.reach import reach
from lungaccess.cli.commands.report import report
from lungaccess.cli.commands.risk import risk
from lungaccess.cli.commands.route import route
from lungaccess.cli.commands.segment import segment
from lungaccess.cli.commands.study import study
from lungaccess.cli.commands.tour import tour
from lungaccess.cli.commands.tubes import tubes
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.terminal import error_console

_TOO_LARGE = AnatomyError(
    "There is not enough memory for this patient",
    expected="about 6 GiB free for 512 x 512 x 600 voxels",
    remedy="Close other programs, or resample the masks to 1 mm voxels",
)


def _version() -> str:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("lungaccess")
    except PackageNotFoundError:
        return "unknown (not installed)"


app = App(
    name="lungaccess",
    help="Plan access to a lung nodule with three stages: bronchoscope, concentric tubes, steerable needle.",
    help_epilogue="Exit codes: 0 a plan that the check accepts, 1 no plan or a refused one, 2 bad input.",
    version=_version,
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)


def completion(shell: Literal["bash", "zsh", "fish"], /) -> ExitCode:
    """Print a script that lets a shell complete commands, options and choices.

    Parameters
    ----------
    shell : str
        bash, zsh or fish; docs/reference/command_line.md says where the script goes.
    """
    terminal.console.file.write(app.generate_completion(prog_name="lungaccess", shell=shell))
    return ExitCode.OK


for _command in (
    plan, needle, certify, check, info, presets, demo, advise, alternatives, route, tour, tubes, risk, reach,
    segment, study, report, export, doctor, completion,
):  # fmt: skip
    app.command(_command)


# Cyclopts would end the process by itself.
app.meta.suppress_keyboard_interrupt = False


@app.meta.default
def _run(
    *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int | None:
    """Run a command.

    Parameters
    ----------
    quiet : bool
        Print neither results nor progress, only errors and what --json asks for.
    """
    terminal.set_quiet(quiet)
    code: int | None = app(words, exit_on_error=False, error_console=error_console)
    return code


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; no user error ever shows a traceback.

    Parameters
    ----------
    arguments : sequence of str, optional
        The words after the name of the program; those of this process if None.
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code = app.meta(_with_nodule_number(words), exit_on_error=False, error_console=error_console)
    except CycloptsError:
        return ExitCode.BAD_INPUT
    except LungaccessError as error:
        return _explain(error)
    except MemoryError:
        terminal.show_error(_TOO_LARGE)
        return ExitCode.BAD_INPUT
    except KeyboardInterrupt:
        error_console.print("interrupted")
        return ExitCode.INTERRUPTED
    return int(code or ExitCode.OK)


def _explain(error: LungaccessError) -> ExitCode:
    """Print an error for people and return the exit code that belongs to it."""
    from lungaccess.plans.no_plan import NoPlan

    if isinstance(error, NoPlan):
        terminal.show_no_plan(error)
        return ExitCode.NEGATIVE
    terminal.show_error(error)
    return ExitCode.BAD_INPUT


def _with_nodule_number(words: list[str]) -> list[str]:
    """Let `--nodule` stand alone for `--nodule 1`."""
    completed: list[str] = []
    for word, following in zip(words, [*words[1:], ""], strict=True):
        completed.append(word)
        if word == "--nodule" and not following.lstrip("+-").isdigit():
            completed.append("1")
    return completed


__all__ = ["app", "main"]

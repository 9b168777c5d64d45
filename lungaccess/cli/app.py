"""The command line: plans, what is known about them, and each stage alone.

Exit codes: 0, a plan was found and the independent check accepts it; 1, there is no plan or the check
refuses it; 2, the input is bad; 70, the program crashed, which is no answer.
"""

import contextlib
import os
import platform
import re
import signal
import sys
import tempfile
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, Argument, CycloptsError, Group, Parameter, exceptions

from anatomy.base.cache import cache_in
from anatomy.base.checksums import DamagedCacheWarning
from anatomy.base.errors import AnatomyError, FileError, LungaccessError
from anatomy.machine_code.ahead import first_compilation
from anatomy.machine_code.folders import KernelsNotKeptWarning
from lungaccess.cli import result_folder, terminal
from lungaccess.cli.commands.benchmark import benchmark, schema
from lungaccess.cli.commands.check import check, insert, window
from lungaccess.cli.commands.devices import design, presets, shapes, tubes
from lungaccess.cli.commands.exchange import export, stream, template
from lungaccess.cli.commands.installation import cache, doctor, selftest
from lungaccess.cli.commands.later_stages import needle, replan
from lungaccess.cli.commands.patients import info, phantom, segment
from lungaccess.cli.commands.plan import alternatives, demo, plan
from lungaccess.cli.commands.reachability import certify, reach
from lungaccess.cli.commands.risk import risk, start_region
from lungaccess.cli.commands.scope_alone import advise, route, tour
from lungaccess.cli.commands.see import report, steps, view
from lungaccess.cli.commands.study import study
from lungaccess.cli.examples import EXAMPLE_OF_ALL, EXAMPLES, EXIT_CODES, START_PAGE, epilogue
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.plan_search import no_plan_record
from lungaccess.cli.terminal import error_console
from lungaccess.plans.no_plan import NoPlan
from lungaccess.plans.version import software_version

_TOO_LARGE = AnatomyError(
    "There is not enough memory for this patient",
    expected="about 6 GiB free for 512 x 512 x 600 voxels",
    remedy="Close other programs, or resample the masks to 1 mm voxels",
)


app = App(
    name="lungaccess",
    help="Plan access to a lung nodule with three stages: bronchoscope, concentric tubes, steerable needle.",
    help_epilogue=f"{EXAMPLE_OF_ALL}\n\n{EXIT_CODES}",
    version=software_version,
    console=terminal.help_console,
    result_action="return_value",
    suppress_keyboard_interrupt=False,
)


def completion(shell: Literal["bash", "zsh", "fish"], /) -> ExitCode:
    """Print a script that lets a shell complete commands, options and choices.

    Args:
        shell: bash, zsh or fish; docs/reference/command_line.md says where the script goes.
    """
    terminal.console.file.write(app.generate_completion(prog_name="lungaccess", shell=shell))
    return ExitCode.OK


GROUPS: dict[str, tuple[Callable[..., ExitCode] | App, ...]] = {
    "Plan": (demo, plan, alternatives, replan, certify, needle, route, tour, advise),
    "Understand a plan": (report, view, steps, check, risk, window, start_region, insert, reach),
    "Anatomy": (segment, info, phantom),
    "Devices": (presets, tubes, shapes, design),
    "Studies": (study, benchmark),
    "Files and links": (export, stream, template),
    "This installation": (doctor, selftest, cache, completion),
}
"""All commands by what they are for, in the order of `lungaccess --help`."""

for _number, (_title, _commands) in enumerate(GROUPS.items()):
    _group = Group(_title, sort_key=_number)
    for _command in _commands:
        if isinstance(_command, App):
            _command.group = (_group,)
            app.command(_command)
        else:
            app.command(_command, group=_group, help_epilogue=epilogue(_command.__name__.replace("_", "-")))


WITHOUT_JSON = (completion, schema, template)
"""Commands that print a script or a file, which no option turns into something else."""

# Cyclopts would end the process by itself.
app.meta.suppress_keyboard_interrupt = False


@app.meta.default
def _run(
    *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    json: bool = False,
    cache: Path | None = None,
    quiet: Annotated[bool, Parameter(name=["--quiet", "-q"], negative="")] = False,
) -> int | None:
    """Run a command.

    Args:
        json: Print the answer as JSON instead of text and tables; not for what prints a file or a script.
        cache: Folder where prepared anatomies are kept for the next command.
        quiet: Print neither results nor progress, only errors and what --json asks for.
    """
    terminal.set_answers(as_json=json, quiet=quiet)
    command = app.parse_commands(words)[1][-1].default_command
    if json and (command is None or command in WITHOUT_JSON):
        words = (*words, "--json")  # It is refused as an option that is unknown there.
    with cache_in(cache):
        code: int | None = app(words, exit_on_error=False, print_error=False)
    return code


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command, of this process if no words are given, and return its exit code, never a traceback."""
    words = [_with_home(word) for word in (sys.argv[1:] if arguments is None else arguments)]
    terminal.prepare_surroundings()
    try:
        with warnings.catch_warnings(), _termination_as_interruption():
            warnings.showwarning = _show_damage(warnings.showwarning)
            code = _answer(words)
        sys.stdout.flush()
    except BrokenPipeError:
        terminal.give_up_output()
        return ExitCode.PIPE_CLOSED
    except OSError as error:
        terminal.give_up_output()
        return _explain(_unusable(error))
    return code


@contextlib.contextmanager
def _termination_as_interruption() -> Iterator[None]:
    """Let SIGTERM do what Ctrl-C does, so that what is half made goes and no process stays."""
    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    ):
        yield
        return
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _show_damage(others: Callable[..., None]) -> Callable[..., None]:
    """Return what shows warnings: one line for what caches lack, or hold damaged; the rest as ever."""

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, DamagedCacheWarning | KernelsNotKeptWarning):
            error_console.print(str(message), soft_wrap=True)
        elif "\nTraceback" in str(message):
            # Numba tells so of a variable of the environment that it cannot read.
            error_console.print(str(message).split("\n")[0], soft_wrap=True)
        else:
            others(message, category, *where, **more)

    return show


def _answer(words: list[str]) -> int:
    """Run one command, turn what a user can cause and mend into an exit code."""
    if not words:
        terminal.console.file.write(START_PAGE)
        return ExitCode.OK
    # Until the words are understood, and where they make no sense.
    terminal.set_answers(as_json=_asks_json(words))
    command = _command_of(words)
    first_compilation.command = command.partition(" ")[0]
    try:
        result_folder.protect_files(words)
        code = app.meta(with_nodule_number(words), exit_on_error=False, print_error=False)
    except CycloptsError as error:
        return _explain(_usage_error(error, command))
    except LungaccessError as error:
        error.expected = error.expected or "input that this command can use"
        error.remedy = error.remedy or _see_help(command)
        return _explain(error)
    except BrokenPipeError:
        raise
    except MemoryError:
        return _explain(_TOO_LARGE)
    except OSError as error:
        return _explain(_unusable(error))
    except (KeyboardInterrupt, Exception) as error:
        # Compiled libraries turn an interruption of their loading into an ImportError.
        if isinstance(error, KeyboardInterrupt) or isinstance(error.__cause__, KeyboardInterrupt):
            error_console.print("interrupted")
            return ExitCode.INTERRUPTED
        return _crashed(error, words)
    finally:
        result_folder.held.close()
    return int(code or ExitCode.OK)


def _command_of(words: Sequence[str]) -> str:
    """Return the name of the command in a command line, before which options may stand; "" without one."""
    first = 0
    while words[first : first + 1] and words[first].startswith("-"):
        first += 2 if words[first] == "--cache" else 1
    return " ".join(app.parse_commands(words[first:])[0])


def _crashed(error: Exception, words: list[str]) -> ExitCode:
    crash = _write_report(error, words, software_version())
    terminal.show_error(crash, title="crash")
    terminal.tell({"error": crash.to_mapping()})
    return ExitCode.CRASHED


def _explain(error: LungaccessError) -> ExitCode:
    """Print an error for people, also as JSON if that is asked for, and return its exit code."""
    if isinstance(error, NoPlan):
        terminal.tell(no_plan_record(error))
        terminal.show_no_plan(error)
        return ExitCode.NEGATIVE
    terminal.show_error(error)
    terminal.tell({"error": error.to_mapping()})
    return ExitCode.BAD_INPUT


def _unusable(error: OSError) -> FileError:
    """Return the error for a file or folder that the system refuses."""
    return FileError(
        f"{error.filename or 'A file'} cannot be used: {error.strerror or error}",
        expected="files and folders that can be read and written, and room on the disk",
        remedy="Check the name, the permissions and the free space",
    )


class CrashError(LungaccessError):
    """The program itself is at fault, whatever the input was."""


def _write_report(error: Exception, words: Sequence[str], version: str) -> CrashError:
    """Write what is known of a crash into a file of its own, and return the error that names the file."""
    system = f"Python {platform.python_version()} on {platform.platform()}"
    lines = [f"lungaccess {version}, {system}", f"command: {list(words)!r}", ""]
    lines += traceback.format_exception(error)
    try:
        file, name = tempfile.mkstemp(prefix="lungaccess-crash-", suffix=".txt")
        with open(file, "w", encoding="utf-8", errors="backslashreplace") as stream:
            stream.write("\n".join(lines))
    except OSError:
        name = f"{os.devnull}: there is no room for it"
    return CrashError(
        f"The program crashed ({type(error).__name__}: {str(error)[:200]}); that is no answer",
        expected="an answer, or an error that says what is wrong with the input",
        remedy=f"Send the report {name} to the developers; the command line and names of files in it may "
        "name a patient, so read it first",
    )


_GUESS = re.compile(r"\s*(Did you mean [^?]*\?)")
_NOUNS = {int: "a whole number", float: "a number", bool: "true or false"}


class UsageError(LungaccessError):
    """A command or an option is unknown, missing, or has a value that it cannot have."""


def _usage_error(error: CycloptsError, command: str) -> UsageError:
    """Return what is wrong with the words of a command, and which words would be right."""
    error.verbose = False
    found, expected = _found_and_expected(error)
    found = re.sub(r"\s*Available commands: .*", "", found, flags=re.DOTALL)
    guess = _GUESS.search(found)
    explained = _see_help(command)
    remedy = f"{guess.group(1)} {explained}" if guess else explained
    return UsageError(
        _one_line(_GUESS.sub("", found)), expected=_one_line(expected), remedy=_one_line(remedy)
    )


def _see_help(command: str) -> str:
    """Return the sentence that leads to the help of a command, or of all of them."""
    if command in EXAMPLES:
        return f"`lungaccess {command} --help` explains every option; an example: {EXAMPLES[command]}"
    return f"`{' '.join(('lungaccess', *command.split()))} --help` lists the commands"


def _found_and_expected(error: CycloptsError) -> tuple[str, str]:
    """Return what the user wrote, and what could stand there."""
    argument, written = error.argument, str(error)
    if isinstance(error, exceptions.ValidationError) and argument is not None:
        words = " ".join(token.value for token in argument.tokens)
        return f"{_name(argument)} is {words}", error.exception_message
    if isinstance(error, exceptions.MissingArgumentError) and argument is not None:
        name, what = (error.keyword, "has no value") if error.keyword else (_name(argument), "is missing")
        return f"{name} {what}", argument.parameter.help or f"a value for {_name(argument)}"
    if isinstance(error, exceptions.CoercionError) and error.token is not None:
        name = error.token.keyword or ("A value" if argument is None else _name(argument))
        guess = _GUESS.search(written)
        return f"{name} is {error.token.value!r}. {guess.group(1) if guess else ''}", _kind(error)
    if isinstance(error, exceptions.UnknownCommandError):
        return written, "a command of lungaccess"
    if isinstance(error, exceptions.UnknownOptionError):
        return written, "an option of this command"
    if isinstance(error, exceptions.UnusedCliTokensError):
        return f"Words too many: {' '.join(error.unused_tokens or ())}", "no more words than the example has"
    return written, "the words that this command takes"


def _kind(error: exceptions.CoercionError) -> str:
    """Return what a value has to be."""
    choices = re.search(r"Choose from:? (.*?)\.?( Did you mean|$)", str(error), re.DOTALL)
    if choices:
        return f"one of {choices.group(1)}"
    return _NOUNS.get(error.target_type or str, "a value of another kind")


def _name(argument: Argument) -> str:
    """Return the name of an option as the user wrote it, of a folder or file in capitals."""
    written = [token.keyword for token in argument.tokens if token.keyword]
    if written:
        return str(written[0])
    return argument.name if argument.field_info.is_keyword_only else argument.name.lstrip("-").upper()


def _one_line(text: str) -> str:
    return " ".join(text.split())


def _with_home(word: str) -> str:
    """Return a word such as --out=~/plan with the user's folder, which not every shell puts in there."""
    name, mark, value = word.partition("=")
    return f"{name}={os.path.expanduser(value)}" if mark and name.startswith("--") else word


def _asks_json(words: Sequence[str]) -> bool:
    """Return whether the words of a command line ask for JSON, also where they make no sense otherwise."""
    asked = False
    for word in words:
        if word == "--":
            break
        if word in ("--json", "--json=true", "--no-json"):
            asked = word != "--no-json"
    return asked


def with_nodule_number(words: Sequence[str]) -> list[str]:
    """Let `--nodule` stand alone for `--nodule 0`, the largest; a point may follow it, as in `segment`."""
    completed: list[str] = []
    for word, following in zip(words, [*words[1:], ""], strict=False):
        completed.append(word)
        if word == "--nodule" and not (following.lstrip("+-").isdigit() or ":" in following):
            completed.append("0")
    return completed

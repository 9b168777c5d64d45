"""How the command line shows things: tables, JSON, and short panels for errors."""

from __future__ import annotations

import codecs
import io
import json
import math
import os
import re
import sys
from collections.abc import Iterable, Mapping
from typing import Any, NoReturn

from rich.console import Console
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from lungaccess.cli import lazy

_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\u200b-\u200f\u2028-\u202e\u2060-\u2069\ufeff]")
"""A terminal obeys or hides these instead of showing them; the new line and the tab are not among them."""


class _Console(Console):
    """A console on which no text of others is markup or commands; a closed pipe is for others to mind.

    Attributes:
        as_json: Whether commands tell their answers as JSON, without any text for people.
    """

    as_json = False

    def __init__(self, **settings: Any) -> None:
        super().__init__(markup=False, emoji=False, **settings)

    def render_str(self, text: str, **settings: Any) -> Text:
        """Return a text, of a file name, say, as it is shown."""
        return super().render_str(safe(text), **settings)

    def on_broken_pipe(self) -> NoReturn:
        """Raise BrokenPipeError."""
        raise BrokenPipeError


console = _Console()
error_console = _Console(stderr=True)
progress_console = _Console(stderr=True)
help_console = _Console()

Row = tuple[str, ...]


PLAIN = {
    "\N{DEGREE SIGN}": " deg", "\N{EN DASH}": "-", "\N{GREATER-THAN OR EQUAL TO}": ">=",
    "\N{CHECK MARK}": "+", "\N{LESS-THAN OR EQUAL TO}": "<=", "\N{BALLOT X}": "x",
    "\N{HORIZONTAL ELLIPSIS}": "...",
}  # fmt: skip
"""How our own characters are written where the encoding of the output has none for them."""


def _plain(error: UnicodeError) -> tuple[str | bytes, int]:
    """Write one character of `PLAIN` as there, others as escapes."""
    if isinstance(error, UnicodeEncodeError) and error.object[error.start] in PLAIN:
        return PLAIN[error.object[error.start]], error.start + 1
    return codecs.backslashreplace_errors(error)


codecs.register_error("lungaccess-plain", _plain)


def prepare_surroundings() -> None:
    """Let closed streams lead nowhere, and others write what their encoding lacks in other words.

    A file that is opened next would else get the number of a closed stream, and what others print.  Pictures
    are files, so that the user's choice of windows for matplotlib concerns none, and may stop its import; so
    may a number of threads for numba, of which no kernel takes more than one.
    """
    for concerns_nothing in ("MPLBACKEND", "NUMBA_NUM_THREADS"):
        os.environ.pop(concerns_nothing, None)
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    sys.stdin = sys.stdin or open(os.devnull, encoding="utf-8")  # noqa: SIM115 -- stays open
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        # Such as code page 1252 of Windows, which files get when output is redirected.
        if isinstance(stream, io.TextIOWrapper) and not stream.encoding.lower().startswith("utf"):
            stream.reconfigure(errors="lungaccess-plain")


def set_answers(*, as_json: bool = False, quiet: bool = False) -> None:
    """Let commands answer as JSON or in text, or be quiet: then errors and JSON still come."""
    console.as_json, console.quiet, progress_console.quiet = as_json, as_json or quiet, quiet


def give_up_output() -> None:
    """Send what is still to be printed nowhere: what read standard output has ended."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def tell(record: object) -> None:
    """Print plain values if JSON is asked for; see `set_answers`."""
    if console.as_json:
        show_json(record)


def show_json(value: object) -> None:
    """Print plain values as JSON on standard output, also for quiet commands; see `json_text`."""
    console.file.write(json_text(value))


def json_text(value: object) -> str:
    """Return plain values as JSON; null for what is not finite."""
    return json.dumps(_finite(value), indent=2, allow_nan=False) + "\n"


def _finite(value: object) -> object:
    """Replace numbers that JSON does not know."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {key: _finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(inner) for inner in value]
    return value


def say(text: str) -> None:
    """Print a line of plain text."""
    console.print(text)


def show_warnings(warnings: Iterable[str]) -> None:
    """Print what was odd about an input, if anything was."""
    text = "\n".join(f"- {warning}" for warning in warnings)
    if text:
        console.print(Panel(text, title="warnings", title_align="left", border_style="yellow"))


def table(title: str, headings: Iterable[str], rows: Iterable[Row], caption: str | None = None) -> Table:
    """Return a plain table; its columns after the first are right-aligned where they hold numbers."""
    listed = list(rows)
    made = bare_table(title)
    made.caption, made.caption_justify = caption, "left"
    for number, heading in enumerate(headings):
        numeric = number > 0 and all(_is_number(row[number]) for row in listed if row[number])
        made.add_column(heading, justify="right" if numeric else "left", overflow="fold")
    for row in listed:
        made.add_row(*row)
    return made


def bare_table(title: str) -> Table:
    """Return a table without columns."""
    return Table(title=title, title_justify="left", title_style="bold", header_style="bold", box=None)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def safe(text: str) -> str:
    """Return text whose odd bytes, and what would command a terminal, are spelled out.

    Examples:
        >>> safe("lung\x1b[2J.nii")
        'lung\\\\x1b[2J.nii'
    """
    spelled = text.encode("utf-8", "backslashreplace").decode("utf-8")
    return _CONTROLS.sub(lambda found: ascii(found[0])[1:-1], spelled)


def styled(*parts: tuple[str, str]) -> Text:
    """Return one text of pieces with their styles."""
    return Text.assemble(*((safe(text), style) for text, style in parts))


def show(tables: Iterable[Table]) -> None:
    """Print tables with a blank line after each."""
    for made in tables:
        console.print(made)
        console.print()


def show_wide(tables: Iterable[Table]) -> None:
    """Print tables of many columns as wide as they are: a terminal breaks their lines, a pager scrolls."""
    width = console.width
    for made in tables:
        # Characters that the widest table may take on a line.
        natural = console.measure(made, options=console.options.update(max_width=400)).maximum
        try:
            console.width = max(natural, width)
            console.print(made)
        finally:
            console.width = width
        console.print()


def show_error(error: lazy.LungaccessError, title: str = "bad input") -> None:
    """Print what was found, what was expected and what to do, in a short panel on standard error."""
    parts = [(error.found.rstrip(".") + ".", "")]
    if error.expected:
        parts += [("\nexpected", "dim"), (f"  {error.expected}", "")]
    if error.remedy:
        parts += [("\nremedy", "dim"), (f"    {error.remedy}", "")]
    error_console.print(Panel(styled(*parts), title=title, title_align="left", border_style="red"))


def show_no_plan(failure: lazy.NoPlan) -> None:
    """Print why no plan was found: the counted reasons, and what would help."""
    console.print(Panel(failure.found, title="no plan", title_align="left", border_style="yellow"))
    show_reasons(failure)
    if failure.advice:
        console.print(styled(("\nWhat would help:", "bold"), (f" {failure.advice}", "")))


def show_reasons(failure: lazy.NoPlan) -> None:
    """Print the counted reasons, and why each of several systems failed."""
    if failure.attempts:
        console.print(table("Systems that were tried", ("system", "outcome"), failure.attempts.items()))
    rows = [(reason, f"{count}") for reason, count in failure.reasons.items() if count]
    if rows:
        console.print(
            table("What was looked at, and what was ruled out", ("stage and reason", "count"), rows)
        )

"""Text of others, a patient's name, say, neither styles nor commands the terminal."""

from __future__ import annotations

import io

import pytest
from rich.panel import Panel

from anatomy.base.errors import FileError
from lungaccess.cli import terminal

HOSTILE = (
    "[/]", "[bold]", "\\[", "a\\", "[link=http://x]a[/link]", "\x1b[2J", "\x9b2J", "\x07", "a\rb",
    "\u202egnp", ":warning:", "\udcff",
)  # fmt: skip


def _printed(monkeypatch: pytest.MonkeyPatch, what: object) -> str:
    console = terminal._Console(file=io.StringIO(), width=120, force_terminal=False)
    monkeypatch.setattr(terminal, "console", console)
    monkeypatch.setattr(terminal, "error_console", console)
    what() if callable(what) else console.print(what)
    return console.file.getvalue()


@pytest.mark.parametrize("text", HOSTILE)
@pytest.mark.parametrize("where", ["line", "title", "heading", "cell", "panel", "error", "warning"])
def test_foreign_text_is_shown_as_it_is(monkeypatch: pytest.MonkeyPatch, where: str, text: str):
    shown = {
        "line": lambda: terminal.say(text),
        "title": terminal.table(text, ("a" * 30,), [("b",)]),
        "heading": terminal.table("a", (text,), [("b",)]),
        "cell": terminal.table("a", ("b",), [(text,)]),
        "panel": Panel(text),
        "error": lambda: terminal.show_error(FileError(text, expected=text, remedy=text)),
        "warning": lambda: terminal.show_warnings([text]),
    }[where]
    printed = _printed(monkeypatch, shown)
    assert terminal.safe(text) in printed
    assert not set(printed) & {"\x1b", "\x9b", "\x07", "\r", "\u202e"}


def test_what_commands_a_terminal_is_spelled_out():
    assert terminal.safe("a\x1b[2J\x9b\udcff\n\tb") == "a\\x1b[2J\\x9b\\udcff\n\tb"

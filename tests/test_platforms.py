"""What has to hold so that every platform can run the packages, seen from their sources and imitated."""

from __future__ import annotations

import ast
import errno
import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from anatomy.base import files
from anatomy.base.errors import FileError

ROOT = Path(__file__).resolve().parents[1]
SOURCES = [path for package in ("anatomy", "stages", "lungaccess") for path in (ROOT / package).rglob("*.py")]
UNIX_ALONE = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
RESERVED = {"con", "prn", "aux", "nul", *(f"{port}{n}" for port in ("com", "lpt") for n in range(1, 10))}
COMMANDS = (
    ["--help"], [], ["presets"], ["doctor"], ["plan", "--help"], ["template", "errors"], ["plan", "nowhere"],
    ["plan", "n\N{LATIN SMALL LETTER E WITH ACUTE}\N{SNOWMAN}"], ["tubes", "--outer", "10", "--inner", "40"],
    ["presets", "--show", "lung-default"], ["risk", "nowhere", "nowhere", "--json"], ["nonsense"],
)  # fmt: skip


def imported(node: ast.stmt) -> set[str]:
    """Return the first parts of the names that a statement imports."""
    if isinstance(node, ast.Import):
        return {each.name.partition(".")[0] for each in node.names}
    return {(node.module or "").partition(".")[0]} if isinstance(node, ast.ImportFrom) else set()


def test_no_module_imports_what_unix_alone_has() -> None:
    for path in SOURCES:
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            assert not imported(node) & UNIX_ALONE, (path, node.lineno)


def opens_text(call: ast.Call) -> bool:
    """Say whether a call reads or writes text by Python's own functions."""
    called = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
    if called in ("read_text", "write_text"):
        # Our own functions of these names take a path first, and state UTF-8 themselves.
        return isinstance(call.func, ast.Attribute)
    modes = [each.value for each in (*call.args, *(word.value for word in call.keywords))
             if isinstance(each, ast.Constant) and isinstance(each.value, str)]  # fmt: skip
    owner = getattr(getattr(call.func, "value", None), "id", "")
    foreign = owner in ("os", "Image", "webbrowser", "zipfile", "tarfile", "files")
    return called == "open" and not foreign and not any("b" in mode for mode in modes)


def test_text_is_read_and_written_with_a_stated_encoding() -> None:
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and opens_text(node):
                assert "encoding" in {word.arg for word in node.keywords}, (path, node.lineno)


def test_names_of_files_are_names_on_every_system() -> None:
    names = [path.relative_to(ROOT).as_posix() for path in (ROOT / "lungaccess").parent.glob("[a-z]*/**/*.*")]
    ours = [name for name in names if name.split("/")[0] in ("anatomy", "stages", "lungaccess")]
    assert max(Counter(name.lower() for name in ours).values()) == 1
    for name in ours:
        for part in name.split("/"):
            assert part.split(".")[0].lower() not in RESERVED and not part.endswith((".", " ")), name
            assert not set(part) & set('<>:"\\|?*'), name


@pytest.mark.parametrize(
    ("encoding", "shown"), [("cp1252", "+ x 3\N{DEGREE SIGN} \\u2603"), ("ascii", "+ x 3 deg \\u2603")]
)
def test_no_command_fails_by_the_encoding_of_its_output(encoding: str, shown: str, tmp_path: Path) -> None:
    code = (
        "import sys; from lungaccess.cli.app import main\n"
        f"for words in {[list(words) for words in COMMANDS]!a}: print('==', main(words))\n"
        "print('\\u2713 \\u2717 3\\u00b0 \\u2603')"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"}
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True)
    lines = done.stdout.decode(encoding).splitlines()
    assert done.returncode == 0 and sum(line.startswith("== ") for line in lines) == len(COMMANDS), (
        done.stderr
    )
    assert lines[-1] == shown


def test_the_command_runs_as_a_module() -> None:
    words = [sys.executable, "-m", "lungaccess", "presets", "--json"]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, encoding="utf-8")
    assert done.returncode == 0 and "lung-default" in done.stdout
    assert subprocess.run([*words[:3], "nonsense"], cwd=ROOT, capture_output=True).returncode == 2


def test_a_file_that_is_open_elsewhere_is_waited_for_and_then_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on Windows, where nobody can replace a file that another program has open."""
    path, calls, replace = tmp_path / "plan.json", [], os.replace
    path.write_text("old", encoding="utf-8")

    def refusing(source: Path, target: Path) -> None:
        calls.append(source)
        if len(calls) <= refusals:
            raise PermissionError(errno.EACCES, "Access is denied")
        replace(source, target)

    monkeypatch.setattr(files, "REPLACE_TRIES", 3)
    monkeypatch.setattr(files.time, "sleep", lambda _s: None)
    monkeypatch.setattr(files.os, "replace", refusing)
    refusals = 3
    with pytest.raises(FileError, match="Close what has it open"):
        files.write_text(path, "new")
    assert path.read_text(encoding="utf-8") == "old" and [*tmp_path.iterdir()] == [path]
    calls.clear()
    refusals = 2
    files.write_text(path, "new")
    assert path.read_text(encoding="utf-8") == "new" and [*tmp_path.iterdir()] == [path]


def test_temporary_names_are_short(tmp_path: Path) -> None:
    path = tmp_path / ("a" * 240 + ".nii.gz")
    with files.atomic_write(path) as temporary:
        assert len(temporary.name) <= 24 and temporary.name.endswith(".nii.gz")
        temporary.touch()
    assert [*tmp_path.iterdir()] == [path]

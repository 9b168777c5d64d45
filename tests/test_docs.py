"""Every code block of every page: it is of a known kind, its files are readable, and its commands exist."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import pytest

import lungaccess as la
from anatomy.base.facade import public_names
from anatomy.base.settings import parse
from anatomy.io.own_masks import PatientFile
from anatomy.segmentation.learned import NetworkSettings
from lungaccess.cli.app import app, with_nodule_number
from lungaccess.cli.examples import EXAMPLES
from lungaccess.planning.one_stage import load_tubes
from lungaccess.problem.error_files import load_errors
from lungaccess.problem.system import load_system
from lungaccess.running.design.settings import read_design
from lungaccess.running.study.settings import read_study
from tests.pages import PAGES, ROOT, RUN, SHOWN, blocks, name_of

LEAST_RUN_SHARE = 0.9
"""Blocks that are marked as not run are exceptions."""
READERS = {
    "errors.toml": load_errors,
    "my-device.toml": load_system,
    "my-design.toml": read_design,
    "network.toml": lambda path: parse(NetworkSettings, tomllib.loads(path.read_text()), path.name),
    "study.toml": read_study,
    "success.toml": read_study,
    "tubes.toml": load_tubes,
}
SHELL = {
    "cd": lambda words: True,
    "export": lambda words: True,
    ".": lambda words: words == [".", ".venv/bin/activate"],
    "dask": lambda words: words[1] in ("scheduler", "worker"),
    "make": lambda words: f"\n{words[1]}:" in (ROOT / "Makefile").read_text(),
    "pip": lambda words: _is_an_extra(words),
    "python": lambda words: _is_a_file(words),
}
"""Commands that are not ours, and how a reader's mistake with them would show."""

pages = pytest.mark.parametrize("page", PAGES, ids=name_of)


def _is_an_extra(words: list[str]) -> bool:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    return words[1] == "install" and all(
        extra in extras for each in words[2:] for extra in re.findall(r"\[(\w+)\]", each)
    )


def _is_a_file(words: list[str]) -> bool:
    file = words[2].replace(".", "/") + ".py" if words[1] == "-m" else words[1]
    return (ROOT / file).is_file()


@pages
def test_every_block_is_of_a_known_kind(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    assert text.count("\n```") % 2 == 0 and not re.search(r"^[ \t]+```", text, re.MULTILINE)
    for block in blocks(page):
        assert block.kind in RUN + SHOWN, block.text


def test_blocks_that_are_not_run_are_few() -> None:
    found = [block for page in PAGES for block in blocks(page) if block.kind in RUN]
    assert sum(block.not_run is None for block in found) >= LEAST_RUN_SHARE * len(found)


@pages
def test_every_command_exists(page: Path) -> None:
    """Also in blocks that are not run; names in capitals stand for what the reader knows."""
    for block in blocks(page):
        for words in block.commands if block.kind == "console" else ():
            if words[0] == "lungaccess":
                asked = with_nodule_number(words[1:])
                run, bound, _ = app.meta.parse_args(asked, print_error=False, exit_on_error=False)
                if run is app.meta.default_command:
                    app.parse_args(bound.args, print_error=False, exit_on_error=False)
                else:
                    assert asked == ["--version"]
            else:
                assert SHELL[words[0]](words), words


@pages
def test_every_file_is_readable(page: Path, tmp_path: Path) -> None:
    """A `toml` block is what its reader accepts, which is the reader of the commands."""
    for block in blocks(page):
        if block.kind == "json":
            json.loads(block.text)
        if block.kind != "toml":
            continue
        name = block.text.split(maxsplit=2)[1]
        (tmp_path / name).write_text(block.text, encoding="utf-8")
        if name == "patient.toml":
            parse(PatientFile, tomllib.loads(block.text), name)
        else:
            READERS[name](tmp_path / name)


@pages
def test_python_compiles(page: Path) -> None:
    for block in blocks(page):
        if block.kind == "python":
            compile(block.text, str(page), "exec")


def test_the_page_of_the_api_has_every_name() -> None:
    """And no other one; signatures are made from the code."""
    text = (ROOT / "docs" / "reference" / "python_api.md").read_text(encoding="utf-8")
    assert set(re.findall(r"`la\.(\w+)", text)) == set(public_names(la.__file__))


def test_the_page_of_the_command_line_has_every_command() -> None:
    page = ROOT / "docs" / "reference" / "command_line.md"
    first = next(block for block in blocks(page) if block.kind == "console")
    listed = [" ".join(words) for words in first.commands]
    names = {name.split()[0] for name in EXAMPLES}
    assert not [name for name in sorted(names) if not any(f"lungaccess {name}" in each for each in listed)]

"""The examples of the gallery run, use public names alone, and are all on the page."""

from __future__ import annotations

import ast
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
SCRIPTS = sorted(path for path in EXAMPLES.glob("*.py") if path.stem != "run_all")
OURS = ("anatomy", "stages", "lungaccess")


def test_the_page_shows_every_script_in_the_order_in_which_they_run() -> None:
    page = (ROOT / "docs" / "tutorials" / "gallery.md").read_text(encoding="utf-8")
    shown = re.findall(r"\{literalinclude\} \.\./\.\./examples/(\w+)\.py", page)
    assert tuple(shown) == runpy.run_path(str(EXAMPLES / "run_all.py"))["NAMES"]
    assert shown == re.findall(r"\(\.\./pictures/(\w+)\.png\)", page)
    assert sorted(shown) == [path.stem for path in SCRIPTS]


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_examples_are_short_and_use_public_names(script: Path) -> None:
    text = script.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 45
    modules = [node.module or "" for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ImportFrom)]
    ours = [module for module in modules if module.split(".")[0] in OURS]
    assert not [module for module in ours if not (ROOT / module.replace(".", "/") / "__init__.py").is_file()]


@pytest.mark.slow
def test_examples_run_and_draw(tmp_path: Path) -> None:
    """They run in a process of their own: they set how many threads it has."""
    command = (sys.executable, str(EXAMPLES / "run_all.py"), "pictures")
    environment = {**os.environ, "MPLBACKEND": "agg", "LUNGACCESS_CACHE": str(tmp_path / "cache")}
    subprocess.run(command, cwd=tmp_path, env=environment, check=True)
    pictures = {path.stem: path.stat().st_size for path in (tmp_path / "pictures").iterdir()}
    assert set(pictures) == {path.stem for path in SCRIPTS}
    assert min(pictures.values()) > 5000

"""The code in README and tutorial runs as it stands, on synthetic patients."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.io.frames import LPS_FROM_RAS
from anatomy.phantom import make_phantom, write_phantom
from lungaccess.cli.app import app
from lungaccess.cli.usage import with_nodule_number

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "docs/tutorials/first_steps.md")
LUNGACCESS = Path(sys.executable).with_name("lungaccess")
BLOCK = re.compile(r"^```(console|python)\n(.*?)^```", re.DOTALL | re.MULTILINE)
ELSEWHERE = ("pip ", "make ", ". .venv", "git ", "cd ", "lungaccess segment ")
"""Commands that other tests run, or that belong to a shell."""
MAY_SAY_NO = ("advise", "certify", "needle", "tubes")
"""Commands that end with 1 where a device does not get there, which depends on the patient."""


STUDY = """
name = "nodules"
budget = {iterations = 1}
case = [{name = "nodule", anatomy = "PATIENT", targets = ["nodule"]}]
planner = [{name = "atlas"}]
"""


def commands(text: str) -> list[list[str]]:
    """Return the commands of a console block, without comments."""
    lines = (line for line in text.splitlines() if line.strip() and not line.startswith(ELSEWHERE))
    return [shlex.split(line, comments=True) for line in lines]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that the pages' commands name."""
    here = tmp_path_factory.mktemp("pages")
    patient = make_phantom(seed=2)
    write_phantom(patient, here / "PATIENT")
    lung = la.load_patient(here / "PATIENT", cache=here / "cache")
    system = la.load_system("lung-default")
    found = next(la.plan(lung, system, la.resolve_target(lung), iterations=0))
    np.savetxt(here / "pose.txt", LPS_FROM_RAS @ found.tube.lps_from_tip)
    (here / "study.toml").write_text(STUDY)
    lesions = [",".join(f"{x:.2f}" for x in nodule.centre_lps) for nodule in patient.nodules[:2]]
    (here / "lesions.txt").write_text("".join(f"lps:{lesion}\n" for lesion in lesions))
    return here


def at_hand(words: list[str], point: str) -> list[str]:
    """Replace what only the reader knows: a point in their patient, and how long they want to wait."""
    words = [point if word.startswith("ras:") else word for word in words]
    return ["2" if before == "--budget" else word for before, word in zip(["", *words], words, strict=False)]


def test_the_pages_have_code() -> None:
    for page in PAGES:
        found = BLOCK.findall((ROOT / page).read_text())
        assert sum(len(commands(text)) for kind, text in found if kind == "console") >= 5
        assert any(kind == "python" for kind, _text in found)


@pytest.mark.parametrize(
    "page", sorted((ROOT / "docs").rglob("*.md")) + [ROOT / "README.md"], ids=lambda p: p.name
)
def test_every_command_has_the_options_of_the_command_line(page: Path) -> None:
    """Commands in a console block of any page, with names in capitals for what the reader knows."""
    for kind, text in BLOCK.findall(page.read_text(encoding="utf-8")):
        for words in commands(text) if kind == "console" else ():
            if words[0] == "lungaccess":
                app.parse_args(with_nodule_number(words[1:]), print_error=False, exit_on_error=False)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_every_block_runs(page: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of the page: a block may use what those before it left."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("LUNGACCESS_CACHE", str(folder / "cache"))
    lung = la.load_patient("PATIENT")
    point = "lps:" + ",".join(f"{x:.2f}" for x in la.resolve_target(lung).lps_mm)
    names: dict[str, object] = {}
    for kind, text in BLOCK.findall((ROOT / page).read_text()):
        if kind == "python":
            exec(compile(text, page, "exec"), names)
            continue
        for words in commands(text):
            assert words[0] == "lungaccess"
            done = subprocess.run(
                [str(LUNGACCESS), *at_hand(words[1:], point)], capture_output=True, text=True, check=False
            )
            answers = {0, 1} if words[1] in MAY_SAY_NO else {0}
            assert done.returncode in answers, f"{words}\n{done.stdout}\n{done.stderr}"

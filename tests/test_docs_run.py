"""Every code block of every page runs, in the order of its page, on a synthetic patient.

Each page has a folder with what its commands name: `PATIENT`, as `lungaccess phantom` writes it, a plan for
it in `plan`, and the files that `lungaccess template` prints, made for this patient.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import lungaccess as la
from anatomy.base.unfinished import MARK
from anatomy.io.frames import LPS_FROM_RAS
from anatomy.io.images import read_volume
from lungaccess.cli import terminal
from lungaccess.cli.app import main
from tests.anatomy.io.series import write_series
from tests.pages import PAGES, ROOT, RUN, Block, blocks, name_of

MAY_SAY_NO = ("advise", "benchmark", "certify", "needle", "plan", "tubes")
"""Commands that end with 1 where a device does not get there, which depends on the patient."""
SERVES = ("view",)
"""Commands that run until they are ended: their own tests start and end them."""
SCRIPTS = ("examples/stranger/stranger.py",)
"""Scripts whose files later commands of a page name; those of the gallery have a test of their own."""
INSTEAD = {"--budget": "2", "--samples": "500", "--spacing": "15", "--iterations": "20", "--count": "3"}
"""How long the reader wants to wait, and how exact the answer has to be: less than on the pages."""
QUICK = ("docs/explanation/replanning.md", "docs/explanation/ompl.md")
"""Pages that need no patient and run within seconds; all others are slow."""
OF_OMPL = ("docs/explanation/planning.md", "docs/explanation/ompl.md")
"""Pages that use OMPL's own planners."""
STUDY = """
name = "nodules"
budget = {iterations = 1}
case = [{name = "nodule", anatomy = "PATIENT", targets = ["nodule"]}]
planner = [{name = "atlas"}]
"""


def write_files(here: Path) -> None:
    """Write the files that need no patient."""
    for kind in ("errors", "tubes"):
        assert main(["template", kind, "--out", str(here / f"{kind}.toml"), "--quiet"]) == 0
    shutil.copy(ROOT / "examples" / "my_device.toml", here / "my-device.toml")
    (here / "study.toml").write_text(STUDY)
    terminal.set_answers()


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with all that the commands of the pages name."""
    here = tmp_path_factory.mktemp("pages")
    write_files(here)
    assert main(["phantom", "--out", str(here / "PATIENT"), "--quiet"]) == 0
    terminal.set_answers()
    lung = la.load_patient(here / "PATIENT", cache=here / "cache")
    atlas = la.open_atlas(lung, la.load_system("lung-default"), cache=here / "cache")
    target = la.resolve_target(lung)
    *_, plan = la.plan(lung, atlas.system, target, atlas=atlas, iterations=5, goal="default")
    (here / "plan" / MARK).mkdir(parents=True)  # A command made it: one that writes there moves it aside.
    plan.save(here / "plan" / "plan.json")
    np.savetxt(here / "pose.txt", LPS_FROM_RAS @ plan.tube.lps_from_tip)
    points = ["lps:" + ",".join(f"{x:.2f}" for x in point) for point in lung.targets_lps]
    (here / "lesions.txt").write_text("\n".join(points[:2]))
    (here / "ct.nii.gz").symlink_to(here / "PATIENT" / "ct.nii.gz")
    (here / "nodule.nii.gz").symlink_to(here / "PATIENT" / "nodules.nii.gz")
    ct, uids = read_volume(here / "ct.nii.gz"), {"StudyInstanceUID": "1.2.3", "FrameOfReferenceUID": "1.2.4"}
    write_series(here / "SERIES", ct, **uids)
    return here


@pytest.fixture
def folder(
    page: Path, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Path:
    """Return a folder of its own for a page, which is the current one."""
    here, cache = tmp_path / "page", tmp_path / "cache"
    if name_of(page) in QUICK:
        here.mkdir()
        write_files(here)
    else:
        source = request.getfixturevalue("prepared")
        left_out = shutil.ignore_patterns("cache", "PATIENT")
        shutil.copytree(source, here, ignore=left_out, symlinks=True)
        (here / "PATIENT").symlink_to(source / "PATIENT")
        cache = source / "cache"
    monkeypatch.setenv("LUNGACCESS_CACHE", str(cache))
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.chdir(here)
    return here


def at_hand(words: list[str]) -> list[str]:
    """Replace what only the reader knows: their CT, and how long they want to wait."""
    words = ["ct.nii.gz" if word == "CT" else word for word in words]
    return [INSTEAD.get(before, word) for before, word in zip(["", *words], words, strict=False)]


def run_command(words: list[str]) -> None:
    """Run a command of ours; those of a shell are looked at in `test_docs`."""
    if words[0] == "python" and words[1] in SCRIPTS:
        subprocess.run([sys.executable, str(ROOT / words[1]), *words[2:]], check=True)
    if words[0] != "lungaccess" or words[1] in SERVES:
        return
    stated = at_hand(words[1:])
    if stated[0] in ("design", "study") or stated[:3:2] == ["benchmark", "run"]:  # they start processes
        code = "import sys; from lungaccess.cli.app import main; sys.exit(main())"
        path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
        done = subprocess.run([sys.executable, "-c", code, *stated], env=os.environ | {"PYTHONPATH": path})
        answer = done.returncode
    else:
        answer = main(stated)
    assert answer in ((0, 1) if stated[0] in MAY_SAY_NO else (0,)), stated


def run_block(block: Block, names: dict[str, object], page: Path) -> None:
    """Run a block after those before it on its page."""
    if block.kind == "python":
        exec(compile(block.text, name_of(page), "exec"), names)
    elif block.kind == "toml":
        Path(block.text.split(maxsplit=2)[1]).write_text(block.text, encoding="utf-8")
    elif block.kind == "sql":
        sqlite3.connect("results.db").execute(block.text).fetchall()
    elif block.kind == "console":
        for words in block.commands:
            run_command(words)


def marks(page: Path) -> list[pytest.MarkDecorator]:
    """Return what the tests of a page are: slow, or of OMPL."""
    name = name_of(page)
    return [pytest.mark.slow] * (name not in QUICK) + [pytest.mark.ompl] * (name in OF_OMPL)


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=name_of(page), marks=marks(page))
        for page in PAGES
        if any(block.kind in RUN and block.not_run is None for block in blocks(page))
    ],
)
def test_every_block_runs(page: Path, folder: Path) -> None:
    names: dict[str, object] = {"__name__": "__main__"}
    for block in blocks(page):
        if block.not_run is None:
            run_block(block, names, page)

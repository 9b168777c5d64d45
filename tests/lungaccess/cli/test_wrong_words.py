"""Wrong command lines, drawn at random: none ends in a traceback, each says what was found and what to do."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from lungaccess.cli import app as cli
from lungaccess.cli import terminal
from lungaccess.cli.examples import EXAMPLES
from lungaccess.cli.exit_code import ExitCode
from lungaccess.plans.plan import Plan
from tests.lungaccess.cli.wrong_words import World, arguments_of, kind_of, ranges_of, wrong_words

IN_CI, IN_ALL = 50, int(os.environ.get("LUNGACCESS_WRONG_INVOCATIONS", "500"))
"""How many wrong command lines are tried."""
PHASES = (Phase.explicit, Phase.generate)
"""The words of a failure are short: making them shorter would only take time."""
BROKEN_TOML = {
    "broken.toml": 'name = "x\n[',
    "unknown_key.toml": 'name = "x"\nsurprise = 1\n',
    "wrong_types.toml": 'name = 3\nscope = "wide"\ntubes = 1\nlumen = 7\n',
    "not_finite.toml": "[scope_position]\nattempt_mm = nan\n[needle]\ndiameter_mm = -inf\n",
    "huge.toml": "[needle]\ndiameter_mm = 1e308\nlength_mm = 1e300\n",
    "tiny.toml": "[needle]\ndiameter_mm = 5e-324\n[[tubes]]\ncurvature_per_m = -0.0\n",
    "truth.toml": "[needle]\ndiameter_mm = true\n[scope_position]\nattempt_mm = false\n",
    "empty.toml": "",
}


def make_world(folder: Path, patient: Path, small_plan: Plan, toy_plan: Plan) -> World:
    """Fill a folder with a patient, a plan and all kinds of bad files."""
    shutil.copytree(patient, folder / "PATIENT")
    shutil.copytree(patient.parent / "cache", folder / "cache")
    for name in ("plan", "bad"):
        (folder / name).mkdir()
    small_plan.save(folder / "plan" / "plan.json")
    toy_plan.save(folder / "bad" / "foreign.json")
    bad = folder / "bad"
    bad.joinpath("text").write_text("no number, no table\n")
    bad.joinpath("empty").touch()
    bad.joinpath("empty.nii.gz").touch()
    noise = np.random.default_rng(0).bytes(4096)
    for name in ("noise", "noise.nii.gz", "noise.json", "noise.db", "noise.txt", "noise.dcm", "noise.vtp"):
        bad.joinpath(name).write_bytes(noise)
    whole = folder.joinpath("PATIENT", "lumen.nii.gz").read_bytes()
    bad.joinpath("truncated.nii.gz").write_bytes(whole[: len(whole) // 2])
    bad.joinpath("half.json").write_text(folder.joinpath("plan", "plan.json").read_text()[:500])
    bad.joinpath("list.json").write_text("[1, 2]")
    for name, text in BROKEN_TOML.items():
        bad.joinpath(name).write_text(text)
    for name, text in (("broken", BROKEN_TOML["broken.toml"]), ("unknown", BROKEN_TOML["unknown_key.toml"])):
        bad.joinpath(name).mkdir()
        bad.joinpath(name, "patient.toml").write_text(text)
    bad.joinpath("folder").mkdir()
    shutil.copy(folder / "PATIENT" / "lumen.nii.gz", bad / "folder")
    odd = ("nowhere", "nowhere.nii.gz", "bad/\N{SNOWMAN} [red]", "a" * 300, "", "/dev/null", "bad/text/below")
    files = tuple(
        str(path.relative_to(folder)) for path in sorted(bad.iterdir()) if path.name != "foreign.json"
    )
    return World(
        folder=folder,
        bad_inputs=(*odd, *files),
        bad_systems=("bad/nowhere.toml", "bad", *(f"bad/{name}" for name in BROKEN_TOML)),
        bad_outputs=("bad/text/below.png", "/proc/nowhere/x.png", "/dev/null/x.png"),
        foreign_plan="bad/foreign.json",
    )


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory, patient: Path, small_plan: Plan, toy_plan: Plan) -> World:
    return make_world(tmp_path_factory.mktemp("wrong"), patient, small_plan, toy_plan)


@pytest.fixture(autouse=True)
def in_the_world(world: World, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(world.folder)
    monkeypatch.setenv("LUNGACCESS_CACHE", str(world.folder / "cache"))
    for console in (terminal.console, terminal.error_console):
        monkeypatch.setattr(console, "_width", 400)
    yield
    terminal.set_answers()


def judge(words: list[str], code: int, out: str, err: str) -> None:
    """Require the documented form of an error."""
    said = f"{words}\n{out}\n{err}"
    assert "Traceback" not in err, said
    assert code == ExitCode.BAD_INPUT, said
    assert "bad input" in err and "expected" in err and "remedy" in err, said
    if "--json" in words:
        error = json.loads(out)["error"]
        assert set(error) == {"kind", "found", "expected", "remedy"}, said
        assert all(isinstance(part, str) and part.strip() for part in error.values()), said
    elif words[0] != "demo":
        assert out == "", said


def explained(count: int) -> Callable[..., None]:
    """Return the test of so many wrong command lines."""

    @settings(max_examples=count, derandomize=True, phases=PHASES, suppress_health_check=list(HealthCheck))
    @given(data=st.data())
    def test(data: st.DataObject, world: World, capsys: pytest.CaptureFixture[str]) -> None:
        words = data.draw(wrong_words(world))
        capsys.readouterr()
        code = cli.main(words)
        judge(words, code, *capsys.readouterr())

    return test


test_a_wrong_command_line_is_explained = explained(IN_CI)
test_hundreds_of_wrong_command_lines_are_explained = pytest.mark.slow(explained(IN_ALL))


@pytest.mark.parametrize(
    "words",
    [
        ["plan", "PATIENT", "--nodule", "--seed", "x"],
        ["check", "bad/noise.json", "PATIENT", "--json"],
        ["info", "bad/\N{SNOWMAN} [red]"],
        ["tubes", "--outer", "nan", "--inner", "30", "--json"],
    ],
)
def test_a_process_explains_it_as_well(words: list[str], world: World) -> None:
    start = "import sys; from lungaccess.cli.app import main; sys.exit(main())"
    done = subprocess.run(
        [sys.executable, "-c", start, *words],
        capture_output=True, text=True, check=False, env={**os.environ, "COLUMNS": "400"},
    )  # fmt: skip
    judge(words, done.returncode, done.stdout, done.stderr)


def test_output_that_nobody_reads_ends_quietly() -> None:
    start = "import sys; from lungaccess.cli.app import main; sys.exit(main())"
    process = subprocess.Popen(
        [sys.executable, "-c", start, "presets", "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    said = process.stderr.read().decode()
    assert (process.wait(), said) == (ExitCode.PIPE_CLOSED, "")


@pytest.mark.parametrize("name", sorted(EXAMPLES))
def test_every_number_has_a_range(name: str) -> None:
    """Without one, a command would take nan, or -1 samples."""
    numbers = [each for each in arguments_of(name) if kind_of(each) in (int, float)]
    assert [each.name for each in numbers if not ranges_of(each)] in ([], ["--nodule"])

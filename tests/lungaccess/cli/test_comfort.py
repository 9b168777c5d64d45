"""The comfort of the command line: JSON, quiet, progress, suggestions, Ctrl-C, doctor, completion."""

from __future__ import annotations

import inspect
import json
import os
import shutil
import signal
import subprocess
import sys
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from cyclopts import App
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

import lungaccess as la
from anatomy.errors import SettingsError
from anatomy.phantom import Phantom, write_phantom
from anatomy.suggestion import did_you_mean
from lungaccess.cli import anatomy_tables, installation, plan_search, progress, terminal
from lungaccess.cli import app as cli
from lungaccess.cli.exit_code import ExitCode
from lungaccess.cli.options import STEP_SHARES, OutputOptions
from lungaccess.plans.plan import Plan
from lungaccess.problem.system import load_system, needle_preset_names, preset_names
from tests.lungaccess.appraisals import appraise_as_told, make_risk
from tests.lungaccess.loading import load_with

HEAVY = (
    "SimpleITK", "casadi", "edt", "fcl", "matplotlib", "networkx", "numba", "ompl", "pydicom", "scipy",
    "skimage", "trimesh",
)  # fmt: skip
WITHOUT_RESULT = {"completion", "template"}
"""Commands that print a script or a file."""

HANGS_AFTER_S = 120.0
START = (
    "import signal, sys; from lungaccess.cli.app import main;"
    # A job in the background of a shell begins with this signal ignored.
    "signal.signal(signal.SIGINT, signal.default_int_handler); sys.exit(main())"
)


@pytest.fixture(autouse=True)
def loud_again(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Let no test leave the consoles quiet or narrow."""
    for console in (terminal.console, terminal.error_console):
        monkeypatch.setattr(console, "_width", 200)
    yield
    terminal.set_quiet(False)


def commands() -> dict[str, Any]:
    """Return all commands by name, those of a group by its name and theirs."""
    found: dict[str, Any] = {}
    for name in (each for each in cli.app if not each.startswith("-")):
        command = cli.app[name]
        if not isinstance(command, App):
            continue
        if command.default_command is not None:
            found[name] = command.default_command
            continue
        found |= {f"{name} {part}": command[part].default_command for part in command if part[0] != "-"}
    return found


# JSON and quiet ----------------------------------------------------------------------------------


def test_every_command_has_one_style_of_json() -> None:
    found = commands()
    assert {"plan", "demo", "info", "export", "doctor", "tour"} <= set(found)
    options = {name: inspect.signature(function).parameters for name, function in found.items()}
    assert {name for name, each in options.items() if "output" not in each} == WITHOUT_RESULT
    assert not [name for name, each in options.items() if "json" in each]
    for name in set(found) - WITHOUT_RESULT:
        option = options[name]["output"]
        assert isinstance(option.default, OutputOptions) and not option.default.json, name
        assert option.kind == option.KEYWORD_ONLY, name


def test_presets_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["presets", "--json"]) == ExitCode.OK
    found = json.loads(capsys.readouterr().out)
    assert set(found) == {*preset_names(), *needle_preset_names()}
    assert found["lung-default"]["needle"]["diameter_mm"] == 1.0


@pytest.mark.parametrize("word", ["--quiet", "-q"])
@pytest.mark.parametrize("before", [True, False])
def test_quiet_prints_json_and_errors_alone(
    word: str, before: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(*words: str) -> tuple[int, Any]:
        code = cli.main([word, *words] if before else [*words, word])
        return code, capsys.readouterr()

    code, said = run("presets")
    assert (code, said.out, said.err) == (ExitCode.OK, "", "")
    code, said = run("presets", "--json")
    assert code == ExitCode.OK and set(json.loads(said.out)) == {*preset_names(), *needle_preset_names()}
    code, said = run("plan", "toy", "--nodule", "--system", "no-such-system")
    assert code == ExitCode.BAD_INPUT and said.out == "" and "no-such-system" in said.err
    assert cli.main(["presets"]) == ExitCode.OK
    assert "lung-default" in capsys.readouterr().out


@given(
    st.recursive(st.floats() | st.text(), lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner))
)
def test_json_is_json_whatever_the_numbers(value: Any) -> None:
    def expected(part: Any) -> Any:
        if isinstance(part, float):
            return part if abs(part) < float("inf") else None
        if isinstance(part, list):
            return [expected(inner) for inner in part]
        return {key: expected(inner) for key, inner in part.items()} if isinstance(part, dict) else part

    stream = StringIO()
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(terminal, "console", Console(file=stream, quiet=True))
        terminal.show_json(value)
    assert json.loads(stream.getvalue(), parse_constant=pytest.fail) == expected(value)


def test_a_plan_as_json_says_what_the_check_says(
    toy_lung: Any, toy_plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    from lungaccess.plans.no_plan import NoPlan

    target = SimpleNamespace(lps_mm=toy_plan.target_lps)
    load_with(monkeypatch, lambda *_, **__: toy_lung)
    monkeypatch.setattr("lungaccess.problem.target.StatedTarget.resolve", lambda *_: target)
    for name in ("overview_png", "tree_png", "cost_over_time_png"):
        monkeypatch.setattr(f"lungaccess.report.{name}", lambda *_: None)
    appraise_as_told(monkeypatch, {"accepted": True, "risk": make_risk(1900)})
    monkeypatch.setattr(plan_search, "run_search", lambda *_: (toy_plan, []))
    words = ["plan", "toy", "--nodule", "--json", "--out", str(tmp_path)]
    assert cli.main(words) == ExitCode.OK
    said = json.loads(capsys.readouterr().out)
    assert said["found"] and said["accepted"] and said["digest"] == toy_plan.digest
    assert said["cost"] == toy_plan.cost and said["costs"]["length_mm"] == toy_plan.costs["length_mm"]
    assert said["costs"]["cost_map"] is None and "plan.json" in said["files"]
    assert said["headline"]["grade"] == "good" and said["headline"]["success"]["probability"] == 0.95
    assert json.loads((tmp_path / "summary.json").read_text()) == said
    assert "overview.png" in said["files"]
    for name in ("overview_png", "tree_png", "cost_over_time_png"):
        monkeypatch.setattr(f"lungaccess.report.{name}", lambda *_: pytest.fail("it draws"))
    assert cli.main([*words, "--no-pictures"]) == ExitCode.OK
    assert not [file for file in json.loads(capsys.readouterr().out)["files"] if file.endswith(".png")]

    def fail(*_: Any) -> None:
        raise NoPlan("No way", reasons={"too near a vessel": 3}, advice="A thinner scope")

    monkeypatch.setattr(plan_search, "run_search", fail)
    assert cli.main([*words, "--explain-time", "0"]) == ExitCode.NEGATIVE
    assert json.loads(capsys.readouterr().out) == {
        "found": False,
        "accepted": False,
        "why": "No way",
        "reasons": {"too near a vessel": 3},
        "advice": "A thinner scope",
        "attempts": {},
    }


def test_a_lung_as_json_agrees_with_its_tables(small_lung: Any) -> None:
    record = json.loads(json.dumps(anatomy_tables.organ_record(small_lung), allow_nan=False))
    assert record["tree"]["branches"] == small_lung.tree.n_branches
    assert sum(record["tree"]["branches_by_generation"]) == small_lung.tree.n_branches
    lumen = float(small_lung.mask("lumen").array.sum()) * small_lung.grid.voxel_volume_mm3 / 1000.0
    assert record["volumes_ml"]["lumen"] == pytest.approx(lumen)
    rows = {row[0]: row[1] for row in anatomy_tables._volume_rows(small_lung)}
    assert rows["lumen"] == f"{lumen:.1f}"


# Suggestions -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["pln"], "plan"),
        (["plan", "toy", "--nodul"], "--nodule"),
        (["plan", "toy", "--nodule", "--objective", "lenght"], "length"),
        (["plan", "toy", "--nodule", "--method", "kunz2015"], "kuntz2015"),
        (["plan", "toy", "--nodule", "--system", "lung_defualt"], "lung-default"),
        (["reach", "toy", "--compare", "ultra-thin"], "ultrathin"),
        (["completion", "bsh"], "bash"),
    ],
)
def test_what_was_meant_is_guessed(
    words: list[str], meant: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert cli.main([*words, "--out", str(tmp_path)] if words[0] == "reach" else words) == ExitCode.BAD_INPUT
    said = " ".join(capsys.readouterr().err.split())
    assert (
        f'Did you mean "{meant}"?' in said
        or f"Did you mean {meant}?" in said
        or (f"Did you mean '{meant}'?" in said)
    )


def test_objectives_of_the_library_are_guessed() -> None:
    with pytest.raises(SettingsError, match="Did you mean 'cost-map'"):
        la.Objective.of("cost-mpa")
    with pytest.raises(SettingsError) as caught:
        load_system("zzzz")
    assert "Did you mean" not in str(caught.value)


@given(st.sampled_from(preset_names()), st.integers(0, 30))
def test_a_name_with_a_letter_missing_is_found(name: str, place: int) -> None:
    place %= len(name)
    assert did_you_mean(name[:place] + name[place + 1 :], preset_names()) == f"Did you mean {name!r}?"


# Progress ----------------------------------------------------------------------------------------


@given(st.floats(0.0, 1e4), st.floats(0.0, 1.0))
def test_the_time_left_is_in_proportion(passed_s: float, share: float) -> None:
    left = progress.remaining_s(passed_s, share, 1.0)
    if share < progress.LEAST_SHARE:
        assert left is None
    else:
        assert left is not None
        assert passed_s + left == pytest.approx(passed_s / share)
    assert progress.remaining_s(passed_s, share, None) is None


@pytest.fixture
def screen(monkeypatch: pytest.MonkeyPatch) -> StringIO:
    stream = StringIO()
    monkeypatch.setattr(
        progress, "progress_console", Console(file=stream, force_terminal=True, width=120, color_system=None)
    )
    return stream


def test_steps_are_shown_with_an_estimate(screen: StringIO) -> None:
    with progress.progress("reading [x]") as shown:
        shown.step("first")
        shown._progress.refresh()
        assert "reading [x]: first" in screen.getvalue() and "left" not in screen.getvalue()
        shown.step("second", 0.5)
        shown._progress.refresh()
    assert "reading [x]: second" in screen.getvalue() and "s left" in screen.getvalue()


def test_a_search_shows_best_cost_and_estimate(screen: StringIO) -> None:
    with progress.SearchDisplay(10.0, None) as shown:
        shown.update("local search", 5.0, 3, None)
        shown.better(5.0, 1.25)
        shown.update("local search", 6.0, 3, 1.25)
        shown._progress.refresh()
        shown.interrupted()
    said = screen.getvalue()
    assert "no plan yet" in said and "best cost 1.25" in said and "s left" in said and "interrupted" in said


def test_nothing_is_shown_where_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = StringIO()
    monkeypatch.setattr(progress, "progress_console", Console(file=stream, quiet=True, force_terminal=True))
    with progress.progress("working") as shown:
        shown.share(0.5)
    with progress.SearchDisplay(1.0, None) as search:
        search.better(0.1, 1.0)
    assert stream.getvalue() == ""


# Ctrl-C ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def patient(small_phantom: Phantom, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A synthetic patient on disk, prepared in `cache` beside it."""
    from lungaccess.problem.patients import load_patient

    folder = tmp_path_factory.mktemp("comfort")
    write_phantom(small_phantom, folder / "patient")
    told: list[str] = []
    load_patient(folder / "patient", cache=folder / "cache", progress=told.append)
    assert set(told) <= set(STEP_SHARES), "the bar knows every step"
    assert [STEP_SHARES[step] for step in told] == sorted(STEP_SHARES[step] for step in told)
    return folder / "patient"


def planning(patient: Path, out: Path, *more: str, cache: Path | None = None) -> subprocess.Popen[str]:
    words = ["plan", str(patient), "--nodule", "--system", "ultrathin", "--budget", "100000"]
    words += ["--out", str(out), "--cache", str(cache or patient.parent / "cache"), *more]
    return subprocess.Popen(
        [sys.executable, "-c", START, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


@pytest.mark.parametrize(
    "more",
    [
        ("--json",),
        pytest.param((), marks=pytest.mark.slow),
        pytest.param(("--processes", "2"), marks=pytest.mark.slow),
    ],
)
def test_ctrl_c_keeps_the_best_plan(more: tuple[str, ...], patient: Path, tmp_path: Path) -> None:
    """A real SIGINT, as from a terminal to the whole group, as soon as the first plan is announced."""
    process = planning(patient, tmp_path / "out", *more)
    assert process.stderr is not None
    said = ""
    while "cost" not in said:
        line = process.stderr.readline()
        assert line, "it ended before a plan"
        said += line
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=HANGS_AFTER_S)
    said += err
    assert process.returncode == ExitCode.OK, said + out
    assert "Traceback" not in said and "the best plan so far is kept" in said
    assert Plan.load(tmp_path / "out" / "plan.json").costs["inverse_clearance"] > 0.0
    if "--json" in more:
        assert json.loads(out)["accepted"]
    else:
        assert "Geometry proved and checked. Estimated to succeed" in out


def test_ctrl_c_before_the_first_plan_exits_130(patient: Path, tmp_path: Path) -> None:
    process = planning(patient, tmp_path / "out", cache=tmp_path / "cache")
    while not list((tmp_path / "cache").glob(".building-*")):
        assert process.poll() is None
    os.killpg(process.pid, signal.SIGINT)
    _, err = process.communicate(timeout=HANGS_AFTER_S)
    assert process.returncode == ExitCode.INTERRUPTED
    assert "interrupted" in err and "Traceback" not in err
    assert not (tmp_path / "out" / "plan.json").exists()
    assert not list((tmp_path / "cache").glob("*")), "nothing half made is left"


# Commands on a patient ---------------------------------------------------------------------------


def answer_of(words: list[str], capsys: pytest.CaptureFixture[str], code: int = ExitCode.OK) -> Any:
    """Run a command with --json and return what it says; its standard output is JSON and nothing else."""
    assert cli.main([*words, "--json"]) == code
    return json.loads(capsys.readouterr().out)


def test_info_and_tour_as_json(patient: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cache = ["--cache", str(patient.parent / "cache")]
    found = answer_of(["info", str(patient), *cache], capsys)
    assert found["kind"] and found["tree"]["branches"] > 10 and len(found["targets_lps"]) > 0
    lesion = "lps:" + ",".join(f"{c:.3f}" for c in found["targets_lps"][0])
    (tmp_path / "lesions.txt").write_text(lesion + "\n")
    words = ["tour", str(patient), "--targets", str(tmp_path / "lesions.txt"), "--no-require-plan", *cache]
    tour = answer_of([*words, "--out", str(tmp_path / "tour")], capsys)
    assert tour == json.loads((tmp_path / "tour" / "tour.json").read_text())


def test_alternatives_and_needle_as_json(
    patient: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["--nodule", "1", "--system", "ultrathin", "--cache", str(patient.parent / "cache")]
    words = ["alternatives", str(patient), *common, "--count", "2", "--out", str(tmp_path)]
    found = answer_of(words, capsys)
    assert found and all(each["accepted"] for each in found)
    first = Plan.load(found[0]["plan"])
    assert found[0]["criteria"]["inverse_clearance"] == pytest.approx(first.costs["inverse_clearance"])
    np.savetxt(tmp_path / "pose.txt", first.tube.lps_from_tip)
    start = ["--start", str(tmp_path / "pose.txt"), "--iterations", "2000"]
    path = answer_of(["needle", str(patient), *common, *start], capsys)["path"]
    assert path["length_mm"] == pytest.approx(sum(arc["length_mm"] for arc in path["arcs"]))
    assert path["lps_from_start"][3] == [0.0, 0.0, 0.0, 1.0]


def test_advice_as_json(patient: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["advise", str(patient), "--nodule", "1", "--system", "ultrathin", "--out", str(tmp_path)]
    words += ["--cache", str(patient.parent / "cache"), "--json"]
    code = cli.main(words)
    advice = json.loads(capsys.readouterr().out)
    assert advice == json.loads((tmp_path / "advice.json").read_text())
    assert code == (ExitCode.OK if advice["reached"] else ExitCode.NEGATIVE)


# Doctor and completion ---------------------------------------------------------------------------


def test_the_doctor_sees_every_library(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["doctor", "--json", "--cache", str(tmp_path)]) == ExitCode.OK
    found = json.loads(capsys.readouterr().out)
    versions = {each["name"]: each["version"] for each in found["libraries"]}
    assert {"numpy", "numba", "SimpleITK", "cyclopts"} <= set(versions)
    assert "pytest" not in versions and None not in versions.values()
    assert found["cores"] >= found["usable_cores"] >= 1
    assert found["kernels"]["modules"] > 30
    assert found["cache"]["path"] == str(tmp_path) and found["complaints"] == []
    assert cli.main(["doctor"]) == ExitCode.OK
    assert "compiled kernels" in capsys.readouterr().out


def test_the_doctor_complains(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any) -> None:
    missing = installation.Library(name="numba", required=">=0.60", version=None)
    monkeypatch.setattr(installation, "_libraries", lambda: (missing,))
    monkeypatch.setenv("LUNGACCESS_DATA", str(tmp_path / "nowhere"))
    (tmp_path / "file").write_text("")
    assert cli.main(["doctor", "--cache", str(tmp_path / "file" / "cache")]) == 1
    said = capsys.readouterr().out
    for complaint in ("numba is missing", "cannot be written", "nowhere, which is no folder", "MISSING"):
        assert complaint in said


@pytest.mark.parametrize("elsewhere", [True, False])
def test_kernels_are_warm_if_no_older_than_their_source(
    elsewhere: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    sources = [tmp_path / "kernels" / f"{name}.py" for name in ("a", "b")]
    home = tmp_path / "kept" if elsewhere else sources[0].parent / "__pycache__"
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)
    if elsewhere:
        monkeypatch.setenv("NUMBA_CACHE_DIR", str(home))
    place = home / "kernels_123" if elsewhere else home
    place.mkdir(parents=True)
    sources[0].parent.mkdir(exist_ok=True)
    for source in sources:
        source.write_text("")
        os.utime(source, (100.0, 100.0))
    monkeypatch.setattr(installation, "_kernel_sources", lambda: iter(sources))
    assert installation.kernel_cache().state == "cold"
    for source, states in zip(sources, (("cold", "partly warm"), ("partly warm", "warm")), strict=True):
        index = place / f"{source.stem}.f-12.py311.nbi"
        index.write_bytes(b"12345")
        for time, state in zip((99.0, 101.0), states, strict=True):
            os.utime(index, (time, time))
            assert installation.kernel_cache().state == state
    assert installation.kernel_cache().size_bytes == 10
    assert installation.kernel_cache().folders == (str(home),)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_knows_commands_options_and_choices(
    shell: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert cli.main(["completion", shell]) == ExitCode.OK
    script = capsys.readouterr().out
    for word in (*" ".join(commands()).split(), "voxel-sum", "allow-fissures"):
        assert word in script, word
    if shutil.which(shell) is not None:
        (tmp_path / "script").write_text(script)
        subprocess.run([shell, "-n", str(tmp_path / "script")], check=True)


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash")
@pytest.mark.parametrize(
    ("words", "offered"),
    [(["pl"], "plan"), (["plan", "--obj"], "--objective"), (["plan", "--objective", "le"], "length")],
)
def test_bash_completes(
    words: list[str], offered: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    cli.main(["completion", "bash"])
    (tmp_path / "script").write_text(capsys.readouterr().out)
    typed = " ".join(["lungaccess", *words])
    ask = f'source "$1"; COMP_WORDS=({typed}); COMP_CWORD={len(words)}; _lungaccess; echo "${{COMPREPLY[@]}}"'
    done = subprocess.run(
        ["bash", "-c", ask, "bash", str(tmp_path / "script")], capture_output=True, text=True, check=True
    )
    assert offered in done.stdout.split()


@pytest.mark.parametrize("words", [["--help"], ["plan", "--help"], ["export", "--help"], ["doctor"], ["pln"]])
def test_what_is_asked_for_often_imports_nothing_heavy(words: list[str]) -> None:
    code = f"import sys; from lungaccess.cli.app import main; main({words!r}); " + (
        f"sys.exit(', '.join(sorted(set({HEAVY!r}) & set(sys.modules))) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr

"""The doctor, completion of words, and what is imported."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from anatomy.machine_code import sources
from lungaccess.cli import app as cli
from lungaccess.cli.commands import installation
from lungaccess.cli.exit_code import ExitCode
from tests.lungaccess.cli.every_command import commands

HEAVY = (
    "SimpleITK", "casadi", "edt", "fcl", "matplotlib", "networkx", "numba", "ompl", "pydicom", "scipy",
    "skimage", "trimesh",
)  # fmt: skip


@pytest.mark.slow
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


def test_the_doctor_misses_nothing_that_this_platform_does_not_need(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = [
        "numpy>=2.0", "no-such-a>=1; sys_platform == 'another'", "no-such-b; extra == 'view'",
        "no-such-c>=1; python_version >= '3.9' and (sys_platform != 'another' or extra == 'view')",
    ]  # fmt: skip
    monkeypatch.setattr(installation.metadata, "requires", lambda _name: lines)
    found = {each["name"]: each["version"] for each in installation._libraries()}
    assert list(found) == ["numpy", "no-such-c"] and found["numpy"] and found["no-such-c"] is None


def test_the_doctor_complains(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: Any) -> None:
    missing = {"name": "numba", "required": ">=0.60", "version": None}
    monkeypatch.setattr(installation, "_libraries", lambda: [missing])
    monkeypatch.setenv("LUNGACCESS_DATA", str(tmp_path / "nowhere"))
    (tmp_path / "file").write_text("")
    assert cli.main(["doctor", "--cache", str(tmp_path / "file" / "cache")]) == 1
    said = capsys.readouterr().out
    for complaint in ("numba is missing", "cannot be written", "nowhere, which is no folder", "MISSING"):
        assert complaint in said


def test_kernels_are_warm_where_there_is_code_of_their_present_sources(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    texts = {"a": "1", "b": "2"}
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(sources, "kernel_modules", lambda **_more: ("a", "b"))
    monkeypatch.setattr(sources.Sources, "stamp", lambda _self, name: 64 * texts[name])
    place = Path(installation.kernel_cache()["folders"][-1])
    assert tmp_path in place.parents and installation.examine()["kernel_state"] == "cold"
    for name, stamp, state in (("a", "1", "partly warm"), ("b", "3", "partly warm"), ("b", "2", "warm")):
        code = place / f"{name}-{12 * stamp}" / "f-123.code"
        code.parent.mkdir(parents=True)
        code.write_bytes(b"12345")
        assert installation.examine()["kernel_state"] == state
    texts["a"] = "4"
    assert installation.examine()["kernel_state"] == "partly warm", "code of other sources does not count"
    assert installation.kernel_cache()["size_bytes"] == 15


@cache
def script_of(shell: str) -> str:
    """Return what `lungaccess completion` writes; making it takes seconds."""
    with redirect_stdout(StringIO()) as written:
        assert cli.main(["completion", shell]) == ExitCode.OK
    return written.getvalue()


@pytest.mark.parametrize(
    "shell", ["bash", *(pytest.param(name, marks=pytest.mark.slow) for name in ("zsh", "fish"))]
)
def test_completion_knows_commands_options_and_choices(shell: str, tmp_path: Path) -> None:
    script = script_of(shell)
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
def test_bash_completes(words: list[str], offered: str, tmp_path: Path) -> None:
    (tmp_path / "script").write_text(script_of("bash"))
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

"""The doctor, completion of words, and what is imported."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from lungaccess.cli import app as cli
from lungaccess.cli import installation
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

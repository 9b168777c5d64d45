"""Machine code on disk is of the present sources, whole, and not written where it was made beforehand."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numba
import pytest

import anatomy
from anatomy.machine_code.folders import can_be_written, generation, kernels_folder
from tests.test_release import load

CALLEE = """from anatomy.kernels.compiling import kernel

FACTOR = 2.0


@kernel()
def inner(x):
    return FACTOR * x
"""
CALLER = """from anatomy.kernels.callee import inner
from anatomy.kernels.compiling import kernel


@kernel()
def outer(x):
    return inner(x) + 1.0
"""
PROGRAM = """
import json, sys, warnings

with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    from anatomy.base.kernel_clock import watching_compilations
    from anatomy.kernels.caller import outer

    compiled = []
    with watching_compilations(lambda name: name and compiled.append(name)):
        values = [outer(each) for each in json.loads(sys.argv[1])]
print(json.dumps([values, sorted(compiled), [str(each.message) for each in said]]))
"""


class Tree:
    """A copy of the package `anatomy` with a kernel that calls one of another file, and a cache."""

    def __init__(self, place: Path) -> None:
        shutil.copytree(
            Path(anatomy.__file__).parent, place / "anatomy", ignore=shutil.ignore_patterns("__pycache__")
        )
        self.place, self.kept = place, place / "kept"
        self.callee = place / "anatomy" / "kernels" / "callee.py"
        self.callee.write_text(CALLEE)
        self.callee.with_name("caller.py").write_text(CALLER)

    def call(self, *arguments: float, **environment: str) -> Any:
        """Return the values of `outer`, what was compiled for them, and what was said, in a new process."""
        words = [sys.executable, "-c", PROGRAM, json.dumps(arguments)]
        around = self.environment() | environment
        ended = subprocess.run(words, env=around, cwd=self.place, capture_output=True, text=True, check=True)
        return json.loads(ended.stdout)

    def environment(self) -> dict[str, str]:
        """Return the environment of a process that uses this copy and its cache."""
        path = os.pathsep.join([str(self.place), str(self.place / "site")])
        return os.environ | {"PYTHONPATH": path, "NUMBA_CACHE_DIR": str(self.kept)}

    def files(self) -> dict[Path, int]:
        """Return the files of code, and when each was written."""
        return {each: each.stat().st_mtime_ns for each in self.kept.rglob("*.code")}


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)


COMPILED = ["inner", "outer"]


def test_a_caller_is_compiled_anew_when_what_it_calls_is_edited(tree: Tree) -> None:
    assert tree.call(3.0) == [[7.0], COMPILED, []]
    assert tree.call(3.0) == [[7.0], [], []]
    tree.callee.write_text(CALLEE.replace("2.0", "5.0"))
    assert tree.call(3.0) == [[16.0], COMPILED, []]
    tree.callee.write_text(CALLEE)
    os.utime(tree.callee, (1e9, 1e9))  # Python looks at the time of a source, stamps at its content alone.
    assert tree.call(3.0) == [[7.0], [], []], "code of both contents is kept"


def test_code_of_few_contents_is_kept(tree: Tree) -> None:
    for number in range(6):
        tree.callee.write_text(CALLEE.replace("2.0", f"{number}.5"))
        os.utime(tree.callee, (1e9 + number, 1e9 + number))
        tree.call(1.0)
    assert len(tree.files()) == 8


def test_damaged_code_counts_as_none(tree: Tree) -> None:
    tree.call(1.0)
    for file in tree.files():
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content)
    assert tree.call(1.0) == [[3.0], COMPILED, []]
    for file in tree.files():
        file.write_bytes(b"")
    assert tree.call(1.0) == [[3.0], COMPILED, []]
    assert tree.call(1.0) == [[3.0], [], []]


def test_code_for_a_kind_of_argument_that_has_moved_counts_as_none(tree: Tree) -> None:
    tree.call(1.0)
    for file in tree.files():
        made = b"cmodule_that_is_gone\nKind\n."
        file.write_bytes(hashlib.sha256(made).digest() + made)
    assert tree.call(1.0) == [[3.0], COMPILED, []]


def test_code_of_another_processor_is_not_run(tree: Tree) -> None:
    tree.call(1.0)
    assert tree.call(1.0, NUMBA_CPU_NAME="generic")[1] == COMPILED
    assert tree.call(1.0, NUMBA_CPU_NAME="generic")[1] == []


def test_where_nothing_can_be_kept_kernels_are_compiled_and_it_is_said_once(tree: Tree) -> None:
    tree.kept.write_text("no folder")
    values, compiled, said = tree.call(1.0, 2.0)
    assert (values, compiled) == ([3.0, 5.0], COMPILED)
    (message,) = said
    assert str(tree.kept) in message and "NUMBA_CACHE_DIR" in message


def test_without_a_home_nothing_is_kept_where_others_could_leave_code(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME", "LOCALAPPDATA"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    assert not can_be_written(kernels_folder())


def test_processes_that_begin_at_once_do_not_disturb_each_other(tree: Tree) -> None:
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda number: tree.call(1.0, 1 + number % 2), range(4)))
    assert [each[0] for each in found] == [[3.0, 3.0 + 2 * (number % 2)] for number in range(4)]
    assert tree.call(1.0, 2)[1] == []
    assert {each.suffix for each in tree.kept.rglob("*") if each.is_file()} == {".code"}


def test_an_upgrade_compiles_anew(tree: Tree, tmp_path: Path) -> None:
    """pip leaves what it did not install, so an upgraded package finds the code of the old one."""
    place = tmp_path / "venv"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(place)], check=True)
    python = place / ("Scripts" if os.name == "nt" else "bin") / "python"
    said = []
    for number, text in ((1, CALLEE), (2, CALLEE.replace("2.0", "5.0")), (1, CALLEE)):
        tree.callee.write_text(text)
        files = {
            each.relative_to(tree.place).as_posix(): each.read_bytes()
            for each in (tree.place / "anatomy").rglob("*.py*")
            if each.suffix in (".py", ".json")
        }
        wheel = tmp_path / f"upgraded-{number}-py3-none-any.whl"
        about = f"upgraded-{number}.dist-info"
        files[f"{about}/METADATA"] = f"Metadata-Version: 2.1\nName: upgraded\nVersion: {number}\n".encode()
        files[f"{about}/WHEEL"] = b"Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        load("kernels_wheel").write_wheel(wheel, files, f"{about}/RECORD")
        pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet", "--no-index"]
        subprocess.run([*pip, "--no-deps", "--upgrade", str(wheel)], check=True)
        libraries = {"PYTHONPATH": str(Path(numba.__file__).parents[1]), "NUMBA_CACHE_DIR": str(tree.kept)}
        words = [str(python), "-c", PROGRAM, "[3.0]"]
        ended = subprocess.run(
            words,
            env=os.environ | libraries,
            cwd=tmp_path / "venv",
            capture_output=True,
            text=True,
            check=True,
        )
        said.append(json.loads(ended.stdout))
    assert said == [[[7.0], COMPILED, []], [[16.0], COMPILED, []], [[7.0], [], []]]


def made_before(tree: Tree, folder: str) -> Path:
    """Install what was compiled as `lungaccess-kernels`, and forget it elsewhere."""
    package = tree.place / "site" / "lungaccess_kernels"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    shutil.move(tree.kept / "lungaccess-kernels" / generation(), package / folder)
    return package


def test_code_made_before_is_used_and_never_written(tree: Tree) -> None:
    tree.call(1.0)
    package = made_before(tree, generation())
    before = {each: each.read_bytes() for each in package.rglob("*.code")}
    assert tree.call(1.0) == [[3.0], [], []]
    assert tree.files() == {}
    assert tree.call(1) == [[3.0], COMPILED, []], "another kind of argument"
    assert tree.call(1) == [[3.0], [], []]
    assert {each: each.read_bytes() for each in package.rglob("*.code")} == before and len(tree.files()) == 2


def test_code_made_before_for_another_numba_is_left_and_it_is_said(tree: Tree) -> None:
    tree.call(1.0)
    made_before(tree, "numba-0.1.0-cpython-311")
    values, compiled, said = tree.call(1.0)
    assert (values, compiled) == ([3.0], COMPILED)
    (message,) = said
    assert "numba-0.1.0-cpython-311" in message and generation() in message


def test_the_processor_is_chosen_unless_numba_has_begun(tree: Tree) -> None:
    program = "import numba; {} import anatomy.kernels.arcs; print(numba.config.CPU_NAME)"
    others = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA_CPU")}
    for begun, chosen in (("", {"x86-64-v2", "generic"}), ("numba.njit(lambda x: x);", {"None"})):
        words = [sys.executable, "-c", program.format(begun)]
        said = subprocess.run(words, cwd=tree.place, env=others, capture_output=True, text=True, check=True)
        assert said.stdout.strip() in chosen

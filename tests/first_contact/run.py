"""Do the tasks of tasks.toml as a newcomer would: installed package, outside the checkout, empty home.

    .venv/bin/python tests/first_contact/run.py          with the libraries of this Python
    .venv/bin/python tests/first_contact/run.py --fresh  in a virtual environment made from nothing

--wheel says what is installed; with --fresh, --python and --constraints say where.  --first does only the
tasks of a first look, as packaging/release.py asks for each version of Python.

The package is built and installed as a user would get it, so that a file that was forgotten is missed.
Without --fresh, what the checkout has compiled of modules is copied, and the libraries are those of the
Python that runs this.  With --kernels, the wheel of compiled kernels is installed too: then the tasks must
compile none of their kernels, or few.  Without it they use those that this user has compiled.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from anatomy.base.cache import user_cache

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
PACKAGES = ("anatomy", "stages", "lungaccess")
COMMANDS = "docs/reference/command_line.md"
HANGS_AFTER_S = 600.0
MOST_COMPILED = 5
"""A search that ends by the clock may come to a kernel to which no recorded one came."""


@dataclass(frozen=True)
class Place:
    """Where the tasks are done: the folder, the environment of its processes, and its Python."""

    folder: Path
    python: Path
    environment: dict[str, str]


def main() -> int:
    """Do all tasks and return 0 if each ended as written down."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.add_argument("--fresh", action="store_true", help="install everything into a new environment")
    options.add_argument(
        "--keep", type=Path, help="do the tasks in this folder, which must be new, and keep it"
    )
    options.add_argument("--first", action="store_true", help="only the tasks that are marked as first")
    options.add_argument("--wheel", default=str(ROOT), help="what is installed; the checkout if not stated")
    options.add_argument("--kernels", help="a wheel lungaccess-kernels that is installed as well")
    options.add_argument("--python", default=sys.executable, help="with --fresh: this one if not stated")
    options.add_argument(
        "--constraints", default="constraints.txt", help="with --fresh: of the checkout; '' for none"
    )
    asked = options.parse_args()
    tasks = tomllib.loads((HERE / "tasks.toml").read_text(encoding="utf-8"))["task"]
    faults = unnamed_commands(tasks)
    if asked.first:
        tasks = [task for task in tasks if task.get("first")]
    with tempfile.TemporaryDirectory() as temporary:
        home = asked.keep.resolve() if asked.keep else Path(temporary)
        if asked.fresh:
            place = fresh_place(home, asked.wheel, asked.python, asked.constraints)
        else:
            place = place_with_these_libraries(home, asked.wheel, asked.kernels)
        beside = [task for task in tasks if task.get("beside")]
        others = [task for task in tasks if not task.get("beside")]
        alone = next((n for n, task in enumerate(others) if task.get("together")), len(others))
        with ThreadPoolExecutor(2) as pool:
            begun = [pool.submit(do_task, task, place) for task in beside]
            for task in others[:alone]:
                faults += do_task(task, place)
            begun += [pool.submit(do_task, task, place) for task in others[alone:]]
            for each in begun:
                faults += each.result()
        if asked.kernels:
            faults += compiled_kernels(home / "home")
    print(f"{len(tasks)} tasks, {len(faults)} faults", flush=True)
    return 1 if faults else 0


def unnamed_commands(tasks: list[dict[str, Any]]) -> list[str]:
    """Return the commands of the tasks that the page of the command line does not name."""
    page = (ROOT / COMMANDS).read_text(encoding="utf-8")
    named = set(re.findall(r"lungaccess ([a-z]+)", page))
    runs = [shlex.split(step["run"]) for task in tasks for step in task["step"] if "run" in step]
    used = {words[1] for words in runs if len(words) > 1 and not words[1].startswith("-")}
    unnamed = [f"{COMMANDS} does not name lungaccess {command}" for command in sorted(used - named)]
    print("\n".join(unnamed), end="\n" if unnamed else "", flush=True)
    return unnamed


def fresh_place(home: Path, package: str, python: str, constraints: str) -> Place:
    """Install a wheel or a checkout with all its libraries into a new virtual environment."""
    subprocess.run([python, "-m", "venv", str(home / "venv")], check=True)
    inside = home / "venv" / "bin" / "python"
    pip = [str(inside), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    told = ["-c", str(ROOT / constraints)] if constraints else []
    subprocess.run([*pip, *told, f"{package}[study]"], check=True)
    return _place(home, inside, {})


def compiled_kernels(home: Path) -> list[str]:
    """Return a fault if the tasks compiled more than a few kernels that the wheel of kernels lacks."""
    made = sorted(f"{each.parent.name.rpartition('-')[0]}:{each.stem}" for each in home.rglob("*.code"))
    said = [f"the wheel of kernels lacks {len(made)}: run `make kernel-calls`", *made] if made else []
    print("\n".join(said), end="\n" if said else "", flush=True)
    return said[:1] if len(made) > MOST_COMPILED else []


def place_with_these_libraries(home: Path, package: str, kernels: str | None) -> Place:
    """Install wheels or a checkout alone, beside these libraries."""
    site = home / "site"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-deps"]
    packages = [package, *([kernels] if kernels else [])]
    subprocess.run([*pip, "--no-compile", "--target", str(site), *packages], check=True)
    for top in PACKAGES:
        for source in (ROOT / top).rglob("*.py"):
            installed = site / source.relative_to(ROOT)
            if installed.is_file() and installed.read_bytes() == source.read_bytes():
                shutil.copystat(source, installed)
        for compiled in (ROOT / top).rglob("__pycache__/*.pyc"):
            target = site / compiled.relative_to(ROOT)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(compiled, target)
    more = {"PYTHONPATH": str(site)}
    if not kernels:
        more["NUMBA_CACHE_DIR"] = os.environ.get("NUMBA_CACHE_DIR", str(user_cache()))
    return _place(home, Path(sys.executable), more, site / "bin")


def _place(home: Path, python: Path, more: dict[str, str], *bins: Path) -> Place:
    for name in ("home", "work"):
        (home / name).mkdir(parents=True)
    path = os.pathsep.join(map(str, (*bins, python.parent, "/usr/local/bin", "/usr/bin", "/bin")))
    plain = {"PATH": path, "HOME": str(home / "home"), "COLUMNS": "120", "LANG": "C.UTF-8"}
    return Place(home / "work", python, plain | more)


def do_task(task: dict[str, Any], place: Place) -> list[str]:
    """Do the steps of a task and return what was not as written down."""
    data = os.environ.get("LUNGACCESS_DATA", "")
    if task.get("needs") == "data" and not Path(data, "med-rad").is_dir():
        print(f"left out: {task['words']} (LUNGACCESS_DATA names no data)", flush=True)
        return []
    started, faults = time.monotonic(), []
    for step in task["step"]:
        faults += do_step(step, place, data)
        if faults:
            break
    mark = "FAILED" if faults else "ok"
    print("\n".join([f"{mark:>6} {time.monotonic() - started:6.1f} s  {task['words']}", *faults]), flush=True)
    return faults


def do_step(step: dict[str, Any], place: Place, data: str) -> list[str]:
    """Run one command or script and compare what it did with what is expected."""
    if "run" in step:
        words = [word.replace("{DATA}", data) for word in shlex.split(step["run"])]
    else:
        words = [str(place.python), "-c", step["python"]]
    done = subprocess.run(
        words, cwd=place.folder, env=place.environment, capture_output=True, text=True, check=False,
        timeout=HANGS_AFTER_S,
    )  # fmt: skip
    said = " ".join(re.sub(r"[│╭╮╰╯─]", " ", done.stdout + done.stderr).split())
    faults = [
        f"  there is no {name}" for name in step.get("files", ()) if not (place.folder / name).is_file()
    ]
    faults += [f"  it does not say {part!r}" for part in step.get("expect", ()) if part not in said]
    if done.returncode not in step.get("exit", [0]):
        faults.append(f"  exit code {done.returncode}, not {step.get('exit', [0])}")
    if "Traceback" in done.stderr:
        faults.append("  it ends in a traceback")
    if faults:
        faults = [f"  {step.get('run', 'script')}", *faults, done.stdout[-2000:], done.stderr[-2000:]]
    return faults


if __name__ == "__main__":
    sys.exit(main())

"""Write down which kernels each command calls, with which kinds of arguments: `make kernel-calls`.

The commands are those of tests/first_contact/tasks.toml and of WORKLOADS, done in a new folder by this
checkout.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TASKS = ROOT / "tests" / "first_contact" / "tasks.toml"
CALLS_FILE = ROOT / "anatomy" / "machine_code" / "kernel_calls.json"
WORKLOADS = (
    "lungaccess phantom --seed 3 --breathing --out BREATHING",
    "lungaccess plan BREATHING --nodule --iterations 20 --out breathing",
    "lungaccess plan BREATHING --nodule --iterations 20 --phases 0.6:1.0 --out phases",
    "lungaccess plan BREATHING --nodule --iterations 10 --goal window --out window",
    "lungaccess plan PATIENT --nodule --iterations 20 --goal default --out cost",
    "lungaccess plan PATIENT --nodule --iterations 20 --goal tissue --out tissue",
    "lungaccess plan PATIENT --nodule --iterations 2 --procedure closed-loop --out success",
    "lungaccess plan PATIENT --nodule --iterations 2 --method kuntz2015 --goal default --out kuntz2015",
    "lungaccess window breathing/plan.json BREATHING",
    "lungaccess start-region plan/plan.json PATIENT",
    "lungaccess replan PATIENT --scope plan/plan.json --nodule",
    "lungaccess shapes --system lung-default",
    "lungaccess insert plan/plan.json PATIENT --samples 2",
    "lungaccess selftest",
    "lungaccess info PATIENT",
)
"""Commands beside the tasks, in this order after them."""
RECORDER = """
import json, sys

from anatomy.machine_code import ahead, cache

ahead.first_compilation.prepare = lambda: False  # All is compiled here, where it is seen.
noted, inner, calls = {}, {}, {}
load, save = cache.KernelCache.load_overload, cache.KernelCache.save_overload

def note(self, sig, codegen, library=None):
    try:
        kinds = [ahead.encoded(each) for each in sig]
    except TypeError:
        return None
    if "<" in self._function.__qualname__:
        return None
    call = json.dumps([self._function.__module__, self._function.__qualname__, kinds])
    noted[call] = str(self._kept_in() / self._file(self._key(sig, codegen)))
    if library is not None:
        calls[id(library)] = call, library
    return call

def load_and_note(self, sig, target_context):
    found = load(self, sig, target_context)
    note(self, sig, target_context.codegen(), found and found.library)
    return found

def save_and_note(self, sig, data):
    call = note(self, sig, data.codegen, data.library)
    linked = [calls[id(each)][0] for each in data.library._linking_libraries if id(each) in calls]
    inner[call] = sorted({each for each in linked if each != call})
    save(self, sig, data)

cache.KernelCache.load_overload, cache.KernelCache.save_overload = load_and_note, save_and_note
out, sys.argv = sys.argv[1], ["lungaccess", *sys.argv[2:]]
code = 1
try:
    if sys.argv[1:2] == ["-c"]:
        exec(sys.argv[2], {"__name__": "__main__"})
        code = 0
    else:
        from lungaccess.cli.app import main

        code = main()
finally:
    with open(out, "w", encoding="ascii") as stream:
        json.dump({"files": noted, "inner": inner}, stream)
sys.exit(code)
"""


def main() -> int:
    """Do the work of each command, and write down the kernels that it called."""
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    options.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        calls = recorded(Path(temporary))
    CALLS_FILE.write_text(as_json(calls), encoding="ascii")
    print(f"{len(calls)} calls of kernels, written to {CALLS_FILE.relative_to(ROOT)}")
    return 0


def recorded(folder: Path) -> dict[str, tuple[set[str], int]]:
    """Return the commands that make each call, and the size of its code."""
    users: dict[str, set[str]] = {}
    inner: dict[str, list[str]] = {}
    sizes: dict[str, int] = {}
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    here = {"PYTHONPATH": str(ROOT), "PATH": path}
    # From nothing: what a kernel calls is seen while it is compiled.
    environment = {"NUMBA_CACHE_DIR": str(folder / "code")} | os.environ | here
    for number, words in enumerate(steps()):
        note = folder / f"{number}.json"
        done = subprocess.run(
            [sys.executable, "-c", RECORDER, str(note), *words],
            cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        noted = json.loads(note.read_text(encoding="ascii")) if note.is_file() else {"files": {}, "inner": {}}
        print(f"{done.returncode} {len(noted['files']):4} kernels: {' '.join(words)[:80]!r}", flush=True)
        inner |= noted["inner"]
        ahead = list(noted["files"])
        command = "python" if words[0] == "-c" else words[0]
        while ahead:
            call = ahead.pop()
            if command not in users.setdefault(call, set()):
                users[call].add(command)
                ahead += inner.get(call, [])
        sizes |= {
            call: os.path.getsize(file) for call, file in noted["files"].items() if os.path.exists(file)
        }
    return {call: (users[call], sizes.get(call, 0)) for call in users}


def steps() -> list[list[str]]:
    """Return the words of each step: a command of lungaccess, or -c and a script."""
    tasks = tomllib.loads(TASKS.read_text(encoding="utf-8"))["task"]
    found = [step for task in tasks if task.get("needs") != "data" for step in task["step"]]
    words = [shlex.split(step["run"])[1:] if "run" in step else ["-c", step["python"]] for step in found]
    return [each for each in words if each] + [shlex.split(line)[1:] for line in WORKLOADS]


def as_json(calls: dict[str, tuple[set[str], int]]) -> str:
    """Return calls as JSON by module and function: kinds of arguments, commands, and doublings of the size.

    Kinds and sets of commands stand there once each.
    """
    given = {call: [json.dumps(kind) for kind in json.loads(call)[2]] for call in calls}
    kinds = sorted({kind for each in given.values() for kind in each})
    commands = sorted({" ".join(sorted(users)) for users, _size in calls.values()})
    tree: dict[str, dict[str, list[list[object]]]] = {}
    for call, (users, size) in sorted(calls.items()):
        module, function, _kinds = json.loads(call)
        row = [
            [kinds.index(kind) for kind in given[call]],
            commands.index(" ".join(sorted(users))),
            size.bit_length(),
        ]
        tree.setdefault(module, {}).setdefault(function, []).append(row)
    rows = [f"{json.dumps(module)}: {json.dumps(tree[module], separators=(',', ':'))}" for module in tree]
    lines = ["{", f'"commands": {json.dumps(commands, indent=0)},', '"kinds": [', ",\n".join(kinds), "],"]
    return "\n".join([*lines, '"calls": {', ",\n".join(rows), "}", "}", ""])


if __name__ == "__main__":
    sys.exit(main())

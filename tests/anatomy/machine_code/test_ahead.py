"""Kernels that are compiled before they are called: the right ones, each once, and none that is gone."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from numba import types

from anatomy.machine_code import ahead
from anatomy.machine_code.ahead import decoded, encoded
from tests.anatomy.machine_code.test_cache import Tree

READ_ONLY = np.zeros((2, 3), dtype=np.float32)
READ_ONLY.setflags(write=False)


@pytest.mark.parametrize(
    "kind",
    [
        *map(numba.typeof, (1, 2.0, True, None, np.uint16(3), READ_ONLY, READ_ONLY[:, ::2], (1, 2.0))),
        types.literal(3), types.Omitted(0.5), types.Optional(types.float64),
    ],
)  # fmt: skip
def test_kinds_of_arguments_are_written_and_read(kind: Any) -> None:
    again = decoded(json.loads(json.dumps(encoded(kind))))
    assert again == kind and str(again) == str(kind)


def test_other_kinds_are_not_written() -> None:
    with pytest.raises(TypeError, match="unicode"):
        encoded(types.unicode_type)


def tree_with(place: Path, calls: list[list[Any]]) -> Tree:
    tree = Tree(place)
    by_place: dict[str, dict[str, list[Any]]] = {}
    for module, function, *row in calls:
        by_place.setdefault(module, {}).setdefault(function, []).append(row)
    kinds = ["float64", "int64", "no such kind"]
    content = {"commands": ["plan", "check"], "kinds": kinds, "calls": by_place}
    (place / "anatomy" / "machine_code" / "kernel_calls.json").write_text(json.dumps(content))
    return tree


def outer(kind: int, command: int) -> list[Any]:
    return ["anatomy.kernels.caller", "outer", [kind], command, 9]


def inner(kind: int, command: int) -> list[Any]:
    return ["anatomy.kernels.callee", "inner", [kind], command, 5]


def compile_for(tree: Tree, *commands: str) -> str:
    """Compile what commands call, and return what is said."""
    words = [sys.executable, "-m", "anatomy.machine_code", *commands]
    environment = tree.environment()
    ended = subprocess.run(words, cwd=tree.place, env=environment, capture_output=True, text=True, check=True)
    return ended.stderr


def test_what_commands_call_is_compiled_once_on_all_cores(tmp_path: Path) -> None:
    tree = tree_with(tmp_path, [inner(0, 0), outer(0, 0), inner(1, 1), outer(1, 1)])
    assert compile_for(tree, "plan").strip() == "2 kernels compiled" and len(tree.files()) == 2
    assert tree.call(1.0) == [[3.0], [], []]
    assert compile_for(tree, "plan") == ""
    assert compile_for(tree).strip() == "2 kernels compiled"
    assert tree.call(1) == [[3.0], [], []]


def test_calls_of_kernels_that_are_gone_are_left_out(tmp_path: Path) -> None:
    gone = ["anatomy.kernels.gone", "f", [0], 0, 1], ["anatomy.kernels.callee", "gone", [0], 0, 1]
    tree = tree_with(tmp_path, [*gone, ["anatomy.kernels.callee", "inner", [2], 0, 1], outer(0, 0)])
    assert compile_for(tree).strip() == "1 kernels compiled"
    assert tree.call(1.0) == [[3.0], [], []]


def test_the_first_compilation_of_a_command_compiles_all_that_it_calls(tmp_path: Path) -> None:
    others = [["anatomy.kernels.arcs", name, [0, 0], 0, 3] for name in ("sine_length", "versine_length")]
    tree = tree_with(tmp_path, [inner(0, 0), outer(0, 0), *others])
    program = """
from anatomy.machine_code import ahead

ahead.FEWEST = 1
ahead.first_compilation.command = "plan"
from anatomy.base.kernel_clock import watching_compilations
from anatomy.kernels.caller import outer

with watching_compilations(lambda name: name and print(name)):
    assert outer(1.0) == 3.0
"""
    words, around = [sys.executable, "-c", program], tree.environment()
    ended = subprocess.run(words, cwd=tmp_path, env=around, capture_output=True, text=True, check=True)
    assert ended.stdout == "" and len(tree.files()) == 4


def test_a_kernel_waits_for_those_that_it_calls() -> None:
    """All kernels that are written down are there, and none waits for itself."""
    calls = dict(enumerate(ahead._calls()))
    assert len(calls) > 300
    assert all(ahead._dispatcher(call) is not None for call in calls.values()), "run `make kernel-calls`"
    waits = ahead._waits_for(calls)
    done: set[int] = set()
    while ready := {n for n in waits if n not in done and waits[n] <= done}:
        done |= ready
    assert done == set(calls)

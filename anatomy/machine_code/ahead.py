"""Kernels compiled before they are called, on all cores: what a command will call is written down.

`kernel_calls.json` holds the kernels that each command calls from Python or from other kernels, with the
kinds of their arguments; `make kernel-calls` writes it.  A call that is missing there is compiled when it
comes, and one that is there in vain costs time alone: nothing depends on the file.
"""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from functools import cache, reduce
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

from anatomy.machine_code.folders import can_be_written, kernels_folder

CALLS_FILE = Path(__file__).with_name("kernel_calls.json")
FEWEST = 6
"""Processes that compile take seconds to start: they are not worth it for fewer kernels."""


class FirstCompilation:
    """What is done when a process first has to compile a kernel: all that its command will call is compiled.

    Attributes:
        command: The command that runs; "" where none is known, as in a program of a user, and then nothing is
            done.
        tell: Receives how many kernels are compiled, and how many have to be, in words; None at the end.
    """

    def __init__(self) -> None:
        self.command = ""
        self.tell: Callable[[str | None], None] = lambda words: None

    def prepare(self) -> bool:
        """Compile what the command will call; return whether anything was compiled."""
        command, self.command = self.command, ""
        wanted = command and can_be_written(kernels_folder())  # Otherwise nobody would find what is compiled.
        compiled = compile_ahead([command], fewest=FEWEST, tell=self.tell) if wanted else 0
        if compiled:
            self.tell(None)
        return compiled > 0


first_compilation = FirstCompilation()


def compile_ahead(
    commands: list[str], *, fewest: int = 1, tell: Callable[[str], None] = lambda words: None
) -> int:
    """Compile kernels that commands call and that are not on disk; return how many were compiled.

    Without `commands`, such as "plan", all that are known are meant.  Fewer missing kernels than `fewest` are
    left to be compiled when they are called.
    """
    called = [n for n, call in enumerate(_calls()) if not commands or call["commands"].intersection(commands)]
    kernels = {n: _calls()[n] for n in called if _dispatcher(_calls()[n]) is not None}  # Some may be gone.
    missing = {n: call for n, call in kernels.items() if _code_file(call) is None}
    if len(missing) < fewest:
        return 0
    done = 0
    for _ in _compiled_in_order(_waits_for(missing), usable_cores()):
        done += 1
        tell(f"{done} of {len(missing)}")
    return done


def code_files() -> tuple[Path, ...]:
    """Return the files of code on disk for the calls that are written down, whatever the command."""
    return tuple(sorted({file for call in _calls() if (file := _code_file(call)) is not None}))


def usable_cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _calls() -> tuple[Mapping[str, Any], ...]:
    """Return the calls that are written down, with commands and how often the size of the code doubles."""
    stored = json.loads(CALLS_FILE.read_text(encoding="ascii"))
    return tuple(
        {
            "module": module,
            "function": function,
            "kinds": [stored["kinds"][n] for n in kinds],
            "commands": set(stored["commands"][users].split()),
            "size": size,
        }
        for module, functions in stored["calls"].items()
        for function, calls in functions.items()
        for kinds, users, size in calls
    )


def _code_file(call: Mapping[str, Any]) -> Path | None:
    found = _dispatcher(call)
    return None if found is None else found[0]._cache.code_file(found[1], found[0].targetctx)


def _dispatcher(call: Mapping[str, Any]) -> tuple[Any, tuple[Any, ...]] | None:
    """Return the kernel and the types of a call, None if there is no such kernel or type any more."""
    try:
        kernel = getattr(import_module(call["module"]), call["function"])
        kinds = tuple(decoded(kind) for kind in call["kinds"])
    except (ImportError, AttributeError, LookupError, TypeError, ValueError):
        return None
    return (kernel, kinds) if hasattr(kernel, "_cache") else None


def _compile(number: int) -> None:
    """Compile a call, in a process of its own; what cannot be compiled so is left to the call itself."""
    found = _dispatcher(_calls()[number])
    if found is not None:
        from numba.core.errors import NumbaError

        try:
            found[0].compile(found[1])
        except NumbaError:
            return


def _waits_for(missing: Mapping[int, Mapping[str, Any]]) -> dict[int, set[int]]:
    """Return which of the calls each has to wait for, so that no two processes compile the same kernel."""
    of_kernel: dict[int, set[int]] = {}
    kernels = {n: found[0] for n, call in missing.items() if (found := _dispatcher(call)) is not None}
    for n, kernel in kernels.items():
        of_kernel.setdefault(id(kernel), set()).add(n)
    return {
        n: set().union(*(of_kernel.get(id(each), set()) for each in _called_by(kernel))) - {n}
        for n, kernel in kernels.items()
    }


def _called_by(kernel: Any) -> Iterator[Any]:
    """Yield the kernels that a kernel calls, those that these call, and so on."""
    seen, ahead = {id(kernel)}, [kernel]
    while ahead:
        function = ahead.pop().py_func
        names = function.__code__.co_names
        values = [function.__globals__.get(name) for name in names]
        modules = [value for value in values if isinstance(value, ModuleType)]
        values += [getattr(module, name, None) for module in modules for name in names]
        for value in values:
            if hasattr(value, "py_func") and id(value) not in seen:
                seen.add(id(value))
                ahead.append(value)
                yield value


def _compiled_in_order(waits_for: dict[int, set[int]], processes: int) -> Iterator[int]:
    """Compile calls after those that they wait for, the largest first; yield each that is done.

    A process that dies ends all of it: what is not done is compiled when it is called.  So is a call that
    cannot be compiled, as one of a list that is older than its kernel.
    """
    import multiprocessing
    from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
    from concurrent.futures.process import BrokenProcessPool

    left, under_way = dict(waits_for), dict[Future[None], int]()
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        try:
            while left or under_way:
                ready = sorted((n for n in left if not left[n]), key=lambda n: -_calls()[n]["size"])
                for n in ready[: processes - len(under_way)]:
                    del left[n]
                    under_way[pool.submit(_compile, n)] = n
                finished, _ = wait(under_way, return_when=FIRST_COMPLETED)
                for each in finished:
                    n = under_way.pop(each)
                    for others in left.values():
                        others.discard(n)
                    if isinstance(each.exception(), BrokenProcessPool):
                        return
                    yield n
        except BrokenProcessPool:
            return
        finally:
            # Who stops early does not wait for what is being compiled; else the pool ends in order: left to
            # itself, it may complain of closed pipes when the program ends.
            if left or under_way:
                pool.shutdown(wait=False, cancel_futures=True)


def encoded(kind: Any) -> Any:
    """Return one of numba's types as plain values.

    Raises TypeError if it is a type that no kernel is called with from Python.
    """
    from numba import types

    match kind:
        case types.Array():
            return ["array", encoded(kind.dtype), kind.ndim, kind.layout, kind.mutable]
        case types.NamedTuple() | types.NamedUniTuple():
            record = f"{kind.instance_class.__module__}:{kind.instance_class.__qualname__}"
            return ["named", record, [encoded(each) for each in kind.types]]
        case types.Tuple() | types.UniTuple():
            return ["tuple", [encoded(each) for each in kind.types]]
        case types.Literal():
            return ["literal", kind.literal_value]
        case types.Omitted():
            return ["omitted", kind.value]
        case types.Optional():
            return ["optional", encoded(kind.type)]
        case types.Number() | types.Boolean() | types.NoneType():
            return str(kind)
    raise TypeError(f"Arguments of the kind {kind} cannot be written down")


def decoded(plain: Any) -> Any:
    """Return the type that `encoded` returned as these values.

    Raises ImportError, AttributeError, LookupError, TypeError or ValueError if there is none.
    """
    from numba import types

    if isinstance(plain, str):
        return {"none": types.none, "bool": types.boolean}.get(plain) or getattr(types, plain)
    word, *rest = plain
    if word == "array":
        dtype, dimensions, layout, mutable = rest
        return types.Array(decoded(dtype), dimensions, layout, readonly=not mutable)
    if word == "named":
        module, _, name = rest[0].partition(":")
        record = reduce(getattr, name.split("."), import_module(module))
        return types.BaseTuple.from_types([decoded(each) for each in rest[1]], record)
    if word == "tuple":
        return types.BaseTuple.from_types([decoded(each) for each in rest[0]])
    if word == "optional":
        return types.Optional(decoded(rest[0]))
    made: Any = {"literal": types.literal, "omitted": types.Omitted}[word]
    return made(rest[0])

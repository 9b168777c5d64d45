"""How kernels are compiled: by numba, for every processor of a kind, their code bound to all its sources."""

import platform
from collections.abc import Callable
from typing import Any

import numba

from anatomy.machine_code.cache import KernelCache

PROCESSORS = {"x86_64": "x86-64-v2", "amd64": "x86-64-v2", "arm64": "generic", "aarch64": "generic"}
"""LLVM's names by those that Python has for machines.

All x86-64 processors since 2009 follow the second level.  Kernels gain nothing from later instructions:
285,000 shapes of two tubes a second with the second level, 292,000 with the third, and 255,000 with those of
the machine itself.
"""


def _choose_processor() -> None:
    """Let numba compile for every machine of this kind, so that what it made can be taken to another.

    A choice by ``NUMBA_CPU_NAME`` stands.  Where numba has already made code, for another library, it goes on
    as it began: its code for this machine is then compiled here, and kept apart.
    """
    begun = "_toplevel_target_context" in vars(numba.core.registry.cpu_target)
    name = PROCESSORS.get(platform.machine().lower())
    if name is not None and numba.config.CPU_NAME is None and not begun:
        numba.config.CPU_NAME, numba.config.CPU_FEATURES = name, ""


_choose_processor()


def kernel(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator, by options of `numba.njit`, that compiles at a first call, or finds the code."""

    def compiled(function: Callable[..., Any]) -> Any:
        dispatcher = numba.njit(**options)(function)
        if dispatcher is not function:  # numba hands back the function itself under NUMBA_DISABLE_JIT.
            dispatcher._cache = KernelCache(function)
        return dispatcher

    return compiled


inner_kernel = kernel(no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile a function without the entrances that calls from Python would need: that takes less time."""

borrowing_kernel = kernel(no_cpython_wrapper=True, no_cfunc_wrapper=True, _nrt=False)
"""Compile such a function to borrow its arrays, which it must not make or keep: counting who else holds them
takes longer than a look at a field, and twice as long where two threads count."""

inlined_kernel = kernel(forceinline=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
"""Compile such a function, small, into every kernel that calls it.

A call that passes a tuple of arrays counts references to each of them: within the 121 candidates of a motion
of the scope that costs as much as the motion itself.
"""

merged_kernel = kernel(inline="always")
"""Compile such a function as a part of its one caller.

Apart, it would be optimised again in each kernel above.  Not for one that asks whether an argument is None,
nor for one whose result chooses between kinds of arguments: that is not decided while types are found.
"""
